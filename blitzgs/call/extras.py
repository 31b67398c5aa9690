# SPDX-License-Identifier: Apache-2.0
"""Optional arguments of calls: signals beside the colours, covariances, lenses, and pixels to render."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from blitzgs.call.arguments import MAX_CHANNELS, Gaussians, Signals, check_choice, refuse_shape
from blitzgs.call.covariances import decompose
from blitzgs.ops.unscented import GLOBAL_SHUTTER, Lenses, largest_angles

NORMAL_CHANNELS = 3
_MAX_DEGREE = 3  # of the SH of signals
# gsplat's RollingShutterType, by number.
_SHUTTERS = (
    "ROLLING_TOP_TO_BOTTOM", "ROLLING_LEFT_TO_RIGHT", "ROLLING_BOTTOM_TO_TOP", "ROLLING_RIGHT_TO_LEFT",
    "GLOBAL",
)  # fmt: skip
# gsplat's UnscentedTransformParameters.
_UT_PARAMS = ("alpha", "beta", "kappa", "in_image_margin_factor", "require_all_sigma_points_valid")


def with_signals(gaussians: Gaussians, values: Tensor, sh_degree: int | None) -> Gaussians:
    """Return Gaussians with extra signals (ValueError: a shape, degree or width does not fit)."""
    batch, views, count = gaussians.lead[:-1], gaussians.views, gaussians.n_gaussians
    shape, per_view = tuple(values.shape), False
    most = MAX_CHANNELS - NORMAL_CHANNELS - 1
    most -= 0 if gaussians.colors is None else gaussians.colors.shape[-1]
    if shape and shape[-1] > most:
        raise ValueError(f"extra_signals must have 1 to {most} channels, got {shape[-1]}")
    if sh_degree is None:
        per_view = shape[:-1] == (*batch, views, count)
        wanted, fits = "[..., N, E] or [..., C, N, E]", per_view or shape[:-1] == (*batch, count)
    else:
        whole = isinstance(sh_degree, (Integral, torch.SymInt)) and not isinstance(sh_degree, bool)
        if not whole or not 0 <= sh_degree <= _MAX_DEGREE:
            raise ValueError(f"extra_signals_sh_degree must be None or 0 to {_MAX_DEGREE}, got {sh_degree!r}")
        least = (sh_degree + 1) ** 2
        wanted = f"SH coefficients [N, K, E] or [..., N, K, E] with K of at least {least}"
        if batch and len(shape) == 3 and shape[0] == count:  # all scenes share them, as in gsplat
            values = values.expand(*batch, *shape)
        fits = values.shape[:-2] == (*batch, count) and values.shape[-2] >= least
    if not fits or shape[-1] == 0:
        raise ValueError(
            f"extra_signals must be {wanted}, here with {[*batch]} before N = {count}, C = {views}, got "
            f"{[*shape]}"
        )
    scenes_of = (len(gaussians.scenes), *values.shape[len(batch) :])
    own = values.reshape(scenes_of).unbind(0) if batch else (values,)
    named = {**gaussians.named, "extra_signals": own}
    return gaussians._replace(named=named, signals=Signals(values, sh_degree, per_view))


def with_covariances(
    gaussians: Gaussians, covars: Tensor, sparse_grad: bool, return_normals: bool
) -> Gaussians:
    """Return Gaussians with axes of covariances (ValueError: wrong shape, or a switch is on)."""
    if sparse_grad:
        raise ValueError("sparse_grad does not support covars; leave one of them out")
    if return_normals:
        raise ValueError("return_normals does not support covars, whose axes have no order; leave one out")
    wanted = (*gaussians.lead[:-1], gaussians.n_gaussians, 3, 3)
    if covars.shape != wanted:
        refuse_shape("covars", covars, wanted, "N, 3, 3")
    found = [decompose(own) for own in covars.reshape(len(gaussians.scenes), *wanted[-3:]).unbind(0)]
    scenes = tuple(
        scene._replace(quats=own.quats, scales=own.scales, covariances=own)
        for scene, own in zip(gaussians.scenes, found, strict=True)
    )
    named = {name: given for name, given in gaussians.named.items() if name not in ("quats", "scales")}
    named["covars"] = tuple(own.upper for own in found)
    return gaussians._replace(scenes=scenes, named=named)


def check_without_ut(camera_model: str, rolling_shutter: Any, others: Mapping[str, object]) -> None:
    """Refuse arguments that need `with_ut` in a call without it (ValueError: the first one, by name)."""
    given = [name for name, value in others.items() if value is not None]
    given += ["rolling_shutter"] if _shutter(rolling_shutter) != GLOBAL_SHUTTER else []
    given += [f"camera_model={camera_model!r}"] if camera_model != "pinhole" else []
    if given:
        raise ValueError(f"{given[0]} needs with_ut=True; give both, or leave it out")


def with_lenses(
    gaussians: Gaussians,
    camera_model: str,
    rolling_shutter: Any,
    ut_params: Any,
    refused: Mapping[str, bool],  # unsupported arguments, by what to call them: are they given?
    lens: Mapping[str, Tensor | None],  # radial_coeffs to viewmats_rs
) -> Gaussians:
    """Return Gaussians whose scenes have lenses; the arguments are those of `blitzgs.rasterization`.

    ValueError: one is, a shape or value is wrong, or two arguments do not go together.
    """
    lead, first = gaussians.lead, gaussians.scenes[0].viewmats
    compiled = {"torch.compile": torch.compiler.is_compiling()}
    learned = {"a gradient of viewmats": torch.is_grad_enabled() and first.requires_grad}
    # Torch would drop them without a word.
    tensors = (t for scene in gaussians.scenes for t in scene if isinstance(t, Tensor))
    learned["forward-mode derivatives"] = any(unpack_dual(t).tangent is not None for t in tensors)
    for name, is_given in {**refused, **compiled, **learned}.items():
        if is_given:
            raise ValueError(f"with_ut does not support {name}; leave one of them out")
    fisheye = camera_model == "fisheye"
    given: dict[str, Tensor] = {}
    for name, last in (
        ("radial_coeffs", (4,) if fisheye else (6,)), ("tangential_coeffs", (2,)),
        ("thin_prism_coeffs", (4,)), ("viewmats_rs", (4, 4)),
    ):  # fmt: skip
        if (tensor := lens[name]) is None:
            continue
        if tensor.shape != (*lead, *last):
            refuse_shape(name, tensor, (*lead, *last), ", ".join(map(str, ("C", *last))))
        if fisheye and name in ("tangential_coeffs", "thin_prism_coeffs"):
            raise ValueError(f"a fisheye has no {name}; leave it out")
        given[name] = tensor.detach().reshape(gaussians.images, *last)
    shutter = _shutter(rolling_shutter)
    if (shutter == GLOBAL_SHUTTER) != ("viewmats_rs" not in given):
        raise ValueError("a rolling shutter needs viewmats_rs, and a global one has none")
    lenses = first.new_zeros(gaussians.images, 13)
    lenses[:, 12] = math.inf
    for name, begin in (("radial_coeffs", 0), ("tangential_coeffs", 6), ("thin_prism_coeffs", 8)):
        if name in given:
            lenses[:, begin : begin + given[name].shape[1]] = given[name]
    if fisheye and "radial_coeffs" in given:
        lenses[:, 12] = largest_angles(given["radial_coeffs"])
    whole = Lenses(lenses, given.get("viewmats_rs"), fisheye, shutter)
    if ut_params is not None:
        whole = whole._replace(transform=tuple(float(getattr(ut_params, name)) for name in _UT_PARAMS))
    views = gaussians.views
    scenes = tuple(
        scene._replace(lenses=whole.rows(s * views, (s + 1) * views))
        for s, scene in enumerate(gaussians.scenes)
    )
    named = {name: tuple(tensor.split(views)) for name, tensor in given.items()}
    return gaussians._replace(scenes=scenes, named={**gaussians.named, **named})


def _shutter(value: Any) -> int:
    """Return the number of a RollingShutterType, given as gsplat's or by name; None: GLOBAL."""
    name = "GLOBAL" if value is None else getattr(value, "name", value)
    check_choice("rolling_shutter", name, _SHUTTERS)
    return _SHUTTERS.index(name)


