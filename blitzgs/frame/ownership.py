# SPDX-License-Identifier: Apache-2.0
"""Divides the tiles of a batch among the ranks by their measured cost (BlitzGS, section 3.1)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from itertools import groupby, islice, repeat
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.tiles import TileRanges
from blitzgs.ops.exchange import divide_tiles, tile_costs
from blitzgs.ops.intersect import TILE_SIZE, tile_counts

# Fixed cost of a tile, in units of one list entry: its pixels are written and compared with the photograph.
# The sums of `divide_tiles` are exact from 8 on.
TILE_COST = 8
# Largest number of costs that are stored for a view, 16 KB; a view with fewer tiles has one for each tile.
_MAX_NUMBERS = 8192
# Divisions use the costs of a batch only after this number of later batches. By then the host has read the
# sums of the batch, with its losses. It therefore does not wait, and all ranks have the same costs.
_DELAY = 2
# A view that was not visited yet has the mean costs of this number of the latest others.
_SIMILAR = 16
# The costs of such a view.
_UNKNOWN = torch.empty(0, dtype=torch.float16)


class _ViewCost(NamedTuple):
    """The costs of a view's tiles, stored as float16 means over pieces of `_grain(tiles)` tiles."""

    key: Hashable
    tiles: int
    pieces: Tensor


