# SPDX-License-Identifier: Apache-2.0
"""Chooses the rows of Gaussians that join a table when others leave it, so that few rows move.

Blocks of 256 consecutive rows should be small in space (`blitzgs.table.blocks`), and their order does not
matter. A new row takes the place of one that leaves the same block, or else a block near it in the table. New
rows without such a place are put at the end, in Morton order among themselves: a run of blocks that are
larger than the others, as fewer rows share the same space.
"""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.ops.blocks import BLOCK_ROWS, morton_keys
from blitzgs.table.table import Placement


def place(count: int, gone: Tensor, beside: Tensor, means: Tensor) -> Placement:
    """Place M new rows in a table of N rows that D rows leave. The host waits only if D > M.

    Rows that leave are taken as opening brackets in the order of their blocks, and new rows as closing ones,
    behind those of the same block; a bracket and the one that closes it get the same row. So in each block as
    many new rows as possible replace others, and other pairs are close.

    `count`: N. `gone`: int64 [D], ascending, the rows that leave. `beside`: int64 [M], rows near which the
    new Gaussians lie, such as their parents'; they may be leaving. `means`: float32 [M, 3], their positions.
    """
    leaving, joining = len(gone), len(beside)
    blocks, by_block = torch.sort(beside // BLOCK_ROWS, stable=True)
    # Brackets of one depth open and close in turn. Sorted by depth and place, pairs are neighbours.
    keys, order = torch.ops.blitzgs.bracket_keys(gone, blocks).sort()
    new = torch.full_like(by_block, -1)
    is_left = torch.ones_like(gone, dtype=torch.bool)
    torch.ops.blitzgs.match_brackets_(new, is_left, keys, order, gone, by_block)

    # Rows that are left and new Gaussians that are left come together one by one; those that are appended are
    # in Morton order.
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