class Pixels(NamedTuple):
    """The pixels of a call."""

    numbers: Tensor  # int64 [M], (image H + row) W + column
    images: Tensor  # int64 [M], the image of each
    rows: Tensor  # int64 [M]
    columns: Tensor  # int64 [M]


def checked_pixels(
    pixels: Tensor | None, image_ids: Tensor | None, images: int, width: int, height: int
) -> Pixels | None:
    """Check `pixels` and `image_ids` of `blitzgs.rasterization`; None: there are none.

    TypeError: they are not tensors of integers. ValueError: a shape does not fit, a pixel is outside the
    images, or there are several images and no `image_ids`.
    """
    if pixels is None:
        if image_ids is not None:
            raise ValueError("image_ids need pixels; give both")
        return None
    if image_ids is None and images != 1:
        raise ValueError(f"pixels of {images} images need image_ids, the image of each pixel")
    for name, values in (("pixels", pixels), ("image_ids", image_ids)):
        if values is None:
            continue
        if not isinstance(values, Tensor) or values.is_floating_point() or values.dtype == torch.bool:
            raise TypeError(f"{name} must be a tensor of integers")
    if pixels.dim() != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels must be [M, 2] (row, column), got {[*pixels.shape]}")
    if image_ids is None:
        image_ids = torch.zeros_like(pixels[:, 0])
    if image_ids.shape != pixels.shape[:1]:
        raise ValueError(f"image_ids must be [M] = {[len(pixels)]}, got {[*image_ids.shape]}")
    places = torch.stack([image_ids.long(), *pixels.long().unbind(1)], dim=1)
    outside = ((places < 0) | (places >= places.new_tensor([images, height, width]))).any(dim=1)
    if outside.any():
        first = int(outside.nonzero()[0, 0])
        image, row, column = places[first].tolist()
        raise ValueError(
            f"pixel {first} is (row, column) = ({row}, {column}) of image {image}, outside {images} "
            f"images of {height} x {width} px"
        )
    image, row, column = places.unbind(dim=1)
    return Pixels((image * height + row) * width + column, image, row, column)
