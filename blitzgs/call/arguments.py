# SPDX-License-Identifier: Apache-2.0
"""Checks the arguments of the calls and folds their batch dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from numbers import Integral, Real
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from blitzgs._torch import func_transforms_are_active
from blitzgs.call.covariances import Decomposed
from blitzgs.capture.cameras import MAX_SIDE
from blitzgs.ops.harmonics import MAX_SH_DEGREE, colors_of_views
from blitzgs.ops.intersect import TILE_SIZE
from blitzgs.ops.projection_types import ProjectionOptions
from blitzgs.ops.unscented import Lenses
from blitzgs.util.errors import warn

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
CAMERA_MODELS = ("pinhole", "fisheye")
# What the kernels evaluate; torch evaluates other SH before them.
KERNEL_SH_DEGREE, KERNEL_SH_CHANNELS = 3, 3
# What the kernels can composite (csrc/rasterize/rasterize_op.cpp).
MAX_CHANNELS = 4096
# Further arguments of gsplat's calls (1.5.3 and later) and their defaults; no other values are supported.
GSPLAT_DEFAULTS: dict[str, Any] = {
    "with_eval3d": False, "global_z_order": True, "rays": None, "ftheta_coeffs": None, "lidar_coeffs": None,
    "external_distortion_coeffs": None, "renderer_config": None,
}  # fmt: skip
# Whole numbers: the least, the largest, and what an error says.
_WHOLE = {
    "width": (1, MAX_SIDE, "1 to 2^20 px"),
    "height": (1, MAX_SIDE, "1 to 2^20 px"),
    "tile_size": (1, 64, "1 to 64 px"),
    "sh_degree": (0, MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
}
ANY = object()  # in place of a default: no value changes the result


class Signals(NamedTuple):
    """The extra signals of a call."""

    values: Tensor  # of all scenes: [..., N, E], per view [..., C, N, E], or SH coefficients [..., N, K, E]
    sh_degree: int | None  # degree of the SH that are evaluated; None: the values are composited
    per_view: bool  # whether every view has its own values

    @property
    def channels(self) -> int:
        """Number of channels E."""
        return self.values.shape[-1]


class Scene(NamedTuple):
    """N Gaussians and C views of them."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor | None  # SH [N, K, 3] or [C, N, K, 3], values [N, D] or [C, N, D]; None: depth alone
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    covariances: Decomposed | None = None  # given instead of quats and scales, which are of them then
    lenses: Lenses | None = None  # lenses and shutters of the views; None: pinhole cameras


# The tensors of a scene: the first dimension, and the others.
_SHAPES = (
    ("means", "N", (3,)), ("quats", "N", (4,)), ("scales", "N", (3,)), ("opacities", "N", ()),
    ("viewmats", "C", (4, 4)), ("Ks", "C", (3, 3)),
)  # fmt: skip


