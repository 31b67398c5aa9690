# SPDX-License-Identifier: Apache-2.0
"""How many Gaussians a run may have: what the photographs can resolve, and what the memory can hold."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.view.host_table import available_bytes

# Share of the memory that growth may fill; the rest is for what a step needs at its worst.
MEMORY_SHARE = 0.9


@dataclass(frozen=True)
class GrowthLimit:
    """The largest population that a density event may make.

    Attributes:
        count: Gaussians, over all ranks.
        reason: what sets the limit, for the log: "memory" or the option, "population.max_gaussians",
            "population.pixels_per_gaussian" or "population.gaussians_per_point".
    """

    count: int
    reason: str


def growth_limit(
    max_gaussians: int,
    pixels: int,
    pixels_per_gaussian: float,
    points: int,
    gaussians_per_point: float,
    memory_count: int | None,
) -> GrowthLimit | None:
    """Return the tightest of the limits on a population; None when there is none.

    Args:
        max_gaussians: a fixed limit; 0: none.
        pixels: of all training photographs together.
        pixels_per_gaussian: how many of them a Gaussian needs as its evidence; 0: no such limit.
        points: of the reconstruction, which found them where the photographs show detail; 0: no such limit.
        gaussians_per_point: how many Gaussians a point is evidence for; 0: no such limit.
        memory_count: from `memory_limit`; None: no such limit.
    """
    limits = []
    if max_gaussians > 0:
        limits.append(GrowthLimit(max_gaussians, "population.max_gaussians"))
    if pixels_per_gaussian > 0:
        count = max(1, int(pixels / pixels_per_gaussian))
        limits.append(GrowthLimit(count, "population.pixels_per_gaussian"))
    if gaussians_per_point > 0 and points > 0:
        count = max(1, int(points * gaussians_per_point))
        limits.append(GrowthLimit(count, "population.gaussians_per_point"))
    if memory_count is not None:
        limits.append(GrowthLimit(memory_count, "memory"))
    return min(limits, key=lambda limit: limit.count, default=None)


def memory_limit(table: GaussianTable, ranks: Ranks) -> int | None:
    """Predict how many Gaussians all ranks together can hold; None where the CPU computes.

    What counts is the memory of the GPUs or, where the tables are there, of the hosts. A density event makes
    a second copy of one column at a time, and a step needs scratch memory on the GPU that grows with the
    population: the most that was seen beyond the table so far, per Gaussian. Every rank calls this.
    """
    if ranks.device.type != "cuda":
        return None
    row_bytes, widest = _row_bytes(table)
    if table.device.type == "cpu":
        free = available_bytes()
        if free is None:
            return None
        available, scratch = free // ranks.local_world_size + len(table) * row_bytes, 0
    else:
        allocated = torch.cuda.memory_allocated(ranks.device)
        available = torch.cuda.mem_get_info(ranks.device)[0] + torch.cuda.memory_reserved(ranks.device)
        scratch = torch.cuda.max_memory_allocated(ranks.device) - allocated
    count = rows_that_fit(len(table), row_bytes, widest, available, scratch)
    # The ranks' shards stay equal to within `ranks.max_imbalance`, so the fullest GPU decides for all.
    fewest = ranks.all_reduce(torch.tensor([-count], device=ranks.device), "max")
    return -int(fewest.item()) * ranks.world_size


def rows_that_fit(rows: int, row_bytes: int, widest_column: int, available: int, scratch: int) -> int:
    """Return how many rows of a table fit into memory.

    Args:
        rows: that the table has now.
        row_bytes: of one row in all columns.
        widest_column: bytes of one row in the widest column, which is copied when the table grows.
        available: bytes for the table and everything else.
        scratch: bytes needed at the worst beyond the table of today.
    """
    each = row_bytes + widest_column + scratch / max(rows, 1)
    return int(MEMORY_SHARE * available / each)


def _row_bytes(table: GaussianTable) -> tuple[int, int]:
    """Return the bytes of one row in all columns, and in the widest."""
    sizes = list(table.row_bytes.values())
    return sum(sizes), max(sizes)
