# SPDX-License-Identifier: Apache-2.0
"""Dense Adam that updates only rows with a gradient and applies a row's missed steps later, in O(1)."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions
from blitzgs.ops.rasterize import SplatGradients

# Columns of the schedule's table, as in csrc/adam/lazy_adam.h: tails of 4 orders for 6 groups, powers of
# the decay rates, bias corrections.
ORDERS, GROUPS = 4, 6
_TAILS, _POWERS, CORRECTION1, CORRECTION2, _COLUMNS = slice(0, ORDERS * GROUPS), 24, 28, 29, 30
# Drift terms below this fraction of their sum are lost in rounding.
_NEGLIGIBLE = {torch.float32: 2.0**-27, torch.float64: 2.0**-56}


class AdamState(NamedTuple):
    """The optimiser's state of a table of N rows, as the ops that move parameters take it."""

    params: Sequence[Tensor]  # means [N, 3], quats, scales, opacities [N], sh [N, K, 3]; or one parameter
    exp_avgs: Sequence[Tensor]  # first moments, shaped like `params`
    exp_avg_sqs: Sequence[Tensor]  # second moments, shaped like `params`
    last_step: Tensor  # int32 [N], the step that each row's parameters stand at
    moment_step: Tensor  # int32 [N], <= `last_step`, the step that its moments stand at

    @property
    def tensors(self) -> list[Tensor]:
        """The group `state` of the ops (`AdamTensors` of csrc/adam/lazy_adam_op.h)."""
        return [*self.params, *self.exp_avgs, *self.exp_avg_sqs, self.last_step, self.moment_step]


class AdamTables:
    """Adam's constants and the tables of a schedule that the ops read, see csrc/adam/lazy_adam.h."""

    betas: tuple[float, float]  # decay rates of the moments
    eps: float  # added to the root of the second moment
    explicit_steps: int  # number of steps without a gradient for which a row still moves
    tables: list[Tensor]  # the group `tables` of the ops

    def constants(self, step: int) -> tuple[int, int, float, float, float]:
        """Return the arguments of the ops from `step` to `eps` for a row of the tables."""
        return (step, self.explicit_steps, *self.betas, self.eps)


class AdamSchedule(AdamTables):
    """The tables of a schedule whose learning rates are known in advance, made once for all steps."""

    lr_table: Tensor  # float32 [S + 1, 6], the learning rates of every step
    # float64 [S + 1, 30] on the device of `lr_table`: for each step, the sums that give a row's movement over
    # the steps it misses after that one (csrc/adam/lazy_adam.h).
    table: Tensor

    def __init__(
        self, lr_table: Tensor, beta1: float, beta2: float, eps: float, dtype: torch.dtype = torch.float32
    ) -> None:
        """Make the tables (ValueError: decay rates outside their range).

        Args:
            lr_table: float32 [S + 1, 6], learning rates of means, quats, scales, opacities, SH DC and SH rest
                for every step of the schedule (row 0 unused). It must not change afterwards.
            beta1: decay of the first moment, 0 <= beta1 < sqrt(beta2).
            beta2: decay of the second moment, in (0, 1).
            eps: as the attribute.
            dtype: of the parameters.
        """
        self.betas, self.eps = (beta1, beta2), eps
        self.explicit_steps = explicit_steps(beta1, beta2, dtype)
        self._take(_make_table(lr_table, beta1, beta2), lr_table, dtype)

    def _take(self, table: Tensor, lr_table: Tensor, dtype: torch.dtype) -> None:
        self.table, self.lr_table, self._dtype = table, lr_table, dtype
        # A rule applies all missed steps of a row `explicit_steps` or more behind; rules are indexed by
        # its last step: uint8 [max(0, S + 1 - explicit_steps), bytes], which only the ops read.
        rules = torch.ops.blitzgs.lazy_adam_final_rules(
            table, lr_table.new_empty(0, dtype=dtype), self.explicit_steps, self.eps
        )
        self.tables = [table, lr_table, rules]

    def of_group(self, group: int) -> AdamSchedule:
        """Return the schedule for a parameter alone (`AdamState`) with the rates of one group."""
        alone = copy.copy(self)
        table, rates = self.table.clone(), self.lr_table[:, group, None].repeat(1, GROUPS)
        tails = table[:, _TAILS].view(-1, ORDERS, GROUPS)
        tails.copy_(tails[:, :, group, None].clone().expand_as(tails))
        alone._take(table, rates, self._dtype)
        return alone


