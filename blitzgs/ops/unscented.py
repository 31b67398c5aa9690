# SPDX-License-Identifier: Apache-2.0
"""Projects Gaussians into views with distorting lenses or rolling shutters, by the unscented transform."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.derivatives import first_only
from blitzgs.ops.projection_types import N_OPTIONS, ProjectedSplats, ProjectionInputs

GLOBAL_SHUTTER = 4
# Angles at which the rise of a fisheye's polynomial is looked at, between the axis and its right angle.
_ANGLES = 4096


class Lenses(NamedTuple):
    """What B views have besides viewmats and intrinsics."""

    # [B, 13]: OpenCV's k1 to k6, p1, p2, s1 to s4, largest angle of a fisheye (`largest_angles`)
    lenses: Tensor
    viewmats_rs: Tensor | None = None  # [B, 4, 4], poses at the end of a rolling shutter's frame
    fisheye: bool = False  # whether k1 to k4 are those of OpenCV's fisheye, and the others unused
    # what is exposed first: 0 the top row, 1 the left column, 2 the bottom row, 3 the right one, 4 all
    shutter: int = GLOBAL_SHUTTER
    # Alpha, beta, kappa; how many image sizes beside the image a sigma point is valid; and whether all (1) or
    # some (0) of the points of a Gaussian have to be valid.
    transform: tuple[float, ...] = (0.1, 2.0, 0.0, 0.1, 0.0)

    def rows(self, begin: int, end: int) -> Lenses:
        """Return those of some of the views."""
        viewmats_rs = None if self.viewmats_rs is None else self.viewmats_rs[begin:end]
        return self._replace(lenses=self.lenses[begin:end], viewmats_rs=viewmats_rs)


def largest_angles(radial: Tensor) -> Tensor:
    """Return the angles to the axis up to which fisheyes with coefficients [..., 4] have pixels, [...].

    There the polynomial stops to rise; infinite if it rises up to the right angle.
    """
    t = torch.linspace(0, math.pi / 2, _ANGLES, dtype=torch.float64, device=radial.device)
    powers = torch.stack([(2 * i + 1) * t ** (2 * i) for i in range(1, 5)])
    rises = 1 + radial.double() @ powers
    falls = rises <= 0
    after = falls.double().argmax(dim=-1, keepdim=True).clamp(min=1)
    high, low = rises.gather(-1, after - 1), rises.gather(-1, after)
    angles = (t[after - 1] + t[1] * high / (high - low)).masked_fill(~falls.any(-1, keepdim=True), math.inf)
    return angles.squeeze(-1).to(radial.dtype)


def project_unscented(inputs: ProjectionInputs, lenses: Lenses) -> ProjectedSplats:
    """Project Gaussians by the unscented transform (3DGUT, Wu et al. 2025; csrc/project/unscented.h).

    A Gaussian has a splat if some of its sigma points (all, if so asked) are valid, and else by the rules of
    `blitzgs.ops.project.project`. Differentiable, once, in the Gaussians; viewmats get no gradient.
    Every Gaussian is projected into every view, and the host waits for the number of splats.

    Args:
        inputs: of the projection; `active`, `ids`, `level` and `options.fade` are not read.
        lenses: of its views.

    Returns:
        Splats as `blitzgs.ops.project.project` returns them.

    Raises:
        RuntimeError: an argument has a wrong shape, dtype or value; the message names it.
    """
    given = (inputs.gaussians, *inputs.cameras, *lenses, *inputs.options[: N_OPTIONS - 1])
    seen = torch.ops.blitzgs.unscented_visible(*given)
    gaussian_ids, camera_ids = seen.nonzero().int().t().contiguous()
    per_gaussian = seen.sum(dim=1, dtype=torch.int32)
    offsets = torch.nn.functional.pad(per_gaussian.cumsum(0, dtype=torch.int32), (1, 0))
    visible_ids = per_gaussian.nonzero()[:, 0].int()
    *columns, radii, tiles = torch.ops.blitzgs.unscented_fwd(*given, gaussian_ids, camera_ids, offsets)
    counts = torch.tensor([len(visible_ids), len(gaussian_ids), int(tiles.sum())], device="cpu")
    ends = offsets[1:].index_select(0, visible_ids)
    splat_offsets = torch.cat([offsets[:1], ends])
    masks = gaussian_ids.new_empty(0, dtype=torch.int64)
    ids = (gaussian_ids, camera_ids, visible_ids, splat_offsets)
    return ProjectedSplats._make((*ids, *columns, radii, tiles, masks, counts))


def _setup_context(ctx: Any, inputs: Any, output: Any) -> None:
    gaussians, viewmats, Ks, lenses, viewmats_rs, *options, _, camera_ids, offsets = inputs
    ctx.save_for_backward(*gaussians, viewmats, Ks, lenses, viewmats_rs, camera_ids, offsets)
    ctx.options = options
    # To torch an empty list of numbers is one of tensors; `transform` is none.
    ctx.no_gradients = [None] * (len(inputs) - 1)
    ctx.mark_non_differentiable(*output[-2:])


def _backward(ctx: Any, *v_output: Tensor) -> Any:
    *gaussians, viewmats, Ks, lenses, viewmats_rs, camera_ids, offsets = ctx.saved_tensors
    v_splats = v_output[: len(gaussians)]

    def compute() -> Sequence[Tensor]:
        found: Sequence[Tensor] = torch.ops.blitzgs.unscented_bwd(
            gaussians, viewmats, Ks, lenses, viewmats_rs, *ctx.options, camera_ids, offsets, v_splats
        )
        return found[: len(gaussians)]

    return list(first_only("project_unscented", compute, (*gaussians, *v_splats))), *ctx.no_gradients


torch.library.register_autograd("blitzgs::unscented_fwd", _backward, setup_context=_setup_context)
