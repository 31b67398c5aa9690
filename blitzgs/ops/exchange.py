# SPDX-License-Identifier: Apache-2.0
"""Packs splats by destination rank and unpacks received ones; divides tiles among ranks by what they cost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# Consecutive splats, a run, that share an entry of `places`: kPlaceSplats of csrc/exchange/scatter.h.
PLACE_SPLATS = 32


def scatter_splats(
    columns: Sequence[Tensor], masks: Tensor, group_sizes: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Copy each splat into the groups of the ranks that it is sent to.

    Args:
        columns: [P, ...] each, of any dtype of 4 or 8 bytes; at most 8.
        masks: int64 [P]; bit m sends a splat to rank m.
        group_sizes: splats for each of the M ranks, as the masks have them.

    Returns:
        packed int32 [words]: one group after the other, in each the columns one after the other; and places
        int64 [ceil(P / PLACE_SPLATS), M], where in each group the splats are: what
        `SplatGradients.sum_returned` needs. The order of the splats of a run is kept; on CUDA that of runs is
        not.

    Raises:
        RuntimeError: columns of different lengths, or too many.
    """
    return torch.ops.blitzgs.scatter_splats([words_of(c) for c in columns], masks, list(group_sizes))


def gather_splats(packed: Tensor, like: Sequence[Tensor], group_sizes: Sequence[int]) -> list[Tensor]:
    """Unpack groups that `scatter_splats` packed into columns.

    Args:
        packed: int32 [words], groups one after the other.
        like: the columns that were scattered, or others of their dtypes and splat shapes.
        group_sizes: splats of each group.

    Returns:
        Columns [sum(group_sizes), ...] with the dtypes and splat shapes of `like`.

    Raises:
        RuntimeError: the number of words is not what `like` needs.
    """
    widths = [words_per_splat(column) for column in like]
    parts = torch.ops.blitzgs.gather_splats(packed, widths, list(group_sizes))
    return [
        words.view(column.dtype).reshape(-1, *column.shape[1:])
        for words, column in zip(parts, like, strict=True)
    ]


def words_per_splat(column: Tensor) -> int:
    """Return how many 32-bit words one splat takes in a column."""
    return math.prod(column.shape[1:]) * column.element_size() // 4


def words_of(column: Tensor) -> Tensor:
    """View a column [P, ...] as int32 [P, words]."""
    flat = column.reshape(len(column), math.prod(column.shape[1:]))
    if flat.stride() != (flat.shape[1], 1):
        # Viewing another dtype needs exact strides, also of a single splat.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.int32)


def tile_costs(sums: Tensor, first: int, views: int, grain: int) -> list[Tensor]:
    """Return the costs of the tiles of each view of a batch in the form in which they are stored.

    Args:
        sums: float32 [first + B T] on the CPU, the costs of the T tiles of each view from `first` on, >= 0.
        first: index of the first cost.
        views: B.
        grain: over how many tiles a stored cost averages.

    Returns:
        For each view float16 [ceil(T / grain)], at most 65504, in memory of its own.
    """
    return torch.ops.blitzgs.tile_costs(sums, first, views, grain)


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
    """
    return tuple(torch.ops.blitzgs.divide_tiles(costs, similar, tiles, grain, tile_cost, parts))
