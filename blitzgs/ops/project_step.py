# SPDX-License-Identifier: Apache-2.0
"""From the gradients of projected splats straight to an optimiser step of the Gaussians they are of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs.ops.lazy_adam import explicit_steps, schedule_table
from blitzgs.ops.projection import ProjectedSplats, ProjectionOptions
from blitzgs.ops.splat_gradients import SplatGradients


@torch.no_grad()
def project_bwd_step_(
    params: Sequence[Tensor],
    exp_avgs: Sequence[Tensor],
    exp_avg_sqs: Sequence[Tensor],
    last_step: Tensor,
    moment_step: Tensor,
    lr_table: Tensor,
    step: int,
    beta1: float,
    beta2: float,
    eps: float,
    sparse: bool,
    splats: ProjectedSplats,
    cameras: Sequence[Tensor],
    options: ProjectionOptions,
    gradients: SplatGradients,
    scale_reg: Tensor | None = None,
    means2d_sums: Tensor | None = None,
    opacity_reg: Tensor | None = None,
    level: Tensor | None = None,
    absolute_sums: bool = False,
) -> None:
    """Take Adam step ``step`` for the visible Gaussians, in place, with the gradients of their splats.

    What the backward pass of `blitzgs.ops.project.project` and `blitzgs.ops.lazy_adam.lazy_adam_step_` do one
    after the other, to rounding; on CUDA the gradients of the parameters are never stored. The parameters of
    the visible Gaussians must stand at ``step`` - 1 (`lazy_adam_catch_up_`), as when they were projected.

    Args:
        params: (means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3]) before their
            activation, float32 or (CPU) float64.
        exp_avgs: as for `lazy_adam_step_`, like the next eight.
        exp_avg_sqs: second moments, shaped like `params`.
        last_step: int32 [N]; becomes `step` for the visible Gaussians.
        moment_step: int32 [N]; becomes `step` for the visible Gaussians.
        lr_table: float32 [S + 1, 6].
        step: 1 <= step <= S.
        beta1: decay of the first moment, below sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).
        eps: added to the root of the second moment.
        sparse: plain sparse Adam.
        splats: what `project` made of these parameters and views: P splats.
        cameras: viewmats [B, 4, 4] and Ks [B, 3, 3], as for `project`.
        options: with which the splats were projected; scales and opacities are taken before their activation.
        gradients: of the splats.
        scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no such
            term.
        means2d_sums: [P, 2], becomes the gradient of `splats.means2d` where `gradients` has it at ranks.
        opacity_reg: as `scale_reg`, of the opacity (without the compensation of antialiased splats).
        level: uint8 [N], octree levels, where opacities fade by them (`options.fade`).
        absolute_sums: `means2d_sums` becomes the sum over pixels of its absolute values instead.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    torch.ops.blitzgs.project_bwd_step_(
        list(params),
        list(exp_avgs),
        list(exp_avg_sqs),
        [last_step, moment_step],
        [schedule_table(lr_table, beta1, beta2), lr_table],
        [step, explicit_steps(beta1, beta2, params[0].dtype), int(sparse)],
        [beta1, beta2, eps],
        list(cameras),
        [splats.camera_ids, splats.visible_ids, splats.splat_offsets],
        options.ints,
        options.floats,
        list(gradients.parts),
        gradients.places,
        scale_reg,
        means2d_sums,
        opacity_reg,
        level,
        absolute_sums,
    )


@torch.library.register_fake("blitzgs::project_bwd_step_")
def _(*args: Any) -> None:
    return None
