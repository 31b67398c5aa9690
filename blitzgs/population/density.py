# SPDX-License-Identifier: Apache-2.0
"""Density control: clone, split and prune Gaussians by the statistics gathered since the last event.

Also the limits of their number: what the photographs resolve, and what the memory holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.config.fields import PopulationConfig
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import smallest
from blitzgs.ops.blocks import take_rows
from blitzgs.ops.counter_random import hash_keys, normal
from blitzgs.optim.table_adam import Pending
from blitzgs.spawn.candidates import Candidates, Veto, spawn_features
from blitzgs.spawn.lineage import Births, Cause, Lineage
from blitzgs.table.placement import place
from blitzgs.table.table import PARAMETERS, GaussianTable, opacity_logit
from blitzgs.util.memory import available_bytes
from blitzgs.util.rotations import quaternion_matrices

SPLIT_SHRINK = 1.6
CHILDREN_OF_A_SPLIT = 2
# Columns with the statistics since the last density event.
STATISTICS = ("grad_sum", "grad_count", "max_radii")
_ID_MASK = (1 << 63) - 1
# Share of the memory that growth may fill; the rest is a reserve for the largest needs of a step.
MEMORY_SHARE = 0.9


@dataclass(frozen=True)
class DensityRules:
    """The thresholds of a density event, with lengths in the unit of the means."""

    grad_threshold: float  # mean 2D-mean gradient norm (half-image units) from which a Gaussian is densified
    clone_scale: float  # up to this largest axis Gaussians are cloned, others split; 0: all are split
    min_opacity: float  # Gaussians of lower opacity are pruned
    max_screen_radius: float | None = None  # pixels, since the last event; larger ones are pruned
    max_scale: float | None = None  # Gaussians with a larger axis are pruned; None: none are
    max_gaussians: int | None = None  # limit of the population after the event; None: no limit
    # With fewer gradients a Gaussian is not judged, and its statistics are kept for the next event: the
    # largest of many noisy means would make Gaussians without need.
    min_observations: int = 1


@dataclass(frozen=True)
class DensityReport:
    """What a density event did on this rank, as numbers of Gaussians."""

    cloned: int  # copies made
    split: int  # Gaussians that were replaced by two children
    pruned: int  # Gaussians removed
    held_back: int  # candidates (with relocation: copies) that the limit of the population held back
    vetoed: int = 0  # candidates that the veto withheld
    relocated: int = 0  # dead Gaussians that were replaced by copies of live ones; the copies count as cloned


def densify(
    table: GaussianTable,
    rules: DensityRules,
    *,
    time: int,
    step: int,
    seed: int,
    level_count: int,
    ranks: Ranks,
    extent: float = 1.0,
    veto: Veto | None = None,
    lineage: Lineage | None = None,
    pending: Pending | None = None,
) -> DensityReport:
    """Run one density event, and reset the statistics that it used.

    A candidate is a Gaussian with at least `min_observations` gradients whose mean, `grad_sum / grad_count`,
    reaches the threshold. A small candidate gets a copy. A large one is replaced by two children that are
    drawn from it and are 1.6 times smaller (Kerbl et al. 2023, section 5). A copy has its parent's octree
    level, a child of a split the next one. Both have the parent's phi and cull row, and moments of zero.
    Their ids and random positions depend only on the parent's id, `time` and the child's slot, so the result
    does not depend on the order of the rows.

    Pruning applies to old and new rows; a new row has no screen radius yet.

    Args:
        table: changed in place; the rows are those of `placement.place`.
        time: time of the event, in images.
        step: the latest optimiser step; new rows are current up to it.
        level_count: number of octree levels K; levels of children stay below it.
        ranks: the job, whose tables together are the population; every rank calls this.
        extent: extent of the scene, in the unit of the means; only used for the candidates' features.
        veto: returns which candidates are withheld; None: none are.
        lineage: logs births and deaths, or None.
        pending: the table's pending steps, of which the candidates take theirs; None: there are none.
    """
    gradient = table["grad_sum"] / table["grad_count"].clamp(min=1)
    candidates = (gradient >= rules.grad_threshold) & (table["grad_count"] >= rules.min_observations)
    wanted, vetoed = candidates.sum(), 0
    if pending is not None:
        pending.catch_up(candidates.nonzero().squeeze(1))
    largest = math.log(rules.clone_scale) if rules.clone_scale > 0 else -math.inf
    small = table["scales"].amax(dim=1) <= largest
    if veto is not None:
        rows = candidates.nonzero().squeeze(1)
        is_split = ~small[rows]
        features = spawn_features(table, rows, is_split, time, extent, level_count)
        rejected = rows[veto(Candidates(table["id"][rows], is_split, features, time), ranks)]
        candidates[rejected], vetoed = False, len(rejected)
    if rules.max_gaussians is not None:
        candidates = _within_cap(candidates, gradient, table["id"], rules.max_gaussians, ranks)
    clones = (candidates & small).nonzero().squeeze(1)
    splits = (candidates & ~small).nonzero().squeeze(1)
    parts = (clones, *[splits] * CHILDREN_OF_A_SPLIT)
    parents, slots = torch.cat(parts), torch.cat([torch.full_like(p, slot) for slot, p in enumerate(parts)])
    new = new_rows(table, parents, slots, time, step)
    level = new["level"]
    new["level"] = torch.where(slots > 0, (level.int() + 1).clamp(max=level_count - 1), level).to(level.dtype)
    _shrink({name: column[len(clones) :] for name, column in new.items()}, seed, time)
    causes = death_causes(table, rules, current(table, "opacities", pending), pending)
    causes[splits] = Cause.SPLIT
    gone = causes.nonzero().squeeze(1)
    causes = torch.cat((causes, causes_of(new["level"], new["scales"], None, new["opacities"], rules)))
    born = (causes[len(table) :] == 0).nonzero().squeeze(1)
    if lineage is not None:
        features = spawn_features(table, parents, slots > 0, time, extent, level_count)
        lineage.born(Births(new["id"], new["parent"], new["means"], features), step)
        # With a size that it knows, the host does not wait for the device.
        n_died = len(causes) - (len(table) - len(gone)) - len(born)
        died = torch.nonzero_static(causes, size=n_died).squeeze(1)
        lineage.died(torch.cat((table["id"], new["id"]))[died], causes[died], time, step)
    grown = len(clones) + len(splits)
    pruned, held_back = grown + len(gone) - len(born), int(wanted) - grown - vetoed
    report = DensityReport(len(clones), len(splits), pruned, held_back, vetoed)
    if len(born) < len(parents):
        parents, new = parents[born], {name: column[born] for name, column in new.items()}
    table.replace(place(len(table), gone, parents, new["means"]), new, most_rows(rules, ranks))
    judged = table["grad_count"] >= rules.min_observations
    for name in ("grad_sum", "grad_count"):
        table[name].masked_fill_(judged, 0)
    table["max_radii"].zero_()
    return report


@torch.no_grad()
def cap_opacities(table: GaussianTable, opacity: float) -> None:
    """Cap the opacities of all rows and set the moments of all opacities to zero; no step may be pending.

    This is the opacity reset of 3DGS (Kerbl et al. 2023, section 5.2).

    `table`: changed in place. `opacity`: the cap, in (0, 1).
    """
    table["opacities"].clamp_(max=opacity_logit(opacity))
    table["exp_avg.opacities"].zero_()
    table["exp_avg_sq.opacities"].zero_()


def child_ids(parents: Tensor, time: int, slots: Tensor) -> Tensor:
    """Return the ids, int64 [M] in [0, 2^63), of children born of `parents` (int64 [M]) in one event.

    A copy is born in slot 0, the children of a split in the slots from 1 on (int64 [M]).
    """
    return hash_keys(parents, time, slots) & _ID_MASK


def _within_cap(candidates: Tensor, gradient: Tensor, ids: Tensor, cap: int, ranks: Ranks) -> Tensor:
    """Keep the candidates of largest gradient (ties to the smaller id), each of which adds one Gaussian."""
    sizes = torch.tensor([len(ids), int(candidates.sum())], device=ids.device)
    population, wanted = ranks.all_reduce(sizes).tolist()
    places_left = max(0, cap - population)
    if wanted <= places_left:
        return candidates
    rows = candidates.nonzero().squeeze(1)
    kept = torch.zeros_like(candidates)
    kept[rows] = smallest(-gradient[rows], ids[rows], places_left, ranks)
    return kept


def new_rows(table: GaussianTable, rows: Tensor, slots: Tensor, time: int, step: int) -> dict[str, Tensor]:
    """Return copies of the rows `rows` as new Gaussians, born in the slots of `child_ids`."""
    names, parents = (*PARAMETERS, "level"), table["id"][rows]
    new = dict(zip(names, take_rows([table[name] for name in names], rows), strict=True))
    own = {"id": child_ids(parents, time, slots), "parent": parents}
    dates = {"birth": time, "last_step": step}
    own |= {name: torch.full_like(rows, date, dtype=torch.int32) for name, date in dates.items()}
    return new | table.inherited(rows) | own


def _shrink(children: dict[str, Tensor], seed: int, time: int) -> None:
    """Draw the children's means from their parent's Gaussian and shrink them, in place.

    In float64, so that the rounded result does not depend on how the maths library vectorises.
    """
    ids = children["id"][:, None]
    draws = normal(ids, seed, time, torch.arange(3, device=ids.device))
    axes = rotations(children["quats"].double())
    offset = (axes * (draws * children["scales"].double().exp())[:, None]).sum(2)
    children["means"].copy_(children["means"].double() + offset)
    children["scales"].copy_(children["scales"].double() - math.log(SPLIT_SHRINK))


def rotations(quats: Tensor) -> Tensor:
    """Normalise quaternions (w, x, y, z) [M, 4] and return their rotation matrices [M, 3, 3]."""
    return quaternion_matrices(quats / quats.norm(dim=1, keepdim=True).clamp(min=1e-30))


def current(table: GaussianTable, name: str, pending: Pending | None) -> Tensor:
    """Return a column as it is after the table's pending steps; None: there are none."""
    return table[name] if pending is None else pending.current(name)


