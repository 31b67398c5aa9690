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
    columns: Sequence[Tensor],  # [P, ...] each, of any dtype of 4 or 8 bytes; at most 8
    masks: Tensor,  # int64 [P]; bit m sends a splat to rank m
    group_sizes: Sequence[int],  # splats for each of the M ranks, as the masks have them
) -> tuple[Tensor, Tensor]:
    """Copy each splat into the groups of the ranks that it is sent to.

    Returns packed int32 [words]: one group after the other, in each the columns one after the other; and
    places int64 [ceil(P / PLACE_SPLATS), M], where in each group the splats are: what
    `SplatGradients.sum_returned` needs. The order of the splats of a run is kept; on CUDA that of runs is
    not. RuntimeError: columns of different lengths, or too many.
    """
    return torch.ops.blitzgs.scatter_splats([words_of(c) for c in columns], masks, list(group_sizes))


def gather_splats(
    packed: Tensor,  # int32 [words], groups one after the other
    like: Sequence[Tensor],  # the columns that were scattered, or others of their dtypes and splat shapes
    group_sizes: Sequence[int],  # splats of each group
) -> list[Tensor]:
    """Unpack groups to columns [sum(group_sizes), ...] (RuntimeError: `like` needs other words)."""
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


def tile_costs(
    sums: Tensor,  # float32 [first + B T] on the CPU: T costs >= 0 of each view from `first` on
    first: int,  # index of the first cost
    views: int,  # B
    grain: int,  # over how many tiles a stored cost averages
) -> list[Tensor]:
    """Return the costs of each view's tiles as they are stored: float16 [ceil(T / grain)], at most 65504."""
    return torch.ops.blitzgs.tile_costs(sums, first, views, grain)


def divide_tiles(
    # for each of the B views the result of `tile_costs`; an empty one: that of a view without known costs.
    # They are the means over the views of `similar`, or zeros.
    costs: Sequence[Tensor],
    similar: Sequence[Tensor],  # results of `tile_costs`
    tiles: int,  # tiles of each view, T
    grain: int,  # that of the costs
    tile_cost: float,  # what each tile costs in addition, at least 8
    parts: int,  # how many ranges, M
) -> tuple[int, ...]:
    """Cut the tiles of a batch, one view after the other, into contiguous ranges of nearly equal cost.

    The bounds have the same bits on every host as long as the sum of all costs is below 2^33. Returns M + 1
    ascending bounds, 0 and B T included; each is the one nearest to its share of the total, the later one of
    two.
    """
    return tuple(torch.ops.blitzgs.divide_tiles(costs, similar, tiles, grain, tile_cost, parts))
