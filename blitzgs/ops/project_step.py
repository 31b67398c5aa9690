# SPDX-License-Identifier: Apache-2.0
"""From the gradients of projected splats straight to an optimiser step of the Gaussians they are of."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, schedule_table
from blitzgs.ops.projection import ProjectedSplats, ProjectionOptions, WeightedViews
from blitzgs.ops.splat_gradients import SplatGradients


@torch.no_grad()
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
    absolute_sums: bool = False,
) -> None:
    """Take Adam step ``step`` for the visible Gaussians, in place, with the gradients of their splats.

    What the backward pass of `blitzgs.ops.project.project` and `blitzgs.ops.lazy_adam.lazy_adam_step_` do one
    after the other, to rounding; on CUDA the gradients of the parameters are never stored. The parameters of
    the visible Gaussians must stand at ``step`` - 1 (`lazy_adam_catch_up_`), as when they were projected.

    Args:
        state: parameters before their activation, float32 or (CPU) float64, and their moments; `last_step`
            and `moment_step` become `step` for the visible Gaussians.
        schedule: of S steps.
        step: 1 <= step <= S.
        views: what the splats were projected into, and the weights of regularisers.
        splats: what `project` made of these parameters and views: P splats.
        options: with which the splats were projected; scales and opacities are taken before their activation.
        gradients: of the splats.
        level: uint8 [N], octree levels, where opacities fade by them (`options.fade`).
        means2d_sums: [P, 2], becomes the gradient of `splats.means2d` where `gradients` has it at ranks.
        absolute_sums: `means2d_sums` becomes the sum over pixels of its absolute values instead.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    of_splats = [splats.camera_ids, splats.visible_ids, splats.splat_offsets]
    if gradients.places is not None:
        of_splats.append(gradients.places)
    torch.ops.blitzgs.project_bwd_step_(
        state.tensors,
        [schedule_table(schedule.lr_table, schedule.beta1, schedule.beta2), schedule.lr_table],
        schedule.steps(step, state.params[0].dtype),
        schedule.decays,
        list(views),
        of_splats,
        options.ints,
        options.floats,
        list(gradients.parts),
        level,
        means2d_sums,
        absolute_sums,
    )


@torch.library.register_fake("blitzgs::project_bwd_step_")
def _(*args: Any) -> None:
    return None
