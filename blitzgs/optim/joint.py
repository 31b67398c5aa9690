# SPDX-License-Identifier: Apache-2.0
"""Steps all parameters of a set of Gaussians in few calls of the ops, because they have the same rows."""

from __future__ import annotations

import operator
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from torch import Tensor

from blitzgs.ops.lazy_adam import GROUPS
from blitzgs.ops.sparse_rows import distinct_rows
from blitzgs.optim.drift import Drift
from blitzgs.optim.handed import Handed, only_handed
from blitzgs.optim.table import MOMENTS, STEPS, Table, rates_of, steps_of

# Values in a row of the op's first four columns, and of the parameter that takes the place of SH beside them.
_WIDTHS = (3, 4, 3, 1, 3)
_SH = len(_WIDTHS) - 1
# Entries of a parameter's state.
_ENTRIES = ("step", *MOMENTS, *STEPS)

# An optimiser, one of its groups, and the index of a parameter in the group. A group's index is not stored,
# because it changes if a group before it is removed.
Member = tuple[Any, dict[str, Any], int]
# The table that a parameter belongs to, and its column there.
Slot = tuple[int, int]


class Joint:
    """Parameters of `LazyAdam` optimisers that have been stepped together since step `drift.begin`.

    Once all rows are up to date (`bring_up_to_date`), parameters and moments may be replaced by others, as
    density strategies do; `follow` then takes these.

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
        self._optimizers = list({id(member[0]): member[0] for member in members}.values())
        for optimizer in self._optimizers:
            optimizer.bring_up_to_date()
            optimizer.drifts.clear()
            optimizer.joint = self
        params, states = self._present()
        self._options = betas, _ = _options_of(members[0][1])
        self._step, self._step_tensor = int(states[0]["step"]), states[0]["step"]
        # The same number for NumPy, which changes it in a tenth of the time that an operation of torch takes.
        self._step_number = self._step_tensor.numpy()
        for state in states:
            state["step"] = self._step_tensor
        self._likes = [(param.shape[1:], param.dtype, param.device) for param in params]
        like, count = params[0], 1 + max(table for table, _ in slots)
        self.drift = Drift(betas, like.dtype, like.device, self._step, count)
        # The members of each table, in the order of its columns.
        self._inside = [
            [index for _, index in sorted((c, i) for i, (t, c) in enumerate(slots) if t == number)]
            for number in range(count)
        ]
        self._take(params, states)

    def _present(self) -> tuple[list[Tensor], list[dict[str, Any]]]:
        """Return the present parameters and states of the members."""
        params = [group["params"][place] for _, group, place in self.members]
        states = [member[0].state_of(param) for member, param in zip(self.members, params, strict=True)]
        return params, states

    def _take(self, params: Sequence[Tensor], states: Sequence[dict[str, Any]]) -> None:
        """Make tables of parameters whose rows are up to date."""
        like = params[0]
        self.tables = []
        for number, inside in enumerate(self._inside):
            steps = [steps_of(like, self._step - self.drift.begin) for _ in STEPS]
            for index in inside:
                states[index].update(zip(STEPS, steps, strict=True))
            own = [params[index] for index in inside], [states[index] for index in inside]
            self.tables.append(Table(*own, self.drift, number, self._options[1]))
        self._states = [tensor for table in self.tables for tensor in table.tensors]
        # The step up to which all rows of each table are known to be current.
        self._current = [self._step] * len(self.tables)
        # What `_is_current` compares; empty: the rows were brought up to date, and may be others.
        self._known = [
            (*member, param, state, [state[name] for name in _ENTRIES])
            for member, param, state in zip(self.members, params, states, strict=True)
        ]
        # The parameters of each table, which `_known` keeps alive.
        self._ids = [{id(params[index]) for index in inside} for inside in self._inside]
        self._all_ids = set().union(*self._ids)

    def follow(self) -> bool:
        """Take parameters and state that replaced those of the members, or dissolve if they do not fit.

        Returns:
            Whether the members are still joined.
        """
        if self._is_current():
            return True
        if self._may_take():
            self._take(*self._present())
            return True
        self.dissolve()
        return False

    def _may_take(self) -> bool:
        """Tell whether the members' present parameters are up to date and like those before them."""
        counts = set()
        for (optimizer, group, place), like in zip(self.members, self._likes, strict=True):
            if place >= len(group["params"]) or _options_of(group) != self._options:
                return False
            param = group["params"][place]
            state = optimizer.state.get(param)
            if not state or state.get("step") is not self._step_tensor or STEPS[0] in state:
                return False
            if (param.shape[1:], param.dtype, param.device) != like:
                return False
            counts.add(len(param))
        return len(counts) == 1 and 0 not in counts

    def _is_current(self) -> bool:
        """Tell whether the members still have the parameters, state and options that were joined."""
        # Each training step asks this twice, so it is one loop with few calls.
        options = self._options
        for optimizer, group, place, param, state, entries in self._known:
            params = group["params"]
            if place >= len(params) or params[place] is not param or optimizer.state.get(param) is not state:
                return False
            if not all(map(operator.is_, map(state.get, _ENTRIES), entries)):
                return False
            if (group["betas"], group["eps"]) != options and _options_of(group) != options:
                return False
        return bool(self._known)

    def param_ids(self) -> set[int]:
        """Return the `id` of every parameter."""
        return self._all_ids

    def receive(self, rows: Tensor, gradients: Mapping[Tensor, Tensor]) -> None:
        """Hand gradients to the optimisers, see `LazyAdam.receive`."""
        handed = Handed(rows, gradients)
        for optimizer in self._optimizers:
            optimizer.handed.append(handed)

    def has_members(self, members: Sequence[Member]) -> bool:
        """Tell whether these are the members, in the same order."""
        return len(members) == len(self.members) and all(
            optimizer is known[0] and group is known[1] and place == known[2]
            for (optimizer, group, place), known in zip(members, self.members, strict=True)
        )

    def step(self, indices: Tensor, gradients: Sequence[Tensor]) -> None:
        """Take a step for some rows.

        Args:
            indices: int64 [1, A] or [A], the rows, each once.
            gradients: their gradients for each member, [A, ...].
        """
        if self.drift.is_full(self._step):
            for table in self.tables:
                table.restart(self._step)
            self.drift.restart(self._step)
        current = [step == self._step for step in self._current]
        self._step += 1
        self._step_number[...] = self._step
        rates, columns = [0.0] * (GROUPS * len(self.tables)), []
        for (_, group, _), (number, column) in zip(self.members, self._slots, strict=True):
            first, rest = rates_of(group)
            rates[GROUPS * number + column] = first
            if column == _SH:
                rates[GROUPS * number + column + 1] = rest
        for table, inside in zip(self.tables, self._inside, strict=True):
            columns += table.columns([gradients[index] for index in inside])
        eps = self._options[1]
        self.drift.step(self._step, rates, eps, self._states, columns, indices, current)

    def catch_up(
        self, params: Collection[Tensor], rows: Tensor | None = None, count: Tensor | None = None
    ) -> None:
        """Apply the steps that rows of the tables of some parameters missed; as `LazyAdam.catch_up`."""
        behind = [number for number, step in enumerate(self._current) if step != self._step]
        if not behind:
            return
        wanted = {id(param) for param in params}
        for number in behind:
            if not wanted.isdisjoint(self._ids[number]):
                self.tables[number].catch_up(self._step, rows, count)
                if rows is None:
                    self._current[number] = self._step

    def bring_up_to_date(self) -> None:
        """Bring all rows and their moments up to date, and leave the states of `torch.optim.Adam`.

        Until `follow` is called, nothing here keeps the parameters and their state alive.
        """
        for table in self.tables:
            table.bring_up_to_date(self._step)
        for _, _, _, _, state, _ in self._known:
            for name in STEPS:
                del state[name]
        self.tables, self._states, self._known = [], [], []

    def dissolve(self) -> None:
        """Give each member columns and tables of its own, so that its optimiser steps it alone.

        A member whose group or parameter was removed from its optimiser gets nothing.
        """
        for (optimizer, group, place), (table, column) in zip(self.members, self._slots, strict=True):
            optimizer.joint = None
            index = optimizer.index_of(group)
            if index is None or place >= len(group["params"]):
                continue
            state = optimizer.state.get(group["params"][place])
            if state:
                state["step"] = state["step"].clone()
            if state and STEPS[0] in state:
                optimizer.drifts[index, place] = self.drift.alone(table, column)
                state.update({name: state[name].clone() for name in STEPS})


