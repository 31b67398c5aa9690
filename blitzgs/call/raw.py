# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.raw_rasterization`: renders raw parameters, at a cost that follows the visible Gaussians."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import not_compiled
from blitzgs.call.arguments import (
    ANY,
    GSPLAT_DEFAULTS,
    KERNEL_SH_DEGREE,
    RENDER_MODES,
    Scene,
    check_choice,
    check_further,
    check_tensors,
    checked_options,
    gaussians_of,
)
from blitzgs.call.channels import ImageOptions, background_rows
from blitzgs.call.rasterize import rasterization
from blitzgs.call.render import ShTables, render
from blitzgs.ops.derivatives import of_shape
from blitzgs.ops.intersect import TILE_SIZE


@not_compiled
def raw_rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int | None = TILE_SIZE,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = True,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    optimizers: Any = (),
    **further: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians from the parameters that gsplat's trainer learns, before their activation.

    The result is that of `blitzgs.rasterization` with `exp(scales)`, `sigmoid(opacities)` and `cat([sh0,
    shN], 1)`, but none of these tensors is made: the function first finds the visible Gaussians, and only
    gathers, activates and renders these. Gradients are sparse and have only the visible Gaussians, so the
    parameters must be leaves, or `sparse_grad` False. `torch.compile` runs it as it is, between two graphs.

    Args:
        means: [N, 3] in world units, float32, or float64 on the CPU.
        quats: [N, 4] (w, x, y, z), of any length; zero counts as the identity, with the gradient zero.
        scales: [N, 3] logarithms of standard deviations.
        opacities: [N] or [N, 1] logits.
        sh0: [N, 1, 3] or [N, 3], the first SH coefficient; or all of them, [N, K, 3], with shN None.
        shN: [N, K - 1, 3], the other SH coefficients.
        viewmats, Ks, width, height, near_plane, far_plane, radius_clip, eps2d, tile_size, backgrounds,
            render_mode, absgrad, rasterize_mode: as in `blitzgs.rasterization`, without batch dimensions.
        sh_degree: degree to evaluate, 0 to 3; None: the highest degree that the coefficients have.
        sparse_grad: False: dense gradients, for parameters that are not leaves (`means + offsets`), and for
            optimisers, gradient clipping and torch's DistributedDataParallel, which take no others.
        optimizers: the parameters' optimisers: one, a mapping or a sequence. Each `blitzgs.optim.LazyAdam`
            among them catches up the rows that this call reads: the geometry of all Gaussians, and the SH of
            the visible ones. Before other tensors are made of its parameters (`means + offsets`), call its
            `catch_up`; views and detached parameters share their memory, and need no call.
        further: gsplat's other arguments; only those values are accepted that do not change the result
            (`packed=True`, `distributed=False`, `camera_model="pinhole"`, `covars=None`, ...).

    Returns:
        As `blitzgs.rasterization(..., packed=True)`.

    Warns, raises:
        As `blitzgs.rasterization`; also a TypeError if `optimizers` are no optimisers, and a ValueError if a
        parameter is not a leaf, but would get a sparse gradient. The message names it.
    """
    if further:
        check_further("raw_rasterization", further, _defaults())
    projection = checked_options(
        width,
        height,
        near_plane,
        far_plane,
        radius_clip,
        eps2d,
        sh_degree,
        tile_size,
        rasterize_mode,
        raw=True,
    )
    check_choice("render_mode", render_mode, RENDER_MODES)
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh0": sh0}
    check_tensors({**tensors, "viewmats": viewmats, "Ks": Ks}, {"shN": shN, "backgrounds": backgrounds})
    if means.dim() != 2:
        raise ValueError(f"means must be [N, 3], got {list(means.shape)}")
    shaded = "RGB" in render_mode
    # The parameters themselves, not their other shapes: optimisers know these.
    params = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    sh_params = {"sh0": sh0} if shN is None else {"sh0": sh0, "shN": shN}
    harmonics = list(sh_params.values())
    lazy = _lazy(optimizers)
    if lazy:  # before views of the parameters are made, which would be out of date
        _catch_up(lazy, params.values(), harmonics)
    if opacities.dim() == 2 and opacities.shape[1] == 1:
        tensors["opacities"] = opacities = of_shape(opacities, opacities.shape[:1])
    if sh0.dim() == 2 and sh0.shape[1] == 3:
        tensors["sh0"] = sh0 = harmonics[0] = of_shape(sh0, (len(sh0), 1, 3))
    sh_degree = _checked_degree(harmonics, len(means), sh_degree, shaded)
    projection = projection._replace(sh_degree=sh_degree)
    scene = Scene(means, quats, scales, opacities, None, viewmats, Ks)
    # The SH are not part of the scene: only their visible rows are read.
    whole = gaussians_of("raw_rasterization", scene, sh_degree=None, render_mode="D", raw=True)
    if sparse_grad and torch.is_grad_enabled():
        _check_leaves(params | sh_params if shaded else params)
    given = {**tensors, "viewmats": viewmats, "Ks": Ks, "shN": shN}
    if not shaded:
        del given["sh0"], given["shN"]
    named = {name: (tensor,) for name, tensor in given.items() if tensor is not None}
    colors, degree = (sh0, sh_degree) if shaded else (None, None)
    gaussians = whole._replace(colors=colors, sh_degree=degree, named=named)
    background = background_rows(backgrounds, gaussians, render_mode)
    image = ImageOptions(render_mode, background, packed=True, sparse_grad=sparse_grad, absgrad=absgrad)

    def catch_up_sh(rows: Tensor, count: Tensor | None) -> None:
        for optimizer in lazy:
            optimizer.catch_up(sh_params.values(), rows, count)

    return render(gaussians, projection, image, tables=ShTables(harmonics if shaded else (), catch_up_sh))


@cache
def _defaults() -> dict[str, Any]:
    """Return what only `rasterization` takes, with the defaults; other values are not supported here."""
    parameters = inspect.signature(rasterization).parameters.values()
    given = {p.name: p.default for p in parameters if p.default is not p.empty}
    return {**GSPLAT_DEFAULTS, **given, "channel_chunk": ANY, "segmented": ANY}


def _catch_up(lazy: Iterable[Any], geometry: Iterable[Tensor], sh: Iterable[Tensor]) -> None:
    """Catch up the geometry, and whole parameters whose memory a tensor shares: a view, or a detached one."""
    stepped = {id(param) for optimizer in lazy for param in optimizer.state}
    memory = {t.untyped_storage().data_ptr() for t in (*geometry, *sh) if id(t) not in stepped}
    for optimizer in lazy:
        optimizer.catch_up(geometry)
        if memory:
            shared = [param for param in optimizer.state if param.untyped_storage().data_ptr() in memory]
            optimizer.catch_up(shared)


def _check_leaves(params: Mapping[str, Tensor]) -> None:
    """Check that parameters with gradients are leaves: few operations accept a sparse gradient."""
    for name, param in params.items():
        if param.requires_grad and not param.is_leaf:
            raise ValueError(
                f"{name} is not a leaf, and its gradient would be sparse: pass the parameter itself, or "
                "sparse_grad=False"
            )


def _lazy(optimizers: Any) -> list[Any]:
    """Return the optimisers that may have pending steps, as `blitzgs.optim.LazyAdam`."""
    if isinstance(optimizers, torch.optim.Optimizer) or hasattr(optimizers, "catch_up"):
        optimizers = [optimizers]
    if not isinstance(optimizers, Iterable):
        raise TypeError(
            "optimizers must be an optimiser, or a mapping or a sequence of them, got "
            f"{type(optimizers).__name__}"
        )
    given = list(optimizers.values() if isinstance(optimizers, Mapping) else optimizers)
    for optimizer in given:
        # Without this check, a name or a parameter in place of its optimiser would leave rows behind.
        if not hasattr(optimizer, "step") and not hasattr(optimizer, "catch_up"):
            raise TypeError(f"optimizers must be optimisers, got {type(optimizer).__name__} among them")
    return [optimizer for optimizer in dict.fromkeys(given) if hasattr(optimizer, "catch_up")]


def _checked_degree(harmonics: list[Tensor], count: int, degree: int | None, shaded: bool) -> int:
    """Check the SH and return the degree to evaluate."""
    for name, part in zip(("sh0", "shN"), harmonics, strict=False):
        if part.dim() != 3 or part.shape[0] != count or part.shape[2] != 3:
            raise ValueError(f"{name} must be [N, K, 3] with N = {count}, got {list(part.shape)}")
    given = sum(part.shape[1] for part in harmonics)
    if degree is None:
        degree = math.isqrt(given) - 1
        if shaded and not 0 <= degree <= KERNEL_SH_DEGREE:
            raise ValueError(f"sh_degree=None needs 1 to 24 SH coefficients, got {given}")
        return degree
    if degree > KERNEL_SH_DEGREE:
        raise ValueError(f"raw_rasterization takes sh_degree 0 to 3, got {degree}; use rasterization")
    if shaded and (degree + 1) ** 2 > given:
        raise ValueError(f"sh_degree {degree} needs {(degree + 1) ** 2} SH coefficients, got {given}")
    return degree
