# SPDX-License-Identifier: Apache-2.0
"""Divides the tiles of a batch among the ranks by their measured cost (BlitzGS, section 3.1)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from itertools import groupby, islice
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from blitzgs.distributed.tiles import TileRanges

# Fixed cost of a tile, in units of one list entry: its pixels are written and compared with the photograph.
TILE_COST = 8
# Number of neighbouring costs that `divide` adds up first.
_STRETCH = 128
# Largest number of costs that are stored for a view, 16 KB; a view with fewer tiles has one for each tile.
_MOST_NUMBERS = 8192
# The costs of this number of latest batches are not used for a division. The host has read the sums of
# earlier batches already, with their losses. It therefore does not wait, and all ranks have the same costs.
_LATE = 2
# The cost of a view that was not visited yet is estimated as the mean cost of this number of other views.
_SIMILAR = 16


class _ViewCost(NamedTuple):
    """The costs of a view's tiles, stored as float16 means over pieces of `_grain(tiles)` tiles."""

    key: Hashable
    tiles: int
    pieces: NDArray[np.float16]


def _grain(tiles: int) -> int:
    """Return over how many tiles of a view one stored cost averages."""
    return -(-tiles // _MOST_NUMBERS)


def _measured(sums: HostSum, keys: Sequence[Hashable], tiles: int, first: int) -> list[_ViewCost]:
    """Read the costs of the views of a batch; in the sums, those of the first view begin at `first`."""
    means, grain = sums.read().numpy()[first:].reshape(len(keys), tiles), _grain(tiles)
    if grain > 1:
        begins = np.arange(0, tiles, grain)
        totals = np.add.reduceat(means, begins, axis=1, dtype=np.float32)
        means = (totals / np.minimum(grain, tiles - begins)).astype(np.float32)
    # Torch converts to and from float16 with the processor's instructions, numpy without. This runs in
    # every step while the GPU waits for its next work, so all views of a batch are converted together.
    halves = torch.from_numpy(means).clamp(max=torch.finfo(torch.float16).max).half().numpy()
    # Each view has its own memory, because the views of a batch are not visited again together.
    return [_ViewCost(key, tiles, pieces.copy()) for key, pieces in zip(keys, halves, strict=True)]


def _of_tiles(costs: Sequence[_ViewCost], tiles: int) -> NDArray[np.float32]:
    """Return the cost of each tile, [V, tiles], of V >= 1 views that have this number of tiles."""
    halves = torch.from_numpy(np.concatenate([cost.pieces for cost in costs]))
    table: NDArray[np.float32] = halves.float().numpy().reshape(len(costs), -1)
    grain = _grain(tiles)
    return table if grain == 1 else table.repeat(grain, axis=1)[:, :tiles]


class TileOwners:
    """Divides the tiles of each batch by their costs at the last visit of each view.

    Every rank has the same costs, so all ranks compute the same division without communication. The costs of
    a view take at most 16 KB. The host does not wait to divide a batch.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.ranks = ranks
        self._costs: dict[Hashable, _ViewCost] = {}  # by view, in the order of the last visits
        self._late: deque[Callable[[], Sequence[_ViewCost]]] = deque()  # read the costs of the latest batches
        self._typical: dict[int, NDArray[np.float32]] = {}  # by number of tiles, for views without a visit
        self._planned: dict[int, tuple[int, ...]] = {}

    def plan(self, step: int, keys: Sequence[Hashable], width: int, height: int, halo: int) -> TileRanges:
        """Divide the tiles of the batch of a later step, as `divide` does, and store the division.

        Args:
            step: step of the batch; its division is stored until `forget_before`.
            keys: identifies each of the B views.
            width: image width in pixels.
            height: image height in pixels.
            halo: see `TileRanges`.
        """
        if step in self._planned:
            return TileRanges(self._planned[step], len(keys), width, height, halo=halo)
        ranges = self.divide(keys, width, height, halo=halo)
        self._planned[step] = ranges.bounds
        return ranges

    def forget_before(self, step: int) -> None:
        """Drop the divisions of steps before this one."""
        self._planned = {other: bounds for other, bounds in self._planned.items() if other >= step}

    def columns(self) -> dict[str, Tensor]:
        """Return what a resumed run needs to make the same divisions; the same on every rank.

        Returns:
            views int64 [V], tiles int64 [V] and costs float16 [sum of pieces]: the measured views, their
            numbers of tiles and their costs; ages int64 [V]: 0 for costs that divisions use, else the number
            of the batch, from 1, among the latest; steps int64 [S] and bounds int64 [S, M + 1]: the stored
            divisions. Keys must be integers.
        """
        batches = [list(self._costs.values()), *(measured() for measured in self._late)]
        ages = [age for age, batch in enumerate(batches) for _ in batch]
        costs = [cost for batch in batches for cost in batch]
        pieces = [torch.from_numpy(cost.pieces) for cost in costs]
        return {
            "views": torch.tensor([int(str(cost.key)) for cost in costs], dtype=torch.int64),
            "tiles": torch.tensor([cost.tiles for cost in costs], dtype=torch.int64),
            "costs": torch.cat([torch.empty(0, dtype=torch.float16), *pieces]),
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
        costs = map(_ViewCost, columns["views"].tolist(), tiles, (piece.numpy() for piece in pieces))
        dated = zip(columns["ages"].tolist(), costs, strict=True)
        for age, batch in groupby(dated, key=lambda pair: pair[0]):
            views = [cost for _, cost in batch]
            if age == 0:
                self._learn(views)
            else:
                self._late.append(partial(list, views))

    def divide(
        self, keys: Sequence[Hashable], width: int, height: int, tile_size: int = 16, halo: int = 0
    ) -> TileRanges:
        """Divide the tiles of a batch.

        Args:
            keys: identifies each of the B views.
            width: image width in pixels.
            height: image height in pixels.
            tile_size: tile edge in pixels.
            halo: see `TileRanges`.

        Returns:
            Ranges whose costs differ from equal shares by at most the cost of one tile.
        """
        unit = TileRanges((0,), len(keys), width, height, tile_size)
        cost = self._expected(keys, unit.tiles_per_view)
        cost += TILE_COST
        bounds = divide(cost, self.ranks.world_size)
        return TileRanges(bounds, len(keys), width, height, tile_size, halo)

    def record(
        self,
        keys: Sequence[Hashable],
        tile_work: Tensor,
        ranges: TileRanges,
        parts: Tensor | None = None,
    ) -> HostSum:
        """Store the costs of a batch's tiles for divisions from the batch after the next on. Collective.

        On CUDA the host does not wait for a batch whose losses it has read.

        Args:
            keys: the B views.
            tile_work: int32 [B * T], number of list entries that were composited in each tile.
            ranges: the tiles of each rank; the cost of a tile is that measured by its owner.
            parts: float64 [B, K, 2], sums of this rank's loss, which are sent together with the costs.

        Returns:
            The sums; see `HostSum.read`.
        """
        if len(self._late) == _LATE:
            self._learn(self._late.popleft()())
        sums = HostSum(self.ranks, parts, tile_work, ranges.of(self.ranks.rank))
        first = 0 if parts is None else 2 * len(parts)
        self._late.append(partial(_measured, sums, list(keys), ranges.tiles_per_view, first))
        return sums

    def _learn(self, costs: Sequence[_ViewCost]) -> None:
        """Use the costs of views for later divisions."""
        for cost in costs:
            self._costs.pop(cost.key, None)
            self._costs[cost.key] = cost
        self._typical.clear()

    def _expected(self, keys: Sequence[Hashable], tiles: int) -> NDArray[np.float32]:
        """Return the costs of the tiles of B views, [B * tiles]; the caller may change the result.

        They are those of a view's last visit, or the mean of other views.
        """
        found = (self._costs.get(key) for key in keys)
        known = [cost if cost is not None and cost.tiles == tiles else None for cost in found]
        visited = [cost for cost in known if cost is not None]
        if len(visited) == len(keys):
            return _of_tiles(visited, tiles).ravel()
        rows = iter(_of_tiles(visited, tiles) if visited else ())
        return np.concatenate([self._typical_cost(tiles) if cost is None else next(rows) for cost in known])

    def _typical_cost(self, tiles: int) -> NDArray[np.float32]:
        """Return the costs that a view without a visit is expected to have, [tiles]."""
        if tiles not in self._typical:
            # Views have costs in common: in oblique views the far (upper) tiles cost more than the near ones.
            alike = (cost for cost in reversed(self._costs.values()) if cost.tiles == tiles)
            latest = list(islice(alike, _SIMILAR))
            mean = _of_tiles(latest, tiles).mean(0) if latest else np.zeros(tiles, np.float32)
            self._typical[tiles] = mean
        return self._typical[tiles]


def divide(cost: NDArray[Any], parts: int) -> tuple[int, ...]:
    """Cut a sequence of costs into contiguous parts of nearly equal sums.

    Args:
        cost: [n], n >= 1, >= 0.
        parts: how many, M.

    Returns:
        M + 1 ascending bounds, 0 and n included; each is the one nearest to its share of the total.
    """
    # First sum whole stretches, then only the stretches that contain a bound. A running sum over all tiles
    # takes four times as long, and every step waits for it.
    stretches = np.add.reduceat(cost, np.arange(0, len(cost), _STRETCH), dtype=np.float64)
    ends = np.concatenate(([0.0], stretches.cumsum()))
    bounds = [0]
    for part in range(1, parts):
        target = ends[-1] * part / parts
        stretch = max(int(np.searchsorted(ends, target)) - 1, 0)
        first = stretch * _STRETCH
        within = cost[first : first + _STRETCH].cumsum(dtype=np.float64) + ends[stretch]
        after = min(int(np.searchsorted(within, target)), len(within) - 1)  # sums are rounded
        start = within[after - 1] if after > 0 else ends[stretch]
        bounds.append(first + after + int(target - start >= within[after] - target))
    return (*bounds, len(cost))


def cost_balance(cost: NDArray[np.float64], bounds: Sequence[int]) -> float:
    """Return the ratio of the largest part's cost to the mean of the parts; 1 is best."""
    ends = np.concatenate(([0.0], np.cumsum(cost)))
    parts = np.diff(ends[list(bounds)])
    return float(parts.max() / parts.mean()) if ends[-1] > 0 else 1.0
