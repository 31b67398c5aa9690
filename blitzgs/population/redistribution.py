# SPDX-License-Identifier: Apache-2.0
"""Divides the Gaussians among the ranks, and again when shards have become unequal (BlitzGS, 3.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.table.table import GaussianTable

# Rows are moved when the largest shard exceeds the smallest by this factor.
MAX_IMBALANCE = 1.1


def redistribute(table: GaussianTable, ranks: Ranks, max_imbalance: float = MAX_IMBALANCE) -> bool:
    """If the shards have become unequal, move the row at position p of the global order to rank p mod M.

    Collective: every rank calls it. All columns are moved; each shard has its rows in the global order.

    `table`: this rank's shard, changed in place. `max_imbalance`: nothing happens up to this ratio of the
    largest to the smallest shard; 0: always redistribute. Returns whether rows were redistributed.
    """
    if ranks.world_size == 1:
        return False
    counts = ranks.all_gather(torch.tensor([len(table)], device=ranks.device))
    sizes = torch.cat(counts).tolist()
    if max(sizes) <= max_imbalance * min(sizes):
        return False
    mine = global_positions(sizes, ranks.rank) % ranks.world_size
    table.move_rows(mine.to(table.device), ranks)
    # Rows arrive by source rank; put them into the global order.
    positions = torch.cat([global_positions(sizes, source) for source in range(ranks.world_size)])
    arrived = positions[positions % ranks.world_size == ranks.rank]
    table.permute(arrived.argsort().to(table.device))
    return True


def global_positions(sizes: Sequence[int], rank: int) -> Tensor:
    """Return the position in the global order of each row of one shard.

    The global order is row 0 of every rank, then row 1 of every rank, and so on; ranks without further rows
    are skipped. So a table that was divided round-robin keeps its order. Shards whose sizes differ by at most
    one (the larger ones first) already have exactly the positions = rank (mod M).

    `sizes`: rows on each rank, M values. `rank`: the rank of the shard. Returns int64 [sizes[rank]],
    ascending.
    """
    rows = torch.arange(sizes[rank], dtype=torch.int64)
    positions = torch.zeros_like(rows)
    for other, size in enumerate(sizes):
        # Rows of `other` in the rounds before this one, plus its row of this round if it comes first.
        positions += (rows + 1 if other < rank else rows).clamp(max=size)
    return positions
