# SPDX-License-Identifier: Apache-2.0
"""Which tiles of a batch each rank owns, and which it composites."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from blitzgs.ops.intersect import TILE_SIZE, TileGrid, tile_counts

if TYPE_CHECKING:
    from blitzgs.distributed.group import Ranks

# The loss of an owned pixel reads pixels up to this distance: 5 px of its window, 5 of the gradient.
LOSS_HALO = 10


@dataclass(frozen=True)
class TileRanges:
    """The tiles of B views of one size, one contiguous range per rank.

    Tile (b, ty, tx) has index (b * tiles_y + ty) * tiles_x + tx; rank m owns [bounds[m], bounds[m + 1]).
    """

    bounds: tuple[int, ...]  # M + 1 ascending tile indices, 0 first and B * tiles_y * tiles_x last
    n_views: int  # B
    width: int  # image width in pixels
    height: int  # image height in pixels
    # A rank also composites the tiles within this many pixels of its own, which have the same bits on each.
    # With `LOSS_HALO` it can compute its loss without pixels of other ranks. 0: only its own tiles.
    halo: int = 0

    @cached_property
    def tiles_x(self) -> int:
        """Tiles in a row."""
        return tile_counts(self.width, self.height, TILE_SIZE)[0]

    @cached_property
    def tiles_per_view(self) -> int:
        """Tiles of one view, T."""
        return math.prod(tile_counts(self.width, self.height, TILE_SIZE))

    def of(self, rank: int) -> tuple[int, int]:
        """Return a rank's [first, one past last) tile."""
        return self.bounds[rank], self.bounds[rank + 1]

    def composited(self, rank: int) -> tuple[int, int]:
        """Return the [first, one past last) tile that a rank composites: its own and those within `halo`.

        The range is contiguous and may contain a few further tiles, but never leaves the view. It is empty
        for a rank without tiles. The first tiles ascend with the ranks.
        """
        begin, end = self.of(rank)
        ring = -(-self.halo // TILE_SIZE)
        stretch = ring * (self.tiles_x + 1) if ring else 0
        low = max(begin // self.tiles_per_view * self.tiles_per_view, begin - stretch)
        if begin == end:
            return low, low
        return low, min(-(-end // self.tiles_per_view) * self.tiles_per_view, end + stretch)

    def pixel_mask(self, rank: int, device: torch.device) -> Tensor:
        """Mark the pixels of a rank's tiles, bool [B, H, W]."""
        return TileGrid(self.n_views, self.width, self.height, TILE_SIZE, *self.of(rank)).owned_pixels(device)

    def pixel_rows(self, rank: int) -> list[tuple[int, int]]:
        """Return the rows [y0, y1) of each view that the loss of a rank reads; (0, 0) without tiles."""
        (begin, end), tiles_x, tiles_per_view = self.of(rank), self.tiles_x, self.tiles_per_view
        rows = []
        for first in range(0, self.n_views * tiles_per_view, tiles_per_view):
            low, high = max(begin - first, 0), min(end - first, tiles_per_view)
            y0 = low // tiles_x * TILE_SIZE - LOSS_HALO
            y1 = ((high - 1) // tiles_x + 1) * TILE_SIZE + LOSS_HALO
            rows.append((max(y0, 0), min(y1, self.height)) if low < high else (0, 0))
        return rows


class TileAssignment:
    """The division of tiles among the ranks in one rendering; all ranks of the job render together."""

    def __init__(self, ranks: Ranks, ranges: TileRanges) -> None:
        self.ranks, self.ranges = ranks, ranges
        self.own_tiles = ranges.of(ranks.rank)  # [first, one past last)
        # What a rank composites: its own tiles and the halo around them, [first, one past last).
        self.composited_by_rank = [ranges.composited(rank) for rank in range(ranks.world_size)]
        self.composited_tiles = self.composited_by_rank[ranks.rank]


def collect_images(renders: Tensor, ranges: TileRanges, ranks: Ranks, destination: int) -> None:
    """Send all pixels of a rendering, [B, H, W, C], contiguous, to one rank, whose `renders` gets them."""
    if ranks.world_size == 1:
        return
    here, others = ranks.rank == destination, [rank != destination for rank in range(ranks.world_size)]
    owned = [ranges.of(rank) for rank in range(ranks.world_size)]
    outgoing = [] if here else [owned[ranks.rank]]
    incoming = [stretch for stretch, other in zip(owned, others, strict=True) if here and other]
    pixels = [TILE_SIZE**2 * (end - begin) for begin, end in owned]
    sent = [pixels[ranks.rank] * (not here and not other) for other in others]
    received = [n * (here and other) for n, other in zip(pixels, others, strict=True)]
    flat = renders.view(-1, renders.shape[-1])
    arrived = ranks.all_to_all(flat[_pixels(outgoing, ranges, renders.device)], sent, received)
    flat[_pixels(incoming, ranges, renders.device)] = arrived


def _pixels(stretches: list[tuple[int, int]], ranges: TileRanges, device: torch.device) -> Tensor:
    """List the flat pixels of stretches of tiles, tile by tile; beyond the image, its border is repeated."""
    parts = [torch.arange(low, high, device=device) for low, high in stretches]
    tiles = torch.cat(parts) if parts else torch.empty(0, dtype=torch.int64, device=device)
    view, tile = tiles // ranges.tiles_per_view, tiles % ranges.tiles_per_view
    steps = torch.arange(TILE_SIZE, device=device)
    y = (tile // ranges.tiles_x * TILE_SIZE)[:, None] + steps
    x = (tile % ranges.tiles_x * TILE_SIZE)[:, None] + steps
    rows = view[:, None] * ranges.height + y.clamp(max=ranges.height - 1)
    return (rows[:, :, None] * ranges.width + x.clamp(max=ranges.width - 1)[:, None, :]).flatten()
