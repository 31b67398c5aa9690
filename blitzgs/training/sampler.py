# SPDX-License-Identifier: Apache-2.0
"""Chooses the training views of each step's batch, and the resolution of their photographs."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Hashable, Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.cameras import Camera, Float64, camera_centres
from blitzgs.capture.lengths import depths_seen, sampled
from blitzgs.config.schedule import Schedule
from blitzgs.ops.counter_random import hash_keys, uniform
from blitzgs.table.blocks import morton_order

# A view moves by up to this share of a tour, see `BatchSampler`. The views of such a piece should see no more
# Gaussians than the device holds: an eighth of a survey sees about a fifth of its Gaussians.
_PIECE = 0.125
# Steps whose random colours are drawn together: one call takes as long for all as for one.
_DRAWN = 256


class BatchSampler:
    """An endless shuffled sequence of batches of same-size images, as a pure function of the step.

    Views are grouped by image size. Each group is shuffled anew for each of its epochs, and a batch is B
    consecutive views of this sequence, so that every view is drawn equally often. A round has batches of all
    groups, in proportion to their sizes. The result of a call does not depend on earlier calls, so a resumed
    run and every rank get the same batches.

    With a tour, an epoch still has every view once, but follows the tour from a random place in a random
    direction, and each view comes later by a random share of up to an eighth of the tour. So the views of a
    piece are shuffled, and what they see stays in the memory of the device meanwhile.
    """

    def __init__(
        self,
        sizes: Sequence[Hashable],
        batch_size: int,
        seed: int,
        schedule: Schedule | None = None,
        tour: Sequence[int] | None = None,
    ) -> None:
        """Group the views by their image sizes, which are any hashable values.

        A tour has all views, so ordered that neighbours see the same places; None: no place matters.
        ValueError: there is no view.
        """
        if not sizes:
            raise ValueError("there are no training views: check the capture and its split")
        # Of each view, the share of the tour before it.
        self._places = None if tour is None else torch.tensor(tour).argsort() / len(sizes)
        groups: dict[Hashable, list[int]] = {}
        for view, size in enumerate(sizes):
            groups.setdefault(size, []).append(view)
        self._groups = [torch.tensor(views) for views in groups.values()]
        self._counts = [len(views) for views in groups.values()]
        # The schedule decides on the resolution; None: it is always the full one.
        self.batch_size, self.schedule, self._seed = batch_size, schedule, seed
        # The latest round: its first step and its batches. Most steps use the same round as the one before.
        self._round: tuple[int, list[tuple[int, int]]] = (0, [])
        self._epoch = lru_cache(maxsize=2 * len(groups))(self._make_epoch)
        # Who looks ahead asks for this round and the next one in turn.
        self._batches_of = lru_cache(maxsize=2)(self._make_round)
        self._colours = lru_cache(maxsize=2)(self._draw)

    def batch(self, step: int) -> list[int]:
        """Return the B views of a step (0-based); a view repeats only where its group's epochs meet."""
        first, batches = self._round
        if not first <= step < first + len(batches):
            # The last round that starts at or before the step and is not empty.
            index = bisect_right(range(1 << 60), step, key=self._batches_before) - 1
            first, batches = self._round = self._batches_before(index), self._batches_of(index)
        group, batch = batches[step - first]
        begin = batch * self.batch_size
        return [self._at(group, position)[2] for position in range(begin, begin + self.batch_size)]

    def reduction(self, step: int) -> int:
        """Return by which factor the photographs of a step (0-based) are reduced."""
        return 1 if self.schedule is None else self.schedule.reduction(step * self.batch_size)

    def backgrounds(self, step: int) -> Tensor:
        """Return a random colour for each view of a step (0-based), float64 [B, 3] in (0, 1)."""
        block, place = divmod(step, _DRAWN)
        return self._colours(block)[place]

    def _draw(self, block: int) -> Tensor:
        return uniform(torch.arange(_DRAWN * 3 * self.batch_size), self._seed, block, 3).view(_DRAWN, -1, 3)

    def _batches_before(self, rounds: int) -> int:
        return sum(rounds * count // self.batch_size for count in self._counts)

    def _make_round(self, index: int) -> list[tuple[int, int]]:
        """List the batches of a round in their order: group, and number within the group."""
        slots = [
            (g, k)
            for g, count in enumerate(self._counts)
            for k in range(index * count // self.batch_size, (index + 1) * count // self.batch_size)
        ]
        if self._places is not None:
            return sorted(slots, key=lambda slot: self._at(slot[0], slot[1] * self.batch_size)[:2])
        order = hash_keys(torch.arange(len(slots)), self._seed, index, 1).argsort()
        return [slots[position] for position in order.tolist()]

    def _make_epoch(self, group: int, epoch: int) -> tuple[list[int], list[float]]:
        """List the views of a group in the order of an epoch, and the keys by which they are sorted."""
        views = self._groups[group]
        if self._places is None:
            keys = hash_keys(views, self._seed, epoch, 0)
        else:
            begin, direction = uniform(torch.arange(2), self._seed, epoch, 2)
            places = (self._places[views] + begin) % 1.0
            delays = _PIECE * uniform(views, self._seed, epoch, 0)
            keys = (places if direction < 0.5 else 1.0 - places) + delays
        order = keys.argsort(stable=True)
        return views[order].tolist(), keys[order].tolist()

    def _at(self, group: int, position: int) -> tuple[int, float, int]:
        """Return what is at a position of a group's sequence: its epoch, its key there, and the view."""
        epoch, slot = divmod(position, self._counts[group])
        views, keys = self._epoch(group, epoch)
        return epoch, keys[slot], views[slot]


def tour_of(cameras: Sequence[Camera], points: Float64) -> list[int]:
    """Return the cameras in the Morton order of the places that they show; points are [M, 3] in their world.

    The place is on the optical axis, at the median depth of the points that the camera sees; the camera's own
    place if it sees none. Points behind others count, as they do where Gaussians are loaded for a view.
    """
    sample = sampled(points, len(cameras))
    poses = np.stack([camera.world_to_camera for camera in cameras])
    depths = (depths_seen(camera, sample) for camera in cameras)
    middles = np.array([np.median(seen) if len(seen) else 0.0 for seen in depths])
    # Row 2 of a pose is the optical axis.
    places = camera_centres(poses) + middles[:, None] * poses[:, 2, :3]
    return morton_order(torch.from_numpy(places)).tolist()
