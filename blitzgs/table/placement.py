# SPDX-License-Identifier: Apache-2.0
"""Chooses the rows of Gaussians that join a table when others leave it, and the ranks of all Gaussians.

Blocks of 256 consecutive rows should be small in space (`blitzgs.table.blocks`), and their order does not
matter. A new row takes the place of one that leaves the same block, or else a block near it in the table. New
rows without such a place are put at the end, in Morton order among themselves: a run of blocks that are
larger than the others, as fewer rows share the same space. So few rows move.

When the ranks' shards have become unequal, the Gaussians are divided anew (BlitzGS, 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.blocks import BLOCK_ROWS, morton_keys
from blitzgs.table.table import GaussianTable, Placement

# Rows are moved when the largest shard exceeds the smallest by this factor.
MAX_IMBALANCE = 1.1


def place(count: int, gone: Tensor, beside: Tensor, means: Tensor) -> Placement:
    """Place M new rows in a table of N rows that D rows leave. The host waits only if D > M.

    Rows that leave are taken as opening brackets in the order of their blocks, and new rows as closing ones,
    behind those of the same block; a bracket and the one that closes it get the same row. So in each block as
    many new rows as possible replace others, and other pairs are close. `gone`: int64 [D], ascending, the
    rows that leave. `beside`: int64 [M], rows near which the new Gaussians lie, such as their parents'; they
    may be leaving. `means`: float32 [M, 3], their positions.
    """
    leaving, joining = len(gone), len(beside)
    blocks, by_block = torch.sort(beside // BLOCK_ROWS, stable=True)
    # Brackets of one depth open and close in turn. Sorted by depth and place, pairs are neighbours.
    keys, order = torch.ops.blitzgs.bracket_keys(gone, blocks).sort()
    new = torch.full_like(by_block, -1)
    is_left = torch.ones_like(gone, dtype=torch.bool)
    torch.ops.blitzgs.match_brackets_(new, is_left, keys, order, gone, by_block)

    # Rows and new Gaussians that are left come together one by one; what is appended is in Morton order.
    rank_left = is_left.cumsum(0)
    left = gone.new_empty(leaving + 1)
    left[(rank_left - 1).where(is_left, leaving)] = gone
    n_left = rank_left[-1:].sum()
    keys = morton_keys(means) if joining > leaving else torch.arange(joining, device=gone.device)
    along = keys.sort(stable=True).indices
    is_placed = new[along] >= 0
    rank = (~is_placed).cumsum(0) - 1
    others = left[rank.clamp(0, leaving)].where(rank < n_left, count + rank - n_left)
    new[along] = new[along].where(is_placed, others)
    total = count - leaving + joining
    if joining >= leaving:
        nothing = gone.new_empty(0)
        return Placement(total, new, nothing, nothing)
    return _without_end(count, total, new, gone[is_left & (rank_left > (~is_placed).sum())])


def _without_end(count: int, total: int, new: Tensor, free: Tensor) -> Placement:
    """Move what is in the rows from `total` on to the rows of `free` (int64, ascending) before it."""
    is_low = free < total
    low = free[is_low]
    is_used = torch.ones(count - total, dtype=torch.bool, device=new.device)
    is_used[free[~is_low] - total] = False
    target = torch.arange(total, count, device=new.device)
    target[is_used] = low
    at_end = new >= total
    ends = (new[at_end] - total).clone()
    new[at_end] = target[ends]
    is_used[ends] = False
    return Placement(total, new, is_used.nonzero().squeeze(1) + total, target[is_used])


def redistribute(table: GaussianTable, ranks: Ranks, max_imbalance: float = MAX_IMBALANCE) -> bool:
    """If the shards have become unequal, move the row at position p of the global order to rank p mod M.

    Collective. All columns are moved; each shard has its rows in the global order. `max_imbalance`: nothing
    happens up to this ratio of the largest to the smallest shard; 0: always redistribute. Returns whether
    rows moved.
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
    """Return the position in the global order of each row of one shard, int64, ascending.

    The global order is row 0 of every rank, then row 1 of every rank, and so on; ranks without further rows
    are skipped. So a table that was divided round-robin keeps its order, and shards whose sizes differ by at
    most one (the larger ones first) have exactly the positions = rank (mod M). `sizes`: rows on each rank.
    """
    rows = torch.arange(sizes[rank], dtype=torch.int64)
    positions = torch.zeros_like(rows)
    for other, size in enumerate(sizes):
        # Rows of `other` in the rounds before this one, plus its row of this round if it comes first.
        positions += (rows + 1 if other < rank else rows).clamp(max=size)
    return positions
