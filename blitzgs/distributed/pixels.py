# SPDX-License-Identifier: Apache-2.0
"""Rendered pixels on the move: a ring around a rank's tiles for the loss, whole images for evaluation."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileRanges


def exchange_halo(renders: Tensor, ranges: TileRanges, ranks: Ranks) -> None:
    """Fill in, in place, the pixels of other ranks that this rank's SSIM windows see.

    The ranges are known to all ranks, so the sizes are too: one all-to-all, no waiting for the device. Only
    values travel; gradients need nothing back, because each owner differentiates every window that sees its
    pixels (`blitzgs.ops.photometric`).

    Args:
        renders: [B, H, W, C], contiguous; valid in this rank's tiles.
        ranges: who owns which tiles.
        ranks: the job.
    """
    if ranks.world_size == 1:
        return
    wanted = [ranges.halo(rank) for rank in range(ranks.world_size)]
    _fetch(renders, wanted, ranges, ranks)


def collect_images(renders: Tensor, ranges: TileRanges, ranks: Ranks, destination: int) -> None:
    """Bring all pixels of a rendering to one rank, in place there; they arrive bit for bit.

    Args:
        renders: [B, H, W, C], contiguous; valid in this rank's tiles.
        ranges: who owns which tiles.
        ranks: the job.
        destination: the rank whose `renders` is complete afterwards.
    """
    if ranks.world_size == 1:
        return
    begin, end = ranges.of(destination)
    elsewhere = [(low, high) for low, high in ((0, begin), (end, ranges.bounds[-1])) if low < high]
    _fetch(renders, [elsewhere if r == destination else [] for r in range(ranks.world_size)], ranges, ranks)


def _fetch(renders: Tensor, wanted: list[list[tuple[int, int]]], ranges: TileRanges, ranks: Ranks) -> None:
    """Give each rank the tiles it wants, from their owners, in place."""
    me, everyone = ranks.rank, range(ranks.world_size)
    outgoing = [_overlap(wanted[other], ranges.of(me)) for other in everyone]
    incoming = [_overlap(wanted[me], ranges.of(other)) for other in everyone]
    flat = renders.view(-1, renders.shape[-1])
    pixels_out = _pixels(outgoing, ranges, renders.device)
    pixels_in = _pixels(incoming, ranges, renders.device)
    area = ranges.tile_size**2
    received = ranks.all_to_all(
        flat[pixels_out],
        [area * _length(parts) for parts in outgoing],
        [area * _length(parts) for parts in incoming],
    )
    flat[pixels_in] = received


def _overlap(stretches: list[tuple[int, int]], owned: tuple[int, int]) -> list[tuple[int, int]]:
    cut = [(max(low, owned[0]), min(high, owned[1])) for low, high in stretches]
    return [(low, high) for low, high in cut if low < high]


def _length(stretches: list[tuple[int, int]]) -> int:
    return sum(high - low for low, high in stretches)


def _pixels(groups: list[list[tuple[int, int]]], ranges: TileRanges, device: torch.device) -> Tensor:
    """List the flat pixel indices of stretches of tiles, tile by tile, tile_size^2 each.

    Tiles that stick out of the image repeat their border pixels: the same on both ends of the exchange.
    """
    parts = [torch.arange(low, high, device=device) for group in groups for low, high in group]
    tiles = torch.cat(parts) if parts else torch.empty(0, dtype=torch.int64, device=device)
    view, tile = tiles // ranges.tiles_per_view, tiles % ranges.tiles_per_view
    steps = torch.arange(ranges.tile_size, device=device)
    y = (tile // ranges.tiles_x * ranges.tile_size)[:, None] + steps
    x = (tile % ranges.tiles_x * ranges.tile_size)[:, None] + steps
    rows = view[:, None] * ranges.height + y.clamp(max=ranges.height - 1)
    return (rows[:, :, None] * ranges.width + x.clamp(max=ranges.width - 1)[:, None, :]).flatten()