class GrowingSchedule(AdamTables):
    """The tables of one parameter [N, ...], of any width, whose learning rates become known step by step.

    Its methods take the parameter's state: the parameter, its first and second moments, `last_step` and
    `moment_step` (see `AdamState`). The tables have a fixed length. Their rows, and the columns of steps,
    count from `begin`, the number of steps taken before, with which all rows must be up to date. `last` is
    the last step in the tables; the parameters of all rows are known to be up to date with step `current`.
    """

    LENGTH = 4096  # steps in the tables

    def __init__(
        self, betas: tuple[float, float], eps: float, dtype: torch.dtype, device: torch.device, begin: int
    ) -> None:
        """Begin with empty tables for such a parameter (ValueError: decay rates outside their range)."""
        self.betas, self.eps = betas, eps
        self.explicit_steps = explicit_steps(*betas, dtype)
        self.begin = self.last = self.current = begin
        rates = torch.zeros(self.LENGTH + 1, GROUPS, dtype=torch.float32, device=device)
        self.tables = [table_without_rates(self.LENGTH + 1, *betas, begin).to(device), rates]

    @property
    def row(self) -> int:
        """The last step in the tables, counted from `begin`."""
        return self.last - self.begin

    def is_full(self) -> bool:
        """Tell whether no further step fits."""
        return self.row >= self.LENGTH

    def step_(
        self,
        state: list[Tensor],
        taken: Tensor,
        gradient: Tensor,
        rows: Tensor | None,
        rates: tuple[float, float],
    ) -> None:
        """Take the next step, as `lazy_adam_step_` does.

        Args:
            state: of N rows.
            taken: the number of steps taken, float32 [] on the CPU.
            gradient: that of the rows, [U, ...].
            rows: int32 [U] or int64 [1, U], each once; None: all.
            rates: the learning rates of this step, for the first three values of a row and for the rest.
        """
        constants = self.constants(self.row + 1)
        with below_autograd():
            torch.ops.blitzgs.lazy_adam_step_(
                state, self.tables, *constants, [gradient], rows, self.current == self.last, rates, taken
            )
        self.last += 1
        if rows is None:
            self.current = self.last

    def catch_up_(self, state: list[Tensor], rows: Tensor | None = None, count: Tensor | None = None) -> None:
        """Apply the missed steps up to the last one, as `lazy_adam_catch_up_` does with these arguments."""
        with below_autograd():
            torch.ops.blitzgs.lazy_adam_catch_up_(state, self.tables, *self.constants(self.row), rows, count)
        if rows is None and count is None:
            self.current = self.last


def lazy_adam_step_(
    state: AdamState, schedule: AdamTables, step: int, grads: Sequence[Tensor], ids: Tensor | None
) -> None:
    """Take Adam step ``step`` for the rows `ids`, in place, after the zero-gradient steps they skipped.

    Equals ``torch.optim.Adam`` (bias-corrected; Kingma & Ba 2015, Algorithm 1) over all rows, with zero
    gradients for the rows not listed, once `lazy_adam_catch_up_` has been called; see
    csrc/adam/lazy_adam.h for the closed form. All tensors on one device; float32 (CPU also float64).

    Args:
        state: of N rows; `last_step` and `moment_step` become `step` for `ids`.
        schedule: of S steps, for the dtype of the parameters.
        step: 1 <= step <= S.
        grads: gradients of the listed rows, shaped like the parameters with U rows.
        ids: int32 or int64 [U], the rows, each once; None: all.
    """
    with below_autograd():
        torch.ops.blitzgs.lazy_adam_step_(
            state.tensors, schedule.tables, *schedule.constants(step), list(grads), ids
        )


def lazy_adam_catch_up_(
    state: AdamState, schedule: AdamTables, step: int, ids: Tensor | None = None, count: Tensor | None = None
) -> None:
    """Apply the missed zero-gradient steps up to ``step`` to the rows `ids` (None: all), in place.

    Only parameters and `last_step` change. Afterwards these parameters are those of dense Adam after
    ``step``. Rows that are current already do not change. The next step with a gradient applies the pending
    decay of the moments, beta^(step - moment_step).

    Args:
        state: of N rows.
        schedule: of S steps, for the dtype of the parameters.
        step: 0 <= step <= S; 0: nothing to do.
        ids: int32 or int64 [A], the rows, each once; None: all.
        count: int32 [1], only the first `count` of `ids` are rows; the host does not wait for it. None: all.
    """
    with below_autograd():
        torch.ops.blitzgs.lazy_adam_catch_up_(
            state.tensors, schedule.tables, *schedule.constants(step), ids, count
        )


