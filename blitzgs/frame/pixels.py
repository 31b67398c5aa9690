# SPDX-License-Identifier: Apache-2.0
"""Collects rendered pixels from all ranks into whole images, for evaluation."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.frame.tiles import TileRanges


def collect_images(renders: Tensor, ranges: TileRanges, ranks: Ranks, destination: int) -> None:
    """Send all pixels of a rendering to one rank, which stores them in its `renders`, bit for bit.

    Args:
        renders: [B, H, W, C], contiguous; valid in this rank's tiles.
        ranges: the tiles of each rank.
        ranks: the job.
        destination: the rank whose `renders` is complete afterwards.
    """
    if ranks.world_size == 1:
        return
    here, area = ranks.rank == destination, ranges.tile_size**2
    owned = {rank: ranges.of(rank) for rank in range(ranks.world_size)}
    outgoing = [] if here else [owned[ranks.rank]]
    incoming = [stretch for rank, stretch in owned.items() if here and rank != destination]
    sent, received = [0] * ranks.world_size, [0] * ranks.world_size
    if here:
        received = [area * (end - begin) * (rank != destination) for rank, (begin, end) in owned.items()]
    else:
        sent[destination] = area * sum(end - begin for begin, end in outgoing)
    flat = renders.view(-1, renders.shape[-1])
    arrived = ranks.all_to_all(flat[_pixels(outgoing, ranges, renders.device)], sent, received)
    flat[_pixels(incoming, ranges, renders.device)] = arrived


def _pixels(stretches: list[tuple[int, int]], ranges: TileRanges, device: torch.device) -> Tensor:
    """List the flat pixel indices of stretches of tiles, tile by tile, tile_size^2 each.

    Tiles that extend beyond the image repeat its border pixels, in the same way on the sender and the
    receiver.
    """
    parts = [torch.arange(low, high, device=device) for low, high in stretches]
    tiles = torch.cat(parts) if parts else torch.empty(0, dtype=torch.int64, device=device)
    view, tile = tiles // ranges.tiles_per_view, tiles % ranges.tiles_per_view
    steps = torch.arange(ranges.tile_size, device=device)
    y = (tile // ranges.tiles_x * ranges.tile_size)[:, None] + steps
    x = (tile % ranges.tiles_x * ranges.tile_size)[:, None] + steps
    rows = view[:, None] * ranges.height + y.clamp(max=ranges.height - 1)
    return (rows[:, :, None] * ranges.width + x.clamp(max=ranges.width - 1)[:, None, :]).flatten()
