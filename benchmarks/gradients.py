# SPDX-License-Identifier: Apache-2.0
"""Gradients of a frame's parameters, which training never stores: for tests and for measuring errors."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.frame.render import Frame, backward_splats
from blitzgs.ops.projection_types import WeightedViews
from blitzgs.table.table import GaussianTable


def parameter_gradients(
    table: GaussianTable, frame: Frame, v_renders: Tensor, *weights: Tensor | None
) -> list[Tensor]:
    """Return the gradients of the U visible Gaussians' parameters, from those of a frame's images.

    ``weights``: of regularisers, as those of `WeightedViews`.
    """
    gradients, projected = backward_splats(frame, v_renders), frame.projected
    options = frame.options.projection(frame.views)
    *parameters, _ = torch.ops.blitzgs.project_bwd(
        list(table.parameters), *WeightedViews(frame.views.viewmats, frame.views.Ks, *weights),
        projected.camera_ids, projected.visible_ids, projected.splat_offsets, None, *options,
        list(gradients.parts), None, False,
    )  # fmt: skip
    return parameters