class Gaussians(NamedTuple):
    """The checked arguments of a call: S scenes of N Gaussians and C views each, I = S C images."""

    function: str  # name of the public function, for warnings
    # S >= 1. Without batch dimensions, these are the caller's own tensors: a leaf stays a leaf.
    scenes: tuple[Scene, ...]
    colors: Tensor | None  # colours of all scenes, as given by the caller
    opacities: Tensor  # opacities of all scenes, as given by the caller
    sh_degree: int | None  # degree of the SH that are evaluated; None: colours are values, or not rendered
    per_view: bool  # whether every view has its own colours
    lead: tuple[int, ...]  # the batch dimensions, and C
    raw: bool  # whether scales and opacities are before their activation
    named: Mapping[str, tuple[Tensor, ...]]  # the arguments that have to be finite, one for each scene
    signals: Signals | None = None  # the extra signals; None: none

    @property
    def views(self) -> int:
        """Number of views C of each scene."""
        return self.lead[-1]

    @property
    def images(self) -> int:
        """Number of images I."""
        return math.prod(self.lead)

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians N of each scene."""
        return self.opacities.shape[-1]


def check_further(
    function: str, further: Mapping[str, Any], defaults: Mapping[str, Any] = GSPLAT_DEFAULTS
) -> None:
    """Check further keyword arguments: only the names of `defaults` with their values are accepted.

    TypeError: gsplat has no such argument. ValueError: the value is not gsplat's default.
    """
    for name, value in further.items():
        if name not in defaults:
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}")
        default = defaults[name]
        # Defaults of types that only gsplat has: RollingShutterType.GLOBAL, and RendererConfig_MixedBatch().
        foreign = name == "rolling_shutter" and getattr(value, "name", value) == "GLOBAL"
        foreign |= name == "renderer_config" and type(value).__name__ == "RendererConfig_MixedBatch"
        is_default = value is default or (isinstance(value, str) and value == default)
        if not (value is None or is_default or default is ANY or foreign):
            shown = f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else repr(value)
            raise ValueError(f"blitzgs.{function} does not support {name}={shown}; leave it out")


def checked_options(
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    sh_degree: int | None,  # None: 0
    tile_size: int | None,  # None: 16
    rasterize_mode: str,
    raw: bool = False,  # whether scales and opacities are before their activation
) -> ProjectionOptions:
    """Check the arguments that are not tensors (TypeError, ValueError); return the projection's options."""
    tile_size = TILE_SIZE if tile_size is None else tile_size
    degree = 0 if sh_degree is None else sh_degree
    whole = {"width": width, "height": height, "tile_size": tile_size, "sh_degree": degree}
    for name, value in whole.items():
        # int comes first, because asking an abstract class takes longer; torch traces with SymInt.
        if not isinstance(value, (int, Integral, torch.SymInt)):
            raise TypeError(f"{name} must be a whole number, got {value!r}")
        least, most, described = _WHOLE[name]
        if not least <= value <= most:
            raise ValueError(f"{name} must be {described}, got {value}")
    numbers = {"near_plane": near_plane, "far_plane": far_plane, "eps2d": eps2d, "radius_clip": radius_clip}
    for name, number in numbers.items():
        # YAML reads 1e10 as a string. A tensor of one number is taken as torch's own functions take it.
        if not isinstance(number, (float, Real, torch.SymFloat, Tensor)):
            raise TypeError(f"{name} must be a number, got {number!r}")
    # NaN fails each of these comparisons.
    if not near_plane < far_plane:
        raise ValueError(f"near_plane must be less than far_plane, got {near_plane} and {far_plane}")
    if not 0 <= eps2d < math.inf:
        raise ValueError(f"eps2d must be a finite number of px^2 of at least 0, got {eps2d}")
    if not radius_clip >= 0:
        raise ValueError(f"radius_clip must be at least 0 px, got {radius_clip}")
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    antialiased = rasterize_mode == "antialiased"
    return ProjectionOptions(
        width, height, tile_size, degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw
    )


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Check that an argument is one of some words (ValueError: it is not)."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def refuse_func_transforms() -> None:
    """Raise a RuntimeError inside a transform of `torch.func`."""
    if func_transforms_are_active():
        raise RuntimeError(
            "blitzgs does not support the transforms of torch.func (grad, vjp, jvp, jacrev, vmap, ...): use "
            "torch.autograd or backward(), and batch dimensions of the arguments in place of vmap"
        )


def check_tensors(required: Mapping[str, object], optional: Mapping[str, object]) -> None:
    """Check that arguments are tensors on one device, all float32 or all float64; optional ones may be None.

    RuntimeError: the call is inside a transform of `torch.func`. TypeError: an argument is no tensor, but
    perhaps an array of another library, or has a dtype that the kernels lack. ValueError: dtypes or devices
    differ.
    """
    refuse_func_transforms()
    device, dtype, first = None, None, ""
    for name, value in (*required.items(), *optional.items()):
        if value is None and name in optional:
            continue
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
        if device is None:
            device, dtype, first = value.device, value.dtype, name
            if dtype not in (torch.float32, torch.float64):
                raise TypeError(f"{name} must be float32 or float64, got {dtype}: convert all arguments")
        if value.device != device:
            raise ValueError(f"{name} is on {value.device} and {first} on {device}; move one")
        if value.dtype != dtype:
            raise ValueError(f"{name} is {value.dtype} and {first} {dtype}; convert {name} to {dtype}")


