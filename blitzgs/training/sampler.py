# SPDX-License-Identifier: Apache-2.0
"""Which training views form the batch of each step."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import torch

from blitzgs.ops.counter_random import hash_keys


class BatchSampler:
    """An endless shuffled sequence of batches of same-size images, as a pure function of the step.

    Views are grouped by image size. Each group runs through its views epoch by epoch, reshuffled each time,
    and gives B consecutive ones per batch, so that every view is drawn equally often. Rounds mix the groups
    in proportion to their sizes. Nothing is remembered between calls: a resumed run, and every rank, sees the
    same batches.
    """

    def __init__(self, sizes: Sequence[Hashable], batch_size: int, seed: int) -> None:
        """Group the views.

        Args:
            sizes: image size of each view, any hashable value.
            batch_size: views per batch, B.
            seed: of the shuffles.

        Raises:
            ValueError: there is no view.
        """
        if not sizes:
            raise ValueError("there are no training views: check the capture and its split")
        groups: dict[Hashable, list[int]] = {}
        for view, size in enumerate(sizes):
            groups.setdefault(size, []).append(view)
        self._groups = [torch.tensor(views) for views in groups.values()]
        self._batch_size = batch_size
        self._seed = seed

    def batch(self, step: int) -> list[int]:
        """Return the B views of a step (0-based); a view repeats only where its group's epochs meet."""
        index = self._round_of(step)
        first = self._batches_before(index)
        slots = torch.tensor(
            [
                (g, k)
                for g, views in enumerate(self._groups)
                for k in range(
                    self._group_batches(len(views), index), self._group_batches(len(views), index + 1)
                )
            ]
        )
        order = hash_keys(torch.arange(len(slots)), self._seed, index, 1).argsort()
        group, batch = slots[order[step - first]].tolist()
        begin = batch * self._batch_size
        return [self._view(group, position) for position in range(begin, begin + self._batch_size)]

    def _group_batches(self, size: int, rounds: int) -> int:
        return rounds * size // self._batch_size

    def _batches_before(self, rounds: int) -> int:
        return sum(self._group_batches(len(views), rounds) for views in self._groups)

    def _round_of(self, step: int) -> int:
        """Find the last round that starts at or before `step` and is not empty."""
        low, high = 0, 1
        while self._batches_before(high) <= step:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if self._batches_before(middle) <= step else (low, middle)
        return low

    def _view(self, group: int, position: int) -> int:
        views = self._groups[group]
        epoch, slot = divmod(position, len(views))
        order = hash_keys(views, self._seed, epoch, 0).argsort()
        return int(views[order[slot]])
