# SPDX-License-Identifier: Apache-2.0
"""Dense Adam that pays for the rows with a gradient alone; rows left behind are caught up in O(1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

import blitzgs._library  # noqa: F401  (registers the ops)

# Drift terms below this fraction of their sum are lost in rounding.
_NEGLIGIBLE = {torch.float32: 2.0**-27, torch.float64: 2.0**-56}


@torch.no_grad()
def lazy_adam_step_(
    params: Sequence[Tensor],
    exp_avgs: Sequence[Tensor],
    exp_avg_sqs: Sequence[Tensor],
    grads: Sequence[Tensor],
    ids: Tensor,
    last_step: Tensor,
    lr_table: Tensor,
    step: int,
    beta1: float,
    beta2: float,
    eps: float,
    sparse: bool = False,
) -> None:
    """Take Adam step ``step`` for the rows `ids`, in place, after the zero-gradient steps they skipped.

    Equals ``torch.optim.Adam`` (bias-corrected; Kingma & Ba 2015, Algorithm 1) over all rows, with zero
    gradients for the rows not listed, once `lazy_adam_catch_up_` has been called; see
    csrc/lazy_adam/lazy_adam.h for the closed form. All tensors on one device; float32 (CPU also float64).

    Args:
        params: (means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3]).
        exp_avgs: first moments, shaped like `params`.
        exp_avg_sqs: second moments, shaped like `params`.
        grads: gradients of the listed rows, shaped like `params` with U rows.
        ids: int32 [U], the rows, each once.
        last_step: int32 [N], the step that each row's state stands at; becomes `step` for `ids`.
        lr_table: float32 [S + 1, 6], learning rates of means, quats, scales, opacities, SH DC and SH rest
            for every step of the schedule (row 0 unused). Must not change between calls.
        step: 1 <= step <= S.
        beta1: decay of the first moment, below sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).
        eps: added to the root of the second moment.
        sparse: plain sparse Adam instead: moments of unlisted rows keep their values and nothing drifts.

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    table = schedule_table(lr_table, beta1, beta2)
    torch.ops.blitzgs.lazy_adam_step_(
        list(params),
        list(exp_avgs),
        list(exp_avg_sqs),
        list(grads),
        ids,
        last_step,
        table,
        lr_table,
        step,
        _explicit_steps(beta1, beta2, params[0].dtype),
        beta1,
        beta2,
        eps,
        sparse,
    )


@torch.no_grad()
def lazy_adam_catch_up_(
    params: Sequence[Tensor],
    exp_avgs: Sequence[Tensor],
    exp_avg_sqs: Sequence[Tensor],
    ids: Tensor | None,
    last_step: Tensor,
    lr_table: Tensor,
    step: int,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Bring the rows `ids` (None: all rows) to the state dense Adam has after ``step``, in place.

    Rows that stand at `step` already are left untouched. Arguments as in `lazy_adam_step_`; ``step`` may be
    0 (nothing to do).

    Raises:
        ValueError: decay rates outside their range.
        RuntimeError: wrong shapes or dtypes, or a step outside the table.
    """
    table = schedule_table(lr_table, beta1, beta2)
    torch.ops.blitzgs.lazy_adam_catch_up_(
        list(params),
        list(exp_avgs),
        list(exp_avg_sqs),
        ids,
        last_step,
        table,
        lr_table,
        step,
        _explicit_steps(beta1, beta2, params[0].dtype),
        beta1,
        beta2,
        eps,
    )


def _explicit_steps(beta1: float, beta2: float, dtype: torch.dtype) -> int:
    """Number of zero-gradient steps after which the drift that is left is below rounding."""
    ratio = beta1 / math.sqrt(beta2)
    negligible = _NEGLIGIBLE.get(dtype, 2.0**-27)
    return 1 if ratio == 0 else max(1, math.ceil(math.log(negligible) / math.log(ratio)))


# The table is a function of the schedule alone: (beta1, beta2, version of lr_table) -> table.
_tables: Any = WeakTensorKeyDictionary()


def schedule_table(lr_table: Tensor, beta1: float, beta2: float) -> Tensor:
    """Return the drift of zero-gradient steps from every step to the end of the schedule, made on first use.

    Args:
        lr_table: float32 [S + 1, 6], learning rates per step (row 0 unused).
        beta1: decay of the first moment, 0 <= beta1 < sqrt(beta2).
        beta2: decay of the second moment, in (0, 1).

    Returns:
        float64 [S + 1, 11], the table described in csrc/lazy_adam/lazy_adam.h, on the device of `lr_table`.

    Raises:
        ValueError: decay rates outside their range.
    """
    key = (beta1, beta2, lr_table._version)
    cached = _tables.get(lr_table)
    if cached is None or cached[0] != key:
        cached = (key, _make_table(lr_table, beta1, beta2))
        _tables[lr_table] = cached
    table: Tensor = cached[1]
    return table


def _make_table(lr_table: Tensor, beta1: float, beta2: float) -> Tensor:
    if not (beta1 >= 0 and 0 < beta2 < 1 and beta1 < math.sqrt(beta2)):
        raise ValueError(
            f"Adam's decay rates must satisfy 0 <= beta1 < sqrt(beta2) < 1, got beta1={beta1}, beta2={beta2}"
        )
    rates = lr_table.double().cpu().numpy()
    steps = rates.shape[0]
    ratio = beta1 / math.sqrt(beta2)
    t = torch.arange(steps, dtype=torch.float64)
    table = torch.zeros(steps, 11, dtype=torch.float64)
    table[:, 6], table[:, 7], table[:, 8] = beta1**t, beta2**t, ratio**t
    # -expm1(t log beta) keeps the digits that 1 - beta^t loses while t is small.
    table[1:, 9] = 1 / (-torch.expm1(t[1:] * math.log(beta1)) if beta1 > 0 else torch.ones(steps - 1))
    table[1:, 10] = (-torch.expm1(t[1:] * math.log(beta2))).rsqrt()
    corrected = rates * (table[:, 9] / table[:, 10].clamp_min(1e-300)).numpy()[:, None]
    tails = table[:, :6].numpy()
    for step in range(steps - 2, -1, -1):
        tails[step] = ratio * (corrected[step + 1] + tails[step + 1])
    return table.to(lr_table.device)


@torch.library.register_fake("blitzgs::lazy_adam_step_")
def _(*args: Any) -> None:
    return None


@torch.library.register_fake("blitzgs::lazy_adam_catch_up_")
def _(*args: Any) -> None:
    return None