def _grain(tiles: int) -> int:
    """Return over how many tiles of a view one stored cost averages."""
    return -(-tiles // _MAX_NUMBERS)


def _measured(sums: HostSum, keys: Sequence[Hashable], tiles: int, first: int) -> list[_ViewCost]:
    """Read the costs of the views of a batch; in the sums, those of the first view begin at `first`."""
    grain = _grain(tiles)
    costs = tile_costs(sums.read(), first, len(keys), grain)
    return list(map(_ViewCost, keys, repeat(tiles), costs))


class TileOwners:
    """Divides the tiles of each batch by their costs at the last visit of each view, at most 16 KB a view.

    Every rank has the same costs, so all ranks compute the same division without communication or waiting.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.ranks = ranks
        self._costs: dict[Hashable, _ViewCost] = {}  # by view, in the order of the last visits
        # For each of the latest `_DELAY` batches, a function that reads its costs.
        self._delayed: deque[Callable[[], Sequence[_ViewCost]]] = deque()
        self._planned: dict[int, tuple[int, ...]] = {}

    def plan(self, step: int, keys: Sequence[Hashable], width: int, height: int, halo: int) -> TileRanges:
        """Divide the tiles of a later step as `divide` does; keep the division until `forget_before`."""
        if step in self._planned:
            ranges = TileRanges(self._planned[step], len(keys), width, height, halo)
            # The resolution of the step may have changed since, with the pace of the run.
            if ranges.bounds[-1] == len(keys) * ranges.tiles_per_view:
                return ranges
        ranges = self.divide(keys, width, height, halo)
        self._planned[step] = ranges.bounds
        return ranges

    def forget_before(self, step: int) -> None:
        """Drop the divisions of steps before this one."""
        self._planned = {other: bounds for other, bounds in self._planned.items() if other >= step}

    def columns(self) -> dict[str, Tensor]:
        """Return what a resumed run needs to make the same divisions; the same on every rank.

        Returns views int64 [V], tiles int64 [V] and costs float16 [sum of pieces]: the measured views, their
        numbers of tiles and their costs; ages int64 [V]: 0 if divisions already use the costs, k if they are
        from the k-th of the latest batches, whose costs are not used yet; steps int64 [S] and bounds int64
        [S, M + 1]: the stored divisions. Keys must be integers.
        """
        batches = [list(self._costs.values()), *(measured() for measured in self._delayed)]
        ages = [age for age, batch in enumerate(batches) for _ in batch]
        costs = [cost for batch in batches for cost in batch]
        return {
            "views": torch.tensor([int(str(cost.key)) for cost in costs], dtype=torch.int64),
            "tiles": torch.tensor([cost.tiles for cost in costs], dtype=torch.int64),
            "costs": torch.cat([_UNKNOWN, *(cost.pieces for cost in costs)]),
            "ages": torch.tensor(ages, dtype=torch.int64),
            "steps": torch.tensor(list(self._planned), dtype=torch.int64),
            "bounds": torch.tensor(list(self._planned.values()), dtype=torch.int64),
        }

    def restore(self, columns: Mapping[str, Tensor]) -> None:
        """Restore the state from `columns`; plans for another number of ranks are ignored."""
        if "ages" in columns:  # checkpoints of earlier versions have costs in another form
            self._restore_costs(columns)
        bounds = columns["bounds"]
        if bounds.dim() == 2 and bounds.shape[1] == self.ranks.world_size + 1:
            rows = [tuple(row) for row in bounds.tolist()]
            self._planned = dict(zip(columns["steps"].tolist(), rows, strict=True))

    def _restore_costs(self, columns: Mapping[str, Tensor]) -> None:
        tiles = columns["tiles"].tolist()
        pieces = columns["costs"].split([-(-count // _grain(count)) for count in tiles])
        costs = map(_ViewCost, columns["views"].tolist(), tiles, pieces)
        dated = zip(columns["ages"].tolist(), costs, strict=True)
        for age, batch in groupby(dated, key=lambda pair: pair[0]):
            measured: Callable[[], list[_ViewCost]] = partial(list, [cost for _, cost in batch])
            if age == 0:
                self._learn(measured)
            else:
                self._delayed.append(measured)

    def divide(self, keys: Sequence[Hashable], width: int, height: int, halo: int = 0) -> TileRanges:
        """Divide the tiles of B views, named by keys, into ranges of equal cost to within one tile."""
        tiles = math.prod(tile_counts(width, height, TILE_SIZE))
        found = [self._costs.get(key) for key in keys]
        costs = [_UNKNOWN if cost is None or cost.tiles != tiles else cost.pieces for cost in found]
        # Views have costs in common: in oblique views the far (upper) tiles cost more than the near ones. A
        # view without a visit is therefore expected to cost what similar views do.
        similar = self._similar(tiles) if any(cost is _UNKNOWN for cost in costs) else ()
        bounds = divide_tiles(costs, similar, tiles, _grain(tiles), TILE_COST, self.ranks.world_size)
        return TileRanges(bounds, len(keys), width, height, halo)

    def record(
        self, keys: Sequence[Hashable], tile_work: Tensor, ranges: TileRanges, parts: Tensor | None = None
    ) -> HostSum:
        """Store the costs of a batch's tiles for divisions from the batch after the next on. Collective.

        `tile_work`: int32 [B * T], number of list entries that were composited in each tile. `ranges`: the
        tiles of each rank, which measures their costs. `parts`: float64 [B, K, 2], sums of this rank's loss,
        which are sent together with the costs. Returns the sums (`HostSum.read`); on CUDA the host does not
        wait for a batch whose losses it has read.
        """
        if len(self._delayed) == _DELAY:
            self._learn(self._delayed.popleft())
        sums = HostSum(self.ranks, parts, tile_work, ranges.of(self.ranks.rank))
        first = 0 if parts is None else 2 * len(parts)
        self._delayed.append(partial(_measured, sums, list(keys), ranges.tiles_per_view, first))
        return sums

    def _learn(self, measured: Callable[[], Sequence[_ViewCost]]) -> None:
        """Use the costs of views for later divisions."""
        for cost in measured():
            self._costs.pop(cost.key, None)
            self._costs[cost.key] = cost

    def _similar(self, tiles: int) -> list[Tensor]:
        """Return the stored costs of the latest views with this number of tiles, the latest first."""
        alike = (cost.pieces for cost in reversed(self._costs.values()) if cost.tiles == tiles)
        return list(islice(alike, _SIMILAR))
