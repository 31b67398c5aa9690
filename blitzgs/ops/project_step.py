# SPDX-License-Identifier: Apache-2.0
"""From the gradients of projected rows straight to an optimiser step of the Gaussians they are of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs.ops.lazy_adam import explicit_steps, schedule_table
from blitzgs.ops.project import Rows
from blitzgs.ops.scatter import NO_TABLES, RowTables


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
    rows: Rows,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int,
    eps2d: float,
    antialiased: bool,
    v_means2d: Tensor | None = None,
    v_conics: Tensor | None = None,
    v_opacities: Tensor | None = None,
    v_colors: Tensor | None = None,
    scale_reg: Tensor | None = None,
    tables: RowTables = NO_TABLES,
    means2d_sums: Tensor | None = None,
) -> None:
    """Take Adam step ``step`` for the visible Gaussians, in place, with the gradients of their rows.

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
        rows: what `project` made of these parameters and views: P rows.
        viewmats: [B, 4, 4], as for `project`, like the next six.
        Ks: [B, 3, 3].
        width: image width in px.
        height: image height in px.
        sh_degree: degree that was evaluated.
        eps2d: variance added to both screen axes, px^2.
        antialiased: whether opacities were compensated for that.
        v_means2d: gradient of `rows.means2d`, [P, 2].
        v_conics: gradient of `rows.conics`, [P, 3].
        v_opacities: gradient of `rows.opacities`, [P].
        v_colors: gradient of `rows.colors`, [P, 3].
        scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no such
            term.
        tables: instead of the four gradients, where they lie (CUDA).
        means2d_sums: [P, 2], becomes the gradient of `rows.means2d` from tables.

    The four gradients may be views of one table, in this order: on CUDA, one of 12 floats a row
    (`blitzgs.ops.rasterize.gradient_columns`) is read where it lies.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    torch.ops.blitzgs.project_bwd_step_(
        list(params), list(exp_avgs), list(exp_avg_sqs), last_step, moment_step,
        schedule_table(lr_table, beta1, beta2), lr_table, step, explicit_steps(beta1, beta2, params[0].dtype),
        beta1, beta2, eps, sparse, viewmats, Ks, rows.camera_ids, rows.visible_ids, rows.row_offsets, width,
        height, sh_degree, eps2d, antialiased, v_means2d, v_conics, v_opacities, v_colors, scale_reg,
        *tables, means2d_sums,
    )  # fmt: skip


@torch.library.register_fake("blitzgs::project_bwd_step_")
def _(*args: Any) -> None:
    return None
