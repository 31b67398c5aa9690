# SPDX-License-Identifier: Apache-2.0
"""Steps all parameters of a set of Gaussians in few calls of the ops, because they have the same rows."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs.ops.sparse_rows import distinct_rows
from blitzgs.optim.drift import GROUPS, Drift
from blitzgs.optim.table import MOMENTS, STEPS, Table, rates_of

# Values in a row of the op's first four columns, and of the parameter that takes the place of SH beside them.
_WIDTHS = (3, 4, 3, 1, 3)
_SH = len(_WIDTHS) - 1

# An optimiser with the indices of one of its groups and of a parameter in the group.
Member = tuple[Any, int, int]
# The table that a parameter belongs to, and its column there.
Slot = tuple[int, int]


class Joint:
    """Parameters of `LazyAdam` optimisers that have been stepped together since step `drift.begin`.

    Five parameters with 3, 4, 3, 1 and 3 values a row (gsplat's means, quats, scales, opacities and sh0)
    share a table, and with it one column of steps. Each further parameter (shN) has a table of its own,
    because its rows catch up at other times.

    Attributes:
        members: the parameters.
        tables: the tables.
    """

    def __init__(self, members: Sequence[Member], slots: Sequence[Slot]) -> None:
        """Bring the members up to date and join them."""
        self.members, self._slots = members, slots
        for optimizer in {id(member[0]): member[0] for member in members}.values():
            optimizer.bring_up_to_date()
            optimizer.drifts.clear()
            optimizer.joint = self
        params = self._params()
        states = [self._state(index) for index in range(len(members))]
        self._options = [self._options_of(index) for index in range(len(members))]
        betas, eps = self._options[0]
        self._step, self._step_tensor = int(states[0]["step"]), states[0]["step"]
        like, count = params[0], 1 + max(table for table, _ in slots)
        self.drift = Drift(betas, like.dtype, like.device, self._step, count)
        # The members of each table, in the order of its columns.
        self._inside = [
            [index for _, index in sorted((c, i) for i, (t, c) in enumerate(slots) if t == number)]
            for number in range(count)
        ]
        self.tables = []
        for number, inside in enumerate(self._inside):
            steps = [torch.zeros(len(like), dtype=torch.int32, device=like.device) for _ in STEPS]
            for index in inside:
                states[index].update(zip(STEPS, steps, strict=True), step=self._step_tensor)
            own = [params[index] for index in inside], [states[index] for index in inside]
            self.tables.append(Table(*own, self.drift, number, eps))
        # The step up to which all rows of each table are known to be current.
        self._current = [self._step] * count
        self._known = self._tensors()

    def is_current(self) -> bool:
        """Tell whether the members still have the parameters, state and options that were joined."""
        now = self._tensors()
        same = len(now) == len(self._known) and all(a is b for a, b in zip(now, self._known, strict=True))
        return same and all(self._options_of(i) == own for i, own in enumerate(self._options))

    def step(self, rows: Tensor, gradients: Sequence[Tensor]) -> None:
        """Take a step for some rows.

        Args:
            rows: int32 or int64 [A], each once.
            gradients: their gradients for each member, [A, ...].
        """
        if self.drift.is_full(self._step):
            for table in self.tables:
                table.restart(self._step)
            self.drift.restart(self._step)
        self._step += 1
        self._step_tensor += 1
        rates = [0.0] * (GROUPS * len(self.tables))
        for (optimizer, group, _), (number, column) in zip(self.members, self._slots, strict=True):
            first, rest = rates_of(optimizer.param_groups[group])
            rates[GROUPS * number + column] = first
            if column == _SH:
                rates[GROUPS * number + column + 1] = rest
        self.drift.add(self._step, rates)
        if len(rows) == 0:
            return
        ids = rows.int()
        for table, inside in zip(self.tables, self._inside, strict=True):
            table.step(self._step, ids, [gradients[index] for index in inside])

    @torch.no_grad()
    def catch_up(self, params: Collection[Tensor], rows: Tensor | None = None) -> None:
        """Apply the steps that rows, int32 [A] or None for all, of the tables of some parameters missed."""
        wanted = {id(param) for param in params}
        now = self._params()
        for number, (table, inside) in enumerate(zip(self.tables, self._inside, strict=True)):
            if self._current[number] == self._step or not any(id(now[index]) in wanted for index in inside):
                continue
            table.catch_up(self._step, rows)
            if rows is None:
                self._current[number] = self._step

    def dissolve(self) -> None:
        """Give each member columns and tables of its own, so that its optimiser steps it alone."""
        for index, ((optimizer, group, place), (table, column)) in enumerate(
            zip(self.members, self._slots, strict=True)
        ):
            optimizer.joint = None
            optimizer.drifts[group, place] = self.drift.alone(table, column)
            state = self._state(index)
            if state:
                state["step"] = self._step_tensor.clone()
                state.update({name: state[name].clone() for name in STEPS})

    def _params(self) -> list[Tensor]:
        return [optimizer.param_groups[group]["params"][place] for optimizer, group, place in self.members]

    def _state(self, index: int) -> dict[str, Any]:
        optimizer, group, place = self.members[index]
        found: dict[str, Any] = optimizer.state.get(optimizer.param_groups[group]["params"][place], {})
        return found

    def _options_of(self, index: int) -> tuple[Any, Any]:
        optimizer, group, _ = self.members[index]
        options = optimizer.param_groups[group]
        return tuple(options["betas"]), options["eps"]

    def _tensors(self) -> list[Any]:
        states = (self._state(index) for index in range(len(self.members)))
        entries = [state.get(name) for state in states for name in ("step", *MOMENTS, *STEPS)]
        return [*self._params(), *entries]


def step_jointly(optimizers: Sequence[Any]) -> bool:
    """Take a step of `LazyAdam` optimisers in few calls; return False if that is not possible.

    It is possible for parameters as `Joint` describes, if all their gradients are sparse with the same
    indices tensor, as `raw_rasterization` returns them, and if options and numbers of steps are equal.
    """
    members = [
        (optimizer, g, p)
        for optimizer in optimizers
        for g, group in enumerate(optimizer.param_groups)
        for p in range(len(group["params"]))
    ]
    if len(members) < len(_WIDTHS):
        return False
    gradients = _common_gradients(members)
    if gradients is None:
        return False
    joint: Joint | None = optimizers[0].joint
    if joint is None or joint.members != members or not joint.is_current():
        for optimizer in optimizers:
            optimizer.leave_joint()
        slots = _slots_of(members)
        if slots is None:
            return False
        joint = Joint(members, slots)
    joint.step(*gradients)
    return True


def _common_gradients(members: Sequence[Member]) -> tuple[Tensor, list[Tensor]] | None:
    """Return the rows that all gradients have and their values; None if the rows differ."""
    found = [optimizer.param_groups[g]["params"][p].grad for optimizer, g, p in members]
    if any(gradient is None or not gradient.is_sparse for gradient in found):
        return None
    if any(gradient.sparse_dim() != 1 for gradient in found):
        return None
    rows, _ = distinct_rows(found[0])
    address, count = rows.data_ptr(), len(rows)
    values = []
    for gradient in found:
        indices = gradient._indices()
        if indices.data_ptr() != address or indices.shape[1] != count:
            return None
        values.append(gradient._values())
    return rows, values


def _slots_of(members: Sequence[Member]) -> list[Slot] | None:
    """Return the slot of each member, or None if the members cannot be joined."""
    slots: list[Slot] = []
    free, alone = list(range(len(_WIDTHS))), 0
    first_state, first_like = None, None
    for optimizer, g, p in members:
        group = optimizer.param_groups[g]
        param = group["params"][p]
        if param.numel() == 0:
            return None
        state = optimizer.state_of(param)
        common = (float(state["step"]), tuple(group["betas"]), group["eps"])
        like = (len(param), param.dtype, param.device)
        if (first_state or common) != common or (first_like or like) != like:
            return None
        first_state, first_like = common, like
        width = param.numel() // len(param)
        column = next((column for column in free if _WIDTHS[column] == width), None)
        rate, rest = rates_of(group)
        if column is None:
            alone += 1
            slots.append((alone, _SH))
        elif width > 3 and rate != rest:
            return None
        else:
            free.remove(column)
            slots.append((0, column))
    return None if free else slots
