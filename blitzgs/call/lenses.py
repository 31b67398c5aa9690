# SPDX-License-Identifier: Apache-2.0
"""Checks the arguments of `blitzgs.rasterization` for distorting lenses and rolling shutters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians, refuse_shape
from blitzgs.ops.unscented import GLOBAL_SHUTTER, Lenses, largest_angles

# gsplat's RollingShutterType, by number.
_SHUTTERS = (
    "ROLLING_TOP_TO_BOTTOM", "ROLLING_LEFT_TO_RIGHT", "ROLLING_BOTTOM_TO_TOP", "ROLLING_RIGHT_TO_LEFT",
    "GLOBAL",
)  # fmt: skip
# gsplat's UnscentedTransformParameters.
_UT_PARAMS = ("alpha", "beta", "kappa", "in_image_margin_factor", "require_all_sigma_points_valid")


def check_without_ut(camera_model: str, rolling_shutter: Any, others: Mapping[str, object]) -> None:
    """Check a call without with_ut: it has none of the arguments that need it.

    ValueError: it has one, by name.
    """
    given = [name for name, value in others.items() if value is not None]
    given += ["rolling_shutter"] if _shutter(rolling_shutter) != GLOBAL_SHUTTER else []
    given += [f"camera_model={camera_model!r}"] if camera_model != "pinhole" else []
    if given:
        raise ValueError(f"{given[0]} needs with_ut=True; give both, or leave it out")


def check_with_ut(viewmats: Tensor, refused: Mapping[str, bool]) -> None:
    """Check that a call with with_ut has nothing that the unscented projection does not support.

    `refused`: whether arguments that it does not support are given, by what to call them. ValueError: it has
    one, by name.
    """
    compiled = {"torch.compile": torch.compiler.is_compiling()}
    learned = {"a gradient of viewmats": torch.is_grad_enabled() and viewmats.requires_grad}
    for name, given in {**refused, **compiled, **learned}.items():
        if given:
            raise ValueError(f"with_ut does not support {name}; leave one of them out")


def with_lenses(
    gaussians: Gaussians,
    camera_model: str,
    rolling_shutter: Any,
    ut_params: Any,
    radial_coeffs: Tensor | None,
    tangential_coeffs: Tensor | None,
    thin_prism_coeffs: Tensor | None,
    viewmats_rs: Tensor | None,
) -> Gaussians:
    """Return Gaussians whose scenes have lenses; the arguments are those of `blitzgs.rasterization`.

    ValueError: a shape or value is wrong, or two arguments do not go together.
    """
    fisheye = camera_model == "fisheye"
    lead, first = gaussians.lead, gaussians.scenes[0].viewmats
    given: dict[str, Tensor] = {}
    for name, tensor, last in (
        ("radial_coeffs", radial_coeffs, (4,) if fisheye else (6,)),
        ("tangential_coeffs", tangential_coeffs, (2,)),
        ("thin_prism_coeffs", thin_prism_coeffs, (4,)),
        ("viewmats_rs", viewmats_rs, (4, 4)),
    ):
        if tensor is None:
            continue
        if tensor.shape != (*lead, *last):
            refuse_shape(name, tensor, (*lead, *last), ", ".join(map(str, ("C", *last))))
        if fisheye and name in ("tangential_coeffs", "thin_prism_coeffs"):
            raise ValueError(f"a fisheye has no {name}; leave it out")
        given[name] = tensor.detach().reshape(gaussians.images, *last)
    shutter = _shutter(rolling_shutter)
    if (shutter == GLOBAL_SHUTTER) != (viewmats_rs is None):
        raise ValueError("a rolling shutter needs viewmats_rs, and a global one has none")
    lenses = first.new_zeros(gaussians.images, 13)
    lenses[:, 12] = math.inf
    for name, begin in (("radial_coeffs", 0), ("tangential_coeffs", 6), ("thin_prism_coeffs", 8)):
        if name in given:
            lenses[:, begin : begin + given[name].shape[1]] = given[name]
    if fisheye and radial_coeffs is not None:
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
    return replace(gaussians, scenes=scenes, named={**gaussians.named, **named})


def _shutter(value: Any) -> int:
    """Return the number of a RollingShutterType, given as gsplat's or by name; None: GLOBAL."""
    name = "GLOBAL" if value is None else getattr(value, "name", value)
    if name not in _SHUTTERS:
        raise ValueError(f"rolling_shutter must be one of {', '.join(_SHUTTERS)}, got {value!r}")
    return _SHUTTERS.index(name)
