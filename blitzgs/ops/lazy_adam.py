# SPDX-License-Identifier: Apache-2.0
"""Dense Adam that updates only rows with a gradient and applies a row's missed steps later, in O(1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from blitzgs._library import below_autograd

# Columns of the schedule's table, as in csrc/lazy_adam/lazy_adam.h: tails of 4 orders for 6 groups, powers of
# the decay rates, bias corrections.
_ORDERS, _GROUPS = 4, 6
_TAILS, _POWERS, _CORRECTION1, _CORRECTION2, _COLUMNS = slice(0, _ORDERS * _GROUPS), 24, 28, 29, 30
# Drift terms below this fraction of their sum are lost in rounding.
_NEGLIGIBLE = {torch.float32: 2.0**-27, torch.float64: 2.0**-56}


class AdamState(NamedTuple):
    """The optimiser's state of a table of N rows, as the ops that move parameters take it.

    Attributes:
        params: (means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3]).
        exp_avgs: first moments, shaped like `params`.
        exp_avg_sqs: second moments, shaped like `params`.
        last_step: int32 [N], the step that each row's parameters stand at.
        moment_step: int32 [N], <= `last_step`, the step that its moments stand at.
    """

    params: Sequence[Tensor]
    exp_avgs: Sequence[Tensor]
    exp_avg_sqs: Sequence[Tensor]
    last_step: Tensor
    moment_step: Tensor

    @property
    def tensors(self) -> list[Tensor]:
        """The group `state` of the ops (`AdamTensors` of csrc/lazy_adam/lazy_adam_op.h)."""
        return [*self.params, *self.exp_avgs, *self.exp_avg_sqs, self.last_step, self.moment_step]


@dataclass(frozen=True, eq=False)
class AdamSchedule:
    """Adam's constants, its learning rates of every step, and the tables that the ops make of these.

    Attributes:
        lr_table: float32 [S + 1, 6], learning rates of means, quats, scales, opacities, SH DC and SH rest
            for every step of the schedule (row 0 unused). Must not change while this object is used.
        beta1: decay of the first moment, below sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).
        eps: added to the root of the second moment.
        sparse: plain sparse Adam: moments of unlisted rows keep their values and nothing drifts.
    """

    lr_table: Tensor
    beta1: float
    beta2: float
    eps: float
    sparse: bool = False
    _tables: dict[torch.dtype, list[Tensor]] = field(default_factory=dict, init=False, repr=False)

    @property
    def decays(self) -> list[float]:
        """The group `decays` of the ops."""
        return [self.beta1, self.beta2, self.eps]

    @cached_property
    def table(self) -> Tensor:
        """The `schedule_table`."""
        return schedule_table(self.lr_table, self.beta1, self.beta2)

    def tables(self, like: Tensor) -> list[Tensor]:
        """Return the `schedule_tables` for parameters of the dtype of `like`."""
        if like.dtype not in self._tables:
            made = schedule_tables(self.lr_table, self.beta1, self.beta2, self.eps, like)
            self._tables[like.dtype] = made
        return self._tables[like.dtype]

    def steps(self, step: int, dtype: torch.dtype) -> list[int]:
        """Return the group `steps` of the ops: step number `step` of parameters of a dtype."""
        return [step, explicit_steps(self.beta1, self.beta2, dtype), int(self.sparse)]


def lazy_adam_step_(
    state: AdamState, schedule: AdamSchedule, step: int, grads: Sequence[Tensor], ids: Tensor
) -> None:
    """Take Adam step ``step`` for the rows `ids`, in place, after the zero-gradient steps they skipped.

    Equals ``torch.optim.Adam`` (bias-corrected; Kingma & Ba 2015, Algorithm 1) over all rows, with zero
    gradients for the rows not listed, once `lazy_adam_catch_up_` has been called; see
    csrc/lazy_adam/lazy_adam.h for the closed form. All tensors on one device; float32 (CPU also float64).

    Args:
        state: of N rows; `last_step` and `moment_step` become `step` for `ids`.
        schedule: of S steps.
        step: 1 <= step <= S.
        grads: gradients of the listed rows, shaped like the parameters with U rows.
        ids: int32 [U], the rows, each once.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    like = state.params[0]
    tables = schedule.tables(like)
    with below_autograd():
        torch.ops.blitzgs.lazy_adam_step_(
            state.tensors, tables, schedule.steps(step, like.dtype), schedule.decays, list(grads), ids
        )


def lazy_adam_catch_up_(
    state: AdamState,
    schedule: AdamSchedule,
    step: int,
    ids: Tensor | None = None,
    count: Tensor | None = None,
) -> None:
    """Apply the missed zero-gradient steps up to ``step`` to the rows `ids` (None: all), in place.

    Only parameters and `last_step` change. Afterwards these parameters are those of dense Adam after
    ``step``. Rows that are current already do not change. The next step with a gradient applies the pending
    decay of the moments, beta^(step - moment_step).

    Args:
        state: of N rows.
        schedule: of S steps.
        step: 0 <= step <= S; 0: nothing to do.
        ids: int32 [A], the rows, each once; None: all.
        count: int32 [1], only the first `count` of `ids` are rows; the host does not wait for it. None: all.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    like = state.params[0]
    tables = schedule.tables(like)
    with below_autograd():
        torch.ops.blitzgs.lazy_adam_catch_up_(
            state.tensors, tables, schedule.steps(step, like.dtype), schedule.decays, ids, count
        )


@lru_cache(maxsize=16)
def explicit_steps(beta1: float, beta2: float, dtype: torch.dtype) -> int:
    """Return the number of zero-gradient steps after which a row's remaining movement is below rounding."""
    ratio = beta1 / math.sqrt(beta2)
    negligible = _NEGLIGIBLE.get(dtype, 2.0**-27)
    return 1 if ratio == 0 else max(1, math.ceil(math.log(negligible) / math.log(ratio)))


