# SPDX-License-Identifier: Apache-2.0
"""Tables of the steps that rows without a gradient missed; learning rates become known step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.lazy_adam import (
    CORRECTION1,
    CORRECTION2,
    GROUPS,
    ORDERS,
    explicit_steps,
    table_without_rates,
)

# Number of steps that the tables hold. When they are full, all rows are brought up to date and the tables
# begin again, so that they do not grow.
CAPACITY = 4096


class Drift:
    """The tables that the op takes, for the steps from `begin` to the latest one.

    A row without a gradient moves between step p and step s by a sum over the steps between them. Each new
    step therefore adds its term to the table rows of earlier steps; those before the last `reach` steps need
    no term, because moments of that age have decayed below rounding. Steps are counted from `begin`, in the
    tables and in the optimiser's columns of steps.

    Attributes:
        begin: the step at which the tables begin.
        betas: decay rates of the moments.
        tables: T of float64 [CAPACITY + 1, 30], see csrc/adam/lazy_adam.h.
        lr_tables: T of float32 [CAPACITY + 1, 6].
        reach: number of steps for which a row without a gradient still moves.
    """

    def __init__(
        self,
        betas: tuple[float, float],
        dtype: torch.dtype,
        device: torch.device,
        begin: int,
        tables: int = 1,
    ) -> None:
        """Begin with empty tables.

        Args:
            betas: decay rates of the moments.
            dtype: dtype of the parameter.
            device: device of the parameter.
            begin: number of steps taken before; all rows must be up to date with it.
            tables: number of tables T; each has learning rates of its own.

        Raises:
            ValueError: decay rates outside their range.
        """
        self.betas = betas
        self.reach = explicit_steps(*betas, dtype)
        lr_tables = torch.zeros(tables, CAPACITY + 1, GROUPS, dtype=torch.float32, device=device)
        self._set_rates(lr_tables)
        ratio, root = betas[0] / math.sqrt(betas[1]), math.sqrt(betas[1])
        distances = np.arange(self.reach, 0, -1)[:, None]
        decays = (ratio * root ** np.arange(ORDERS)) ** distances
        self._decays = torch.from_numpy(decays).to(device)
        self.restart(begin)

    def __getstate__(self) -> dict[str, Any]:
        # A pickled view would no longer be one.
        views = ("lr_tables", "tables")
        return {name: value for name, value in self.__dict__.items() if name not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._set_rates(self._lr_tables)
        self._set_tables(self._tables)

    def _set_rates(self, lr_tables: Tensor) -> None:
        """Take the learning rates of all steps, float32 [T, CAPACITY + 1, 6]."""
        self._lr_tables, self.lr_tables = lr_tables, lr_tables.unbind()

    def _set_tables(self, tables: Tensor) -> None:
        """Take the tables, float64 [T, CAPACITY + 1, 30]."""
        self._tables, self.tables = tables, tables.unbind()

    def restart(self, begin: int) -> None:
        """Empty the tables at step `begin`, with which all rows and their moments must be up to date."""
        self.begin = begin
        table = table_without_rates(CAPACITY + 1, *self.betas, begin)
        first, second = table[:, CORRECTION1], table[:, CORRECTION2]
        # The terms that a step with learning rate 1 adds to the rows of earlier steps.
        shares = torch.stack([first * second ** (order - 1) for order in range(ORDERS)], dim=1)
        shares[0] = 0
        device = self._lr_tables.device
        self._shares = shares.to(device)
        self._set_tables(table.to(device).repeat(len(self._lr_tables), 1, 1))
        self._lr_tables.zero_()

    def is_full(self, step: int) -> bool:
        """Tell whether the tables are full, so that no steps after `step` fit."""
        return step - self.begin >= CAPACITY

    def step(
        self,
        step: int,
        rates: Sequence[float],
        eps: float,
        states: Sequence[Tensor],
        gradients: Sequence[Tensor],
        indices: Tensor,
        current: Sequence[bool],
    ) -> None:
        """Add a step to the tables and take it for some rows; nothing is copied to the device.

        Args:
            step: number of the step, from 1.
            rates: 6 T learning rates, in the order of the tables; they are rounded to float32.
            eps: of the optimiser.
            states: the T tables of parameters, `AdamState.tensors` each.
            gradients: those of the rows, for the five columns of each table.
            indices: int64 [1, A] or [A], the rows, each once.
            current: of each table, whether the parameters of all rows stand at the step before.
        """
        with below_autograd():
            torch.ops.blitzgs.drift_step_(
                self._tables,
                self._lr_tables,
                (self._decays, self._shares),
                states,
                (step - self.begin, self.reach, 0),
                (*self.betas, eps),
                rates,
                gradients,
                indices,
                current,
            )
        # A backward pass that has saved the parameters must fail, as it does after a step of torch's Adam.
        torch.autograd.graph.increment_version(states)

    def alone(self, table: int, group: int) -> Drift:
        """Return a copy for a parameter alone, which had the learning rates of a group of a table.

        A parameter that is stepped alone takes the place of SH: the first three values of its rows are in
        group 4 and the others in group 5. Groups 4 and 5 are copied as they are, others to both.
        """
        copied = Drift.__new__(Drift)
        copied.begin, copied.betas, copied.reach = self.begin, self.betas, self.reach
        copied._decays, copied._shares = self._decays, self._shares
        own = [*range(4), *((4, 5) if group >= 4 else (group, group))]
        copied._set_rates(self._lr_tables[table][None, :, own])
        tables = self._tables[table][None].clone()
        tails = tables[:, :, : ORDERS * GROUPS].unflatten(2, (ORDERS, GROUPS))
        tails.copy_(tails[:, :, :, own])
        copied._set_tables(tables)
        return copied


@torch.library.register_fake("blitzgs::drift_step_")
def _(*_args: Any) -> None:
    return None
