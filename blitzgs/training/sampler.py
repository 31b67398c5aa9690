# SPDX-License-Identifier: Apache-2.0
"""Chooses the training views of each step's batch, and the resolution of their photographs."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import lru_cache

import torch

from blitzgs.config.schedule import Schedule
from blitzgs.ops.counter_random import hash_keys


class BatchSampler:
    """An endless shuffled sequence of batches of same-size images, as a pure function of the step.

    Views are grouped by image size. Each group is shuffled anew for each of its epochs, and a batch is B
    consecutive views of this sequence, so that every view is drawn equally often. A round has batches of all
    groups, in proportion to their sizes. The result of a call does not depend on earlier calls, so a resumed
    run and every rank get the same batches.

    Attributes:
        batch_size: views per batch, B.
        schedule: decides on the resolution; None: it is always the full one.
    """

    def __init__(
        self, sizes: Sequence[Hashable], batch_size: int, seed: int, schedule: Schedule | None = None
    ) -> None:
        """Group the views.

        Args:
            sizes: image size of each view, any hashable value.
            batch_size: views per batch, B.
            seed: of the shuffles.
            schedule: see above.

        Raises:
            ValueError: there is no view.
        """
        if not sizes:
            raise ValueError("there are no training views: check the capture and its split")
        groups: dict[Hashable, list[int]] = {}
        for view, size in enumerate(sizes):
            groups.setdefault(size, []).append(view)
        self._groups = [torch.tensor(views) for views in groups.values()]
        self._counts = [len(views) for views in groups.values()]
        self.batch_size, self.schedule = batch_size, schedule
        self._seed = seed
        # The latest round: its first step and its batches. Most steps use the same round as the one before.
        self._round: tuple[int, list[tuple[int, int]]] = (0, [])
        self._epoch = lru_cache(maxsize=2 * len(groups))(self._make_epoch)

    def batch(self, step: int) -> list[int]:
        """Return the B views of a step (0-based); a view repeats only where its group's epochs meet."""
        first, batches = self._round
        if not first <= step < first + len(batches):
            index = self._round_of(step)
            first, batches = self._round = self._batches_before(index), self._make_round(index)
        group, batch = batches[step - first]
        begin = batch * self.batch_size
        return [self._view(group, position) for position in range(begin, begin + self.batch_size)]

    def reduction(self, step: int) -> int:
        """Return by which factor the photographs of a step (0-based) are reduced."""
        return 1 if self.schedule is None else self.schedule.reduction(step * self.batch_size)

    def _group_batches(self, size: int, rounds: int) -> int:
        return rounds * size // self.batch_size

    def _batches_before(self, rounds: int) -> int:
        return sum(self._group_batches(count, rounds) for count in self._counts)

    def _round_of(self, step: int) -> int:
        """Find the last round that starts at or before `step` and is not empty."""
        low, high = 0, 1
        while self._batches_before(high) <= step:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self._batches_before(middle) <= step else (low, middle)
        return low

    def _make_round(self, index: int) -> list[tuple[int, int]]:
        """List the batches of a round in their order: group, and number within the group."""
        slots = [
            (g, k)
            for g, count in enumerate(self._counts)
            for k in range(self._group_batches(count, index), self._group_batches(count, index + 1))
        ]
        order = hash_keys(torch.arange(len(slots)), self._seed, index, 1).argsort()
        return [slots[position] for position in order.tolist()]

    def _make_epoch(self, group: int, epoch: int) -> list[int]:
        """List the views of a group in the order of an epoch."""
        views = self._groups[group]
        order: list[int] = views[hash_keys(views, self._seed, epoch, 0).argsort()].tolist()
        return order

    def _view(self, group: int, position: int) -> int:
        epoch, slot = divmod(position, self._counts[group])
        return self._epoch(group, epoch)[slot]