def gaussians_of(
    function: str,  # name of the public function
    whole: Scene,  # its arguments, with all batch dimensions
    sh_degree: int | None,
    render_mode: str,  # without "RGB", colours are not rendered
    raw: bool = False,  # whether scales and opacities are before their activation
) -> Gaussians:
    """Check shapes and fold the batch dimensions into one (ValueError: a wrong shape, by name)."""
    means, _, _, opacities, colors, viewmats, Ks, *_ = whole
    if Ks.requires_grad and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        warn_of_gradient(function)
    if means.dim() < 2 or viewmats.dim() < 3:
        raise ValueError(
            f"means must be [..., N, 3] and viewmats [..., C, 4, 4], got {list(means.shape)} and "
            f"{list(viewmats.shape)}"
        )
    batch, N, C = tuple(means.shape[:-2]), means.shape[-2], viewmats.shape[-3]
    for name, first, last in _SHAPES:  # another shape might broadcast
        tensor, shape = getattr(whole, name), (*batch, N if first == "N" else C, *last)
        if tensor.shape != shape:
            refuse_shape(name, tensor, shape, ", ".join(map(str, (first, *last))))
    with_colors = "RGB" in render_mode
    if colors is None and with_colors:
        raise ValueError("colors may be None for the render modes D and ED alone")
    if colors is not None and sh_degree is not None and batch and colors.dim() == 3:
        colors = colors.expand(*batch, *colors.shape)  # gsplat main's form: the same SH in all scenes
    per_view = colors is not None and _per_view(colors, batch, C, N, sh_degree)
    colors = colors if with_colors else None
    most = MAX_CHANNELS - (render_mode != "RGB")  # the depth is a channel too
    if colors is not None and not 1 <= colors.shape[-1] <= most:
        raise ValueError(f"colors must have 1 to {most} channels, got {colors.shape[-1]}")
    degree = sh_degree if with_colors else None
    if (
        colors is not None
        and degree is not None
        and (degree > KERNEL_SH_DEGREE or colors.shape[-1] != KERNEL_SH_CHANNELS)
    ):
        colors = colors_of_views(degree, means, viewmats, colors, per_view)
        per_view, degree = True, None
    whole = whole._replace(colors=colors)
    scenes = _scenes(whole, batch) if batch else (whole,)
    columns = zip(Scene._fields, zip(*scenes, strict=True), strict=True)
    named = {name: own for name, own in columns if own[0] is not None}
    return Gaussians(function, scenes, colors, opacities, degree, per_view, (*batch, C), raw, named)


@cache
def warn_of_gradient(function: str) -> None:
    """Warn, once, that intrinsics which require a gradient get none."""
    warn(
        f"blitzgs.{function}: Ks requires a gradient and gets none, as in gsplat; pass Ks.detach()",
        RuntimeWarning,
    )


def _scenes(whole: Scene, batch: tuple[int, ...]) -> tuple[Scene, ...]:
    count = math.prod(batch)
    if count == 0:
        raise ValueError(f"the batch {[*batch]} is empty")
    # Unbind each tensor once: the gradient of this is one stack, not a sum of tensors as large as the batch.
    columns = (
        [None] * count if t is None else t.reshape(count, *t.shape[len(batch) :]).unbind(0) for t in whole[:7]
    )
    return tuple(Scene(*tensors) for tensors in zip(*columns, strict=True))


def _per_view(colors: Tensor, batch: tuple[int, ...], C: int, N: int, sh_degree: int | None) -> bool:
    """Check the shape of colours; return whether each view has its own."""
    wanted = "[..., N, D] or [..., C, N, D]"
    shape = tuple(colors.shape[:-1])
    if sh_degree is not None:
        wanted = "SH coefficients [..., N, K, D], [..., C, N, K, D] or [N, K, D] when sh_degree is given"
        shape = tuple(colors.shape[:-2])
    # Two comparisons: torch.compile does not find sizes that vary in a tuple of shapes.
    if (shape != (*batch, N) and shape != (*batch, C, N)) or colors.dim() < 2:
        hint = "; SH coefficients need sh_degree" if sh_degree is None and shape[:-1] == (*batch, N) else ""
        raise ValueError(
            f"colors must be {wanted}, here with {[*batch]} before N = {N}, C = {C}, got "
            f"{list(colors.shape)}{hint}"
        )
    if sh_degree is not None and (sh_degree + 1) ** 2 > colors.shape[-2]:
        raise ValueError(
            f"sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} SH coefficients, got {colors.shape[-2]}"
        )
    return shape != (*batch, N)


def refuse_shape(name: str, tensor: Tensor, shape: tuple[int, ...], described: str) -> NoReturn:
    """Raise a ValueError that names a tensor, the shape that it must have, and its own."""
    raise ValueError(f"{name} must be [..., {described}] = {[*shape]}, got {list(tensor.shape)}")
