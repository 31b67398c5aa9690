# SPDX-License-Identifier: Apache-2.0
"""Takes an optimiser step of Gaussians directly from the gradients of their projected splats."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.lazy_adam import AdamSchedule, AdamState
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions, WeightedViews
from blitzgs.ops.splat_gradients import SplatGradients


def project_bwd_step_(
    state: AdamState,
    schedule: AdamSchedule,
    step: int,
    views: WeightedViews,
    splats: ProjectedSplats,
    options: ProjectionOptions,
    gradients: SplatGradients,
    level: Tensor | None = None,
    means2d_sums: Tensor | None = None,
) -> None:
    """Take Adam step ``step`` for the visible Gaussians, in place, with the gradients of their splats.

    The result is that of the backward pass of `blitzgs.ops.project.project` followed by
    `blitzgs.ops.lazy_adam.lazy_adam_step_`, to rounding. On CUDA the gradients of the parameters are never
    stored. The parameters of the visible Gaussians must be at ``step`` - 1 (`lazy_adam_catch_up_`), as when
    they were projected.

    Args:
        state: parameters before their activation, float32 or (CPU) float64, and their moments; `last_step`
            and `moment_step` become `step` for the visible Gaussians.
        schedule: of S steps, for the dtype of the parameters.
        step: 1 <= step <= S.
        views: the views that the splats were projected into, and the weights of regularisers.
        splats: the P splats that `project` returned for these parameters and views.
        options: the options of the projection; scales and opacities are taken before their activation.
        gradients: of the splats.
        level: uint8 [N], octree levels, if opacities fade with them (`options.fade`).
        means2d_sums: [P, 2], receives the gradient of `splats.means2d` if `gradients` has a part per rank.

    Raises:
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    with below_autograd():
        torch.ops.blitzgs.project_bwd_step_(
            state.tensors,
            [schedule.table, schedule.lr_table],
            *schedule.constants(step),
            *views,
            splats.camera_ids,
            splats.visible_ids,
            splats.splat_offsets,
            level,
            *options,
            gradients.parts,
            gradients.places,
            means2d_sums,
        )
