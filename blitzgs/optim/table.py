# SPDX-License-Identifier: Apache-2.0
"""Parameters of the same rows that one call of the op moves."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import blitzgs.ops.lazy_adam  # noqa: F401  (registers the ops)
from blitzgs._library import below_autograd
from blitzgs.optim.drift import Drift

# Entries of a parameter's state: the step up to which each row's values, and its moments, are current,
# counted from `Drift.begin`. A state without them, as `torch.optim.Adam` has it, is up to date.
STEPS = ("last_step", "moment_step")
MOMENTS = ("exp_avg", "exp_avg_sq")


class Table:
    """Parameters that share the columns of steps: five of row widths 3, 4, 3, 1 and any, or one alone.

    Attributes:
        drift: has the table of the missed steps.
        eps: of the optimiser.
        tensors: parameters, moments and steps, as `AdamState.tensors`.
    """

    def __init__(
        self,
        params: Sequence[Tensor],
        states: Sequence[dict[str, Any]],
        drift: Drift,
        index: int,
        eps: float,
    ) -> None:
        """Take parameters as they are at present; a table is no longer valid once one is replaced.

        Args:
            params: the parameters.
            states: their states: `MOMENTS`, and `STEPS`, which are the same tensors in all of them.
            drift: as the attribute.
            index: which of its tables belongs to these parameters.
            eps: of the optimiser.
        """
        self.drift, self.eps, self._index = drift, eps, index
        self._moments = [[state[name] for state in states] for name in MOMENTS]
        self._steps = [states[0][name] for name in STEPS]
        self._rows = len(params[0])
        # A parameter alone is the SH column of the op, and the others are empty.
        alone = len(params) == 1
        self._empty = [params[0].new_empty(self._rows, 0)] * 4 if alone else []
        columns = (self.columns(values) for values in (params, *self._moments))
        self.tensors = [*itertools.chain(*columns), *self._steps]

    def columns(self, values: Sequence[Tensor]) -> list[Tensor]:
        """Return the op's five columns, from a value for each parameter."""
        return [*self._empty, *values]

    def catch_up(self, step: int, rows: Tensor | None = None, count: Tensor | None = None) -> None:
        """Apply the steps that rows have missed up to `step`; as `LazyAdam.catch_up`."""
        if self._rows > 0:
            with below_autograd():
                torch.ops.blitzgs.lazy_adam_catch_up_(self.tensors, *self._schedule(step), rows, count)

    def bring_up_to_date(self, step: int) -> None:
        """Apply all missed steps to all rows and their moments."""
        self.catch_up(step)
        place = step - self.drift.begin
        behind = (place - self._steps[1]).double()
        for moments, beta in zip(self._moments, self.drift.betas, strict=True):
            decay = (beta**behind).to(moments[0].dtype)
            for values in moments:
                values *= decay.view(-1, *(1,) * (values.dim() - 1))
        for steps in self._steps:
            steps.fill_(place)

    def restart(self, step: int) -> None:
        """Bring all rows up to date and count steps from `step`, where the drift's tables begin again."""
        self.bring_up_to_date(step)
        for steps in self._steps:
            steps.zero_()

    def _schedule(self, step: int) -> tuple[list[Tensor], list[int], list[float]]:
        drift = self.drift
        return (
            [drift.tables[self._index], drift.lr_tables[self._index]],
            [step - drift.begin, drift.reach, 0],
            [*drift.betas, self.eps],
        )


def rates_of(group: dict[str, Any]) -> tuple[float, float]:
    """Return the learning rates of a group for the first three values of a row and for the rest."""
    rest = group["lr"] if group["lr_rest"] is None else group["lr_rest"]
    return float(group["lr"]), float(rest)


def steps_of(param: Tensor, step: int) -> Tensor:
    """Return a column of steps, int32 [N], for a parameter whose rows are all current at `step`."""
    return torch.full((len(param),), step, dtype=torch.int32, device=param.device)
