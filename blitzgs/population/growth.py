# SPDX-License-Identifier: Apache-2.0
"""Limits the number of Gaussians by what the photographs resolve and by what the memory holds."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from blitzgs.config.fields import PopulationConfig
from blitzgs.distributed.group import Ranks
from blitzgs.table.host_table import available_bytes
from blitzgs.table.table import GaussianTable

# Share of the memory that growth may fill; the rest is a reserve for the largest needs of a step.
MEMORY_SHARE = 0.9


@dataclass(frozen=True)
class GrowthLimit:
    """The largest population that a density event may make."""

    count: int  # Gaussians, over all ranks
    reason: str  # the limit that applies, for the log: "memory", or a configuration field


def growth_limit(
    config: PopulationConfig, pixels: int, points: int, memory_count: int | None
) -> GrowthLimit | None:
    """Return the tightest of the limits on a population; None when there is none.

    `pixels`: number of pixels of all training photographs. `points`: number of points of the reconstruction,
    which has more points where there is more detail; 0: they limit nothing. `memory_count`: from
    `memory_limit`; None: no such limit.
    """
    per_pixel, per_point = config.pixels_per_gaussian, config.gaussians_per_point
    counts = {
        "population.max_gaussians": config.max_gaussians or None,
        "population.pixels_per_gaussian": max(1, int(pixels / per_pixel)) if per_pixel > 0 else None,
        "population.gaussians_per_point": max(1, int(points * per_point)) if points * per_point > 0 else None,
        "memory": memory_count,
    }
    limits = [GrowthLimit(count, reason) for reason, count in counts.items() if count is not None]
    return min(limits, key=lambda limit: limit.count, default=None)


def memory_limit(table: GaussianTable, ranks: Ranks) -> int | None:
    """Predict how many Gaussians fit into the memory of all ranks; None if the CPU computes. Collective.

    The memory is that of the GPUs, or of the hosts if the tables are stored there. A density event makes a
    second copy of one column at a time. A step also needs scratch memory on the GPU, which is assumed to grow
    with the population: the largest amount so far beyond the table, per Gaussian.
    """
    if ranks.device.type != "cuda":
        return None
    sizes = table.row_bytes.values()
    if table.device.type == "cpu":
        available, scratch = available_bytes() // ranks.local_world_size + table.memory_bytes, 0
    else:
        # One query; `torch.cuda.memory_allocated` and the like each collect and flatten all statistics.
        statistics = torch.cuda.memory_stats_as_nested_dict(ranks.device)
        allocated, reserved = (statistics[name]["all"] for name in ("allocated_bytes", "reserved_bytes"))
        available = torch.cuda.mem_get_info(ranks.device)[0] + reserved["current"]
        scratch = allocated["peak"] - allocated["current"]
    count = rows_that_fit(len(table), sum(sizes), max(sizes), available, scratch)
    if ranks.world_size == 1:
        return count
    # The ranks' shards stay equal to within `MAX_IMBALANCE`, so the fullest GPU decides for all.
    fewest = ranks.all_reduce(torch.tensor([-count], device=ranks.device), "max")
    return -int(fewest.item()) * ranks.world_size


def rows_that_fit(rows: int, row_bytes: int, widest_column: int, available: int, scratch: int) -> int:
    """Return how many rows of a table, which has `rows` now, fit into `available` bytes.

    `row_bytes`: of one row in all columns; `widest_column`: in the widest one, which is copied when the table
    grows. `scratch`: largest number of bytes needed so far beyond the present table.
    """
    each = row_bytes + widest_column + scratch / max(rows, 1)
    return int(MEMORY_SHARE * available / each)