def _options_of(group: dict[str, Any]) -> tuple[Any, Any]:
    return tuple(group["betas"]), group["eps"]


def step_jointly(optimizers: Sequence[Any]) -> bool:
    """Take a step of `LazyAdam` optimisers in few calls; return False if that is not possible.

    It is possible for parameters as `Joint` describes, if all their gradients are sparse with the same
    indices tensor, as `raw_rasterization` returns them, and if options and numbers of steps are equal.
    """
    members = [
        (optimizer, group, place)
        for optimizer in optimizers
        for group in optimizer.param_groups
        for place in range(len(group["params"]))
    ]
    if len(members) < len(_WIDTHS):
        return False
    gradients = only_handed(members)
    if gradients is None:
        for optimizer in optimizers:
            optimizer.move_handed()
        gradients = _common_gradients(members)
    if gradients is None:
        return False
    joint: Joint | None = optimizers[0].joint
    if joint is None or not joint.has_members(members) or not joint.follow():
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
    found = [group["params"][place].grad for _, group, place in members]
    if any(gradient is None or not gradient.is_sparse for gradient in found):
        return None
    if found[0].sparse_dim() != 1:
        return None
    indices, first = distinct_rows(found[0])
    # The indices of a gradient with several sparse dimensions have another shape.
    address, shape = indices.data_ptr(), indices.shape
    values = [first]
    for gradient in found[1:]:
        own = gradient._indices()
        if own.data_ptr() != address or own.shape != shape:
            return None
        values.append(gradient._values())
    return indices, values


def _slots_of(members: Sequence[Member]) -> list[Slot] | None:
    """Return the slot of each member, or None if the members cannot be joined."""
    slots: list[Slot] = []
    free, alone = list(range(len(_WIDTHS))), 0
    first_state, first_like = None, None
    for optimizer, group, place in members:
        param = group["params"][place]
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