def explicit_steps(beta1: float, beta2: float, dtype: torch.dtype) -> int:
    """Return the number of zero-gradient steps after which a row's remaining movement is below rounding."""
    ratio = beta1 / math.sqrt(beta2)
    negligible = _NEGLIGIBLE.get(dtype, 2.0**-27)
    return 1 if ratio == 0 else max(1, math.ceil(math.log(negligible) / math.log(ratio)))


def table_without_rates(steps: int, beta1: float, beta2: float, before: int = 0) -> Tensor:
    """Return `AdamSchedule.table` for learning rates of zero: only the columns that do not depend on them.

    Args:
        steps: S + 1.
        beta1: decay of the first moment, 0 <= beta1 < sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).
        before: number of steps taken before the table begins; bias corrections count from there.

    Returns:
        float64 [S + 1, 30] on the CPU.

    Raises:
        ValueError: decay rates outside their range.
    """
    if not (beta1 >= 0 and 0 < beta2 < 1 and beta1 < math.sqrt(beta2)):
        raise ValueError(
            f"Adam's decay rates must satisfy 0 <= beta1 < sqrt(beta2) < 1, got beta1={beta1}, beta2={beta2}"
        )
    ratio, root = beta1 / math.sqrt(beta2), math.sqrt(beta2)
    t = torch.arange(steps, dtype=torch.float64, device="cpu")
    table = torch.zeros(steps, _COLUMNS, dtype=torch.float64, device="cpu")
    powers = (beta1**t, beta2**t, ratio**t, root**t)
    for column, power in enumerate(powers, start=_POWERS):
        table[:, column] = power
    t += before
    # -expm1(t log beta) keeps the digits that 1 - beta^t loses while t is small.
    first = 1 / (-torch.expm1(t[1:] * math.log(beta1)) if beta1 > 0 else torch.ones_like(t[1:]))
    second = (-torch.expm1(t[1:] * math.log(beta2))).rsqrt()
    table[1:, CORRECTION1], table[1:, CORRECTION2] = first, second
    return table


def _make_table(lr_table: Tensor, beta1: float, beta2: float) -> Tensor:
    """Return `AdamSchedule.table`."""
    rates = lr_table.double().cpu()
    steps = rates.shape[0]
    table = table_without_rates(steps, beta1, beta2)
    ratio, root = beta1 / math.sqrt(beta2), math.sqrt(beta2)
    first, second = table[1:, CORRECTION1], table[1:, CORRECTION2]
    orders = range(ORDERS)
    terms = torch.stack([(first * second ** (k - 1))[:, None] * rates[1:] for k in orders], 1).numpy()
    ratios = np.array([ratio * root**k for k in orders])[:, None]
    tails = table.numpy()[:, _TAILS].reshape(steps, ORDERS, GROUPS)
    for step in range(steps - 2, -1, -1):
        tails[step] = ratios * (terms[step] + tails[step + 1])
    return table.to(lr_table.device)


def project_bwd_step_(
    state: AdamState,
    schedule: AdamSchedule,
    step: int,
    views: tuple[Tensor, Tensor, Tensor | None, Tensor | None],
    splats: ProjectedSplats,
    options: ProjectionOptions,
    gradients: SplatGradients,
    level: Tensor | None = None,
) -> None:
    """Take Adam step ``step`` for the visible Gaussians, in place, with the gradients of their splats.

    The result is that of the backward pass of `blitzgs.ops.project.project` followed by `lazy_adam_step_`, to
    rounding. On CUDA the gradients of the parameters are never stored. The parameters of the visible
    Gaussians must be at ``step`` - 1 (`lazy_adam_catch_up_`), as when they were projected.

    Args:
        state: parameters before their activation, float32 or (CPU) float64, and their moments; `last_step`
            and `moment_step` become `step` for the visible Gaussians.
        schedule: of S steps, for the dtype of the parameters.
        step: 1 <= step <= S.
        views: viewmats [B, 4, 4] and Ks [B, 3, 3] of the splats, and weights per view, [B], of the smallest
            axis and of the opacity of each Gaussian visible in it (before antialiased splats are
            compensated); None: no such term.
        splats: the P splats that `project` returned for these parameters and views.
        options: the options of the projection; scales and opacities are taken before their activation.
        gradients: of the splats.
        level: uint8 [N], octree levels, if opacities fade with them (`options.fade`).
    """
    with below_autograd():
        torch.ops.blitzgs.project_bwd_step_(
            state.tensors, [schedule.table, schedule.lr_table], *schedule.constants(step), *views,
            splats.camera_ids, splats.visible_ids, splats.splat_offsets, level, *options, gradients.parts,
        )  # fmt: skip
