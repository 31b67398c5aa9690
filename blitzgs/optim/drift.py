# SPDX-License-Identifier: Apache-2.0
"""What a parameter's rows owe for steps without a gradient, where learning rates are known step by step."""

from __future__ import annotations

import math

import numpy as np
import torch

from blitzgs.ops.lazy_adam import explicit_steps, table_without_rates

# csrc/lazy_adam/adam_table.h: a row has 4 orders of 6 groups, then powers and corrections. A parameter that
# is stepped alone takes the place of SH, whose first three values have a group and the rest another.
_ORDERS, _GROUPS, _OWN = 4, 6, (4, 5)
_FIRST_CAPACITY = 1024


class Drift:
    """The tables of one parameter for the op, up to the step that was taken last.

    The drift of a row from step p to step s is a sum over the steps between, so each step adds its term to
    the rows of the steps before: as many as matter, after which the moments have decayed below rounding.

    Attributes:
        table: float64 [S + 1, 30], see csrc/lazy_adam/adam_table.h.
        lr_table: float32 [S + 1, 6].
        reach: for how many steps a row without a gradient moves.
    """

    def __init__(self, betas: tuple[float, float], dtype: torch.dtype, device: torch.device) -> None:
        """Start without any step.

        Args:
            betas: decay rates of the moments.
            dtype: of the parameter.
            device: likewise.

        Raises:
            ValueError: decay rates outside their range.
        """
        self.betas = betas
        self.reach = explicit_steps(*betas, dtype)
        self.table = torch.zeros(0, _ORDERS * _GROUPS, dtype=torch.float64, device=device)
        self.lr_table = torch.zeros(0, _GROUPS, dtype=torch.float32, device=device)
        self._grow(_FIRST_CAPACITY)
        ratio, root = betas[0] / math.sqrt(betas[1]), math.sqrt(betas[1])
        distances = np.arange(self.reach, 0, -1)[:, None]
        decays = (ratio * root ** np.arange(_ORDERS)) ** distances
        self._decays = torch.from_numpy(decays).to(device)[:, :, None]

    def _grow(self, capacity: int) -> None:
        device, known = self.lr_table.device, len(self.lr_table)
        table = table_without_rates(capacity + 1, *self.betas)
        first, second = table[:, 28], table[:, 29]
        # What a step adds to the steps before it, for a learning rate of 1; there is no step 0.
        shares = torch.stack([first * second ** (order - 1) for order in range(_ORDERS)], dim=1)
        shares[0] = 0
        self._shares = shares.to(device)[:, :, None]
        table, rates = table.to(device), self.lr_table.new_zeros(capacity + 1, _GROUPS)
        table[:known, : _ORDERS * _GROUPS] = self.table[:, : _ORDERS * _GROUPS]
        rates[:known] = self.lr_table
        self.table, self.lr_table = table, rates

    def add(self, step: int, lr: float, lr_rest: float) -> None:
        """Take note of a step; queues a few small kernels and copies nothing to the device.

        Args:
            step: its number, from 1.
            lr: learning rate of the first three values of a row.
            lr_rest: of the others.
        """
        if step >= len(self.lr_table):
            self._grow(2 * step)
        begin = max(0, step - self.reach)
        tails = self.table[begin:step, : _ORDERS * _GROUPS].view(-1, _ORDERS, _GROUPS)
        decays, shares = self._decays[begin - step :], self._shares[step]
        for groups, rate in [(_OWN, lr)] if lr == lr_rest else [(_OWN[:1], lr), (_OWN[1:], lr_rest)]:
            owned = slice(groups[0], groups[-1] + 1)
            rate = float(np.float32(rate))  # as in lr_table
            tails[:, :, owned].addcmul_(decays, shares, value=rate)
            self.lr_table[step, owned].fill_(rate)