def death_causes(
    table: GaussianTable, rules: DensityRules, opacities: Tensor, pending: Pending | None
) -> Tensor:
    """Return why each row of a table is pruned, see `causes_of`; `opacities` are those after all steps."""
    scales = table["scales"] if rules.max_scale is None else current(table, "scales", pending)
    return causes_of(table["level"], scales, table["max_radii"], opacities, rules)


def causes_of(
    like: Tensor, scales: Tensor, radii: Tensor | None, opacities: Tensor, rules: DensityRules
) -> Tensor:
    """Return why each row is pruned: `Cause.OPACITY`, else `Cause.SIZE` (screen or world); 0: it is kept."""
    causes = torch.zeros_like(like)
    if rules.max_scale is not None:
        causes[scales.amax(dim=1) > math.log(rules.max_scale)] = Cause.SIZE
    if radii is not None and rules.max_screen_radius is not None:
        causes[radii > rules.max_screen_radius] = Cause.SIZE
    causes[opacities < opacity_logit(rules.min_opacity)] = Cause.OPACITY
    return causes


def most_rows(rules: DensityRules, ranks: Ranks) -> int | None:
    """Return the most rows that a rank's share of the population needs; None: there is no limit."""
    return None if rules.max_gaussians is None else -(-rules.max_gaussians // ranks.world_size)


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
    second copy of one column at a time. A step also needs scratch memory on the GPU: the largest amount so
    far beyond the table, per Gaussian.
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