# Tables computed from a schedule: for each lr_table, its version at that time and the tables.
_tables: Any = WeakTensorKeyDictionary()


def _cached(lr_table: Tensor, key: tuple[object, ...], make: Callable[[], Tensor]) -> Tensor:
    """Return the cached result of `make` for `lr_table` and `key`; renew it if `lr_table` has changed."""
    version, made = _tables.get(lr_table, (None, {}))
    if version != lr_table._version:
        made = {}
        _tables[lr_table] = (lr_table._version, made)
    if key not in made:
        made[key] = make()
    found: Tensor = made[key]
    return found


def schedule_tables(lr_table: Tensor, beta1: float, beta2: float, eps: float, like: Tensor) -> list[Tensor]:
    """Return the tables of a schedule as the ops take them, made on first use.

    Args:
        lr_table: float32 [S + 1, 6], learning rates per step (row 0 unused).
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.
        like: has the dtype of the parameters.

    Returns:
        `schedule_table`, `lr_table`, and, for rows that are `explicit_steps` or more steps behind, the rule
        that applies all their missed steps, indexed by the row's last step: uint8 [max(0, S + 1 -
        explicit_steps), bytes], in a layout that only the ops read.

    Raises:
        ValueError: decay rates outside their range.
    """
    table = schedule_table(lr_table, beta1, beta2)
    reach = explicit_steps(beta1, beta2, like.dtype)
    rules = _cached(
        lr_table,
        (beta1, beta2, eps, like.dtype),
        lambda: torch.ops.blitzgs.lazy_adam_final_rules(table, like, reach, eps),
    )
    return [table, lr_table, rules]


def schedule_table(lr_table: Tensor, beta1: float, beta2: float) -> Tensor:
    """Return the table from which the ops compute a row's movement over missed steps; it is cached.

    Args:
        lr_table: float32 [S + 1, 6], learning rates per step (row 0 unused).
        beta1: decay of the first moment, 0 <= beta1 < sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).

    Returns:
        float64 [S + 1, 30], the table described in csrc/lazy_adam/lazy_adam.h, on the device of `lr_table`.

    Raises:
        ValueError: decay rates outside their range.
    """
    return _cached(lr_table, (beta1, beta2), lambda: _make_table(lr_table, beta1, beta2))


def table_without_rates(steps: int, beta1: float, beta2: float, before: int = 0) -> Tensor:
    """Return `schedule_table` for learning rates of zero: only the columns that do not depend on the rates.

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
    t = torch.arange(steps, dtype=torch.float64)
    table = torch.zeros(steps, _COLUMNS, dtype=torch.float64)
    powers = (beta1**t, beta2**t, ratio**t, root**t)
    for column, power in enumerate(powers, start=_POWERS):
        table[:, column] = power
    t += before
    # -expm1(t log beta) keeps the digits that 1 - beta^t loses while t is small.
    first = 1 / (-torch.expm1(t[1:] * math.log(beta1)) if beta1 > 0 else torch.ones(steps - 1))
    second = (-torch.expm1(t[1:] * math.log(beta2))).rsqrt()
    table[1:, _CORRECTION1], table[1:, _CORRECTION2] = first, second
    return table


def _make_table(lr_table: Tensor, beta1: float, beta2: float) -> Tensor:
    rates = lr_table.double().cpu()
    steps = rates.shape[0]
    table = table_without_rates(steps, beta1, beta2)
    ratio, root = beta1 / math.sqrt(beta2), math.sqrt(beta2)
    first, second = table[1:, _CORRECTION1], table[1:, _CORRECTION2]
    orders = range(_ORDERS)
    terms = torch.stack([(first * second ** (k - 1))[:, None] * rates[1:] for k in orders], 1).numpy()
    ratios = np.array([ratio * root**k for k in orders])[:, None]
    tails = table.numpy()[:, _TAILS].reshape(steps, _ORDERS, _GROUPS)
    for step in range(steps - 2, -1, -1):
        tails[step] = ratios * (terms[step] + tails[step + 1])
    return table.to(lr_table.device)


@torch.library.register_fake("blitzgs::lazy_adam_final_rules")
def _(table: Tensor, like: Tensor, explicit_steps: int, eps: float) -> Tensor:
    # Six rules of four numbers, two steps and a number, to a multiple of four numbers.
    return table.new_empty(max(0, len(table) - explicit_steps), 28 * like.dtype.itemsize, dtype=torch.uint8)


@torch.library.register_fake("blitzgs::lazy_adam_step_")
def _(*args: Any) -> None:
    return None


@torch.library.register_fake("blitzgs::lazy_adam_catch_up_")
def _(*args: Any) -> None:
    return None
