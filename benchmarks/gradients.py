# SPDX-License-Identifier: Apache-2.0
"""Gradients of a frame's parameters, which training never stores: for tests and for measuring errors."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.frame.render import Frame, backward_splats
from blitzgs.ops.projection_types import WeightedViews
from blitzgs.ops.splat_gradients import SplatGradients
from blitzgs.table.table import GaussianTable


def sum_of_ranks(gradients: SplatGradients, splats: int) -> Tensor:
    """Return the gradients of a rank's splats that lie at several ranks, added up: [P, 12]."""
    assert gradients.places is not None
    total = torch.zeros(splats, 12, device=gradients.places.device)
    for m, part in enumerate(gradients.parts):
        runs = gradients.places[:, m, None]
        first, bits = runs.bitwise_and(0xFFFFFFFF), runs >> 32
        here = bits >> torch.arange(32, device=runs.device) & 1
        at = (first + here.cumsum(1) - here).flatten()[:splats]
        here = here.flatten()[:splats].bool()
        total[here] += part[at[here]]
    return total


def parameter_gradients(
    table: GaussianTable, frame: Frame, v_renders: Tensor, *weights: Tensor | None
) -> list[Tensor]:
    """Return the gradients of the U visible Gaussians' parameters, from those of a frame's images.

    ``weights``: of regularisers, as those of `WeightedViews`.
    """
    gradients, projected = backward_splats(frame, v_renders), frame.projected
    options = frame.options.projection(frame.views)
    parts = gradients.parts
    if gradients.places is not None:
        parts = [sum_of_ranks(gradients, len(projected.means2d))]
    *parameters, _ = torch.ops.blitzgs.project_bwd(
        list(table.parameters), *WeightedViews(frame.views.viewmats, frame.views.Ks, *weights),
        projected.camera_ids, projected.visible_ids, projected.splat_offsets, None, *options,
        list(parts), None, False,
    )  # fmt: skip
    return parameters
