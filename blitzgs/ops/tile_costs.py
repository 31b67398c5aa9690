# SPDX-License-Identifier: Apache-2.0
"""Stores what the tiles of each view cost, and divides the tiles of a batch by it.

Both ops work on the host with numbers that it has read, so torch never traces them and they have no fakes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def tile_costs(sums: Tensor, first: int, views: int, grain: int) -> list[Tensor]:
    """Return the costs of the tiles of each view of a batch in the form in which they are stored.

    Args:
        sums: float32 [first + B T] on the CPU, the costs of the T tiles of each view from `first` on, >= 0.
        first: index of the first cost.
        views: B.
        grain: over how many tiles a stored cost averages.

    Returns:
        For each view float16 [ceil(T / grain)], at most 65504, in memory of its own.

    Raises:
        RuntimeError: wrong shapes, dtypes or numbers.
    """
    costs: list[Tensor] = torch.ops.blitzgs.tile_costs(sums, first, views, grain)
    return costs


def divide_tiles(
    costs: Sequence[Tensor], similar: Sequence[Tensor], tiles: int, grain: int, tile_cost: float, parts: int
) -> tuple[int, ...]:
    """Cut the tiles of a batch, one view after the other, into contiguous ranges of nearly equal cost.

    The bounds have the same bits on every host as long as the sum of all costs is below 2^33.

    Args:
        costs: for each of the B views the result of `tile_costs`; an empty one: that of a view without known
            costs. They are the means over the views of `similar`, or zeros.
        similar: results of `tile_costs`.
        tiles: tiles of each view, T.
        grain: that of the costs.
        tile_cost: what each tile costs in addition, at least 8.
        parts: how many ranges, M.

    Returns:
        M + 1 ascending bounds, 0 and B T included; each is the one nearest to its share of the total, the
        later one of two.

    Raises:
        RuntimeError: wrong shapes, dtypes or numbers.
    """
    return tuple(torch.ops.blitzgs.divide_tiles(costs, similar, tiles, grain, tile_cost, parts))
