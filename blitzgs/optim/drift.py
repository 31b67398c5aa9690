# SPDX-License-Identifier: Apache-2.0
"""Tables of the steps that rows without a gradient missed; learning rates become known step by step."""

from __future__ import annotations

import math

import numpy as np
import torch

from blitzgs.ops.lazy_adam import explicit_steps, table_without_rates

# csrc/lazy_adam/lazy_adam.h: a row has 4 orders of 6 groups, then powers and corrections. A parameter that
# is stepped alone takes the place of SH, whose first three values have a group and the rest another.
_ORDERS, _GROUPS, _OWN = 4, 6, (4, 5)
# Number of steps that the tables hold. When they are full, all rows are brought up to date and the tables
# begin again, so that they do not grow.
CAPACITY = 4096


class Drift:
    """The tables of one parameter that the op takes, for the steps from `begin` to the latest one.

    A row without a gradient moves between step p and step s by a sum over the steps between them. Each new
    step therefore adds its term to the table rows of earlier steps; those before the last `reach` steps need
    no term, because moments of that age have decayed below rounding. Steps are counted from `begin`, in the
    tables and in the optimiser's columns of steps.

    Attributes:
        begin: the step at which the tables begin.
        table: float64 [CAPACITY + 1, 30], see csrc/lazy_adam/lazy_adam.h.
        lr_table: float32 [CAPACITY + 1, 6].
        reach: number of steps for which a row without a gradient still moves.
    """

    def __init__(
        self, betas: tuple[float, float], dtype: torch.dtype, device: torch.device, begin: int
    ) -> None:
        """Begin with empty tables.

        Args:
            betas: decay rates of the moments.
            dtype: dtype of the parameter.
            device: device of the parameter.
            begin: number of steps taken before; all rows must be up to date with it.

        Raises:
            ValueError: decay rates outside their range.
        """
        self.betas = betas
        self.reach = explicit_steps(*betas, dtype)
        self.lr_table = torch.zeros(CAPACITY + 1, _GROUPS, dtype=torch.float32, device=device)
        ratio, root = betas[0] / math.sqrt(betas[1]), math.sqrt(betas[1])
        distances = np.arange(self.reach, 0, -1)[:, None]
        decays = (ratio * root ** np.arange(_ORDERS)) ** distances
        self._decays = torch.from_numpy(decays).to(device)[:, :, None]
        self.restart(begin)

    def restart(self, begin: int) -> None:
        """Empty the tables at step `begin`, with which all rows and their moments must be up to date."""
        self.begin = begin
        table = table_without_rates(len(self.lr_table), *self.betas, begin)
        first, second = table[:, 28], table[:, 29]
        # The terms that a step with learning rate 1 adds to the rows of earlier steps.
        shares = torch.stack([first * second ** (order - 1) for order in range(_ORDERS)], dim=1)
        shares[0] = 0
        self._shares = shares.to(self.lr_table.device)[:, :, None]
        self.table = table.to(self.lr_table.device)
        self.lr_table.zero_()

    def is_full(self, step: int) -> bool:
        """Tell whether the tables are full, so that no steps after `step` fit."""
        return step - self.begin >= len(self.lr_table) - 1

    def add(self, step: int, lr: float, lr_rest: float) -> None:
        """Add a step to the tables; this queues a few small kernels and copies nothing to the device.

        Args:
            step: number of the step, from 1.
            lr: learning rate of the first three values of a row.
            lr_rest: learning rate of the other values.
        """
        place = step - self.begin
        first = max(0, place - self.reach)
        tails = self.table[first:place, : _ORDERS * _GROUPS].view(-1, _ORDERS, _GROUPS)
        decays, shares = self._decays[first - place :], self._shares[place]
        for groups, rate in [(_OWN, lr)] if lr == lr_rest else [(_OWN[:1], lr), (_OWN[1:], lr_rest)]:
            owned = slice(groups[0], groups[-1] + 1)
            rate = float(np.float32(rate))  # as in lr_table
            tails[:, :, owned].addcmul_(decays, shares, value=rate)
            self.lr_table[place, owned].fill_(rate)
