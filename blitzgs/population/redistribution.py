# SPDX-License-Identifier: Apache-2.0
"""Redistributes the rows of a model so that the ranks' shards have equal lengths (BlitzGS, section 3.1)."""

from __future__ import annotations

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.sharding import global_positions, imbalance, shard_sizes
from blitzgs.table.table import GaussianTable

# Rows are moved when the largest shard exceeds the smallest by this factor.
MAX_IMBALANCE = 1.1


def redistribute(table: GaussianTable, ranks: Ranks, max_imbalance: float = MAX_IMBALANCE) -> bool:
    """If the shards have become unequal, move the row at position p of the global order to rank p mod M.

    Collective: every rank calls it. All columns are moved; each shard has its rows in the global order.

    Args:
        table: this rank's shard, changed in place.
        max_imbalance: nothing happens up to this ratio of the largest to the smallest shard; 0: always
            redistribute.

    Returns:
        Whether rows were redistributed.
    """
    if ranks.world_size == 1:
        return False
    sizes = shard_sizes(len(table), ranks)
    if imbalance(sizes) <= max_imbalance:
        return False
    mine = global_positions(sizes, ranks.rank) % ranks.world_size
    table.exchange(mine.to(table.device), ranks)
    # Rows arrive by source rank; put them into the global order.
    positions = torch.cat([global_positions(sizes, source) for source in range(ranks.world_size)])
    arrived = positions[positions % ranks.world_size == ranks.rank]
    table.permute(arrived.argsort().to(table.device))
    return True
