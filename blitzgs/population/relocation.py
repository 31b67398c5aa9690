# SPDX-License-Identifier: Apache-2.0
"""Relocation (3DGS-MCMC): dead Gaussians become copies of live ones, faint ones move at random."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import smallest
from blitzgs.ops.population import (
    MAX_COPIES,
    draw_weights,
    overlap,
    position_noise_,
    residual_draws,
    share_rows_,
)
from blitzgs.optim.table_adam import Pending
from blitzgs.population.density import (
    CHILDREN_OF_A_SPLIT,
    DensityReport,
    DensityRules,
    current,
    death_causes,
    most_rows,
    new_rows,
)
from blitzgs.spawn.candidates import spawn_features
from blitzgs.spawn.lineage import Births, Cause, Lineage
from blitzgs.table.placement import place
from blitzgs.table.table import GaussianTable, opacity_logit


@torch.no_grad()
def relocate(
    table: GaussianTable,
    rules: DensityRules,
    *,
    growth: float,
    time: int,
    step: int,
    seed: int,
    ranks: Ranks,
    extent: float = 1.0,
    level_count: int = 1,
    lineage: Lineage | None = None,
    pending: Pending | None = None,
) -> DensityReport:
    """Replace dead Gaussians by copies of live ones, and let the population grow.

    Dead Gaussians are those that density control would prune. The number of copies is that of the dead plus
    the share `growth` of the population. Live Gaussians are drawn for copying in proportion to their opacity
    (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", section 3.4). A Gaussian and
    its copies have one position, and share opacity and size such that together they look like the Gaussian
    before (`shared_among_copies`). The copied Gaussian keeps its moments, scaled as its gradients are
    (`share_rows_`), and the copies begin with moments of zero. Copies have the level, phi and cull row of the
    Gaussian that they copy, and no statistics. Draws and ids depend only on (seed, time, id), so the result
    depends neither on the order of the rows nor on the number of ranks.

    Args:
        table: changed in place; the rows are those of `placement.place`.
        rules: thresholds for dead Gaussians, and the limit of the population.
        growth: share of the population that the event adds.
        time: time of the event, in images.
        step: the latest optimiser step; new rows are current up to it.
        ranks: the job, whose tables together are the population; every rank calls this.
        extent: extent of the scene, in the unit of the means; only used for the lineage's features.
        level_count: number of octree levels; only used for the lineage's features.
        lineage: logs births and deaths, or None.
        pending: the table's pending steps, of which the copied Gaussians take theirs; None: there are none.

    Returns:
        The report; `cloned` is the number of all copies on this rank, `relocated` that of the dead they
        replace.
    """
    opacities = current(table, "opacities", pending)
    causes = death_causes(table, rules, opacities, pending)
    dead, weights = causes != 0, draw_weights(opacities, causes)
    own = torch.stack((torch.full((), len(table), device=dead.device), dead.sum(), weights.sum()))
    both = torch.stack((own, ranks.all_reduce(own.clone())))
    (_, n_dead, _), (population, deaths, total) = both.tolist()
    grown = math.floor(population * (1.0 + growth))
    wanted = max(population, grown if rules.max_gaussians is None else min(grown, rules.max_gaussians))
    draws = draw_in_proportion(weights, total, wanted - population + deaths, table["id"], seed, time, ranks)
    # With a size that it knows, the host does not wait for the device.
    sources, gone = draws.nonzero().squeeze(1), torch.nonzero_static(dead, size=n_dead).squeeze(1)
    if pending is not None:
        pending.catch_up(sources)
    copies = draws[sources]
    parents = sources.repeat_interleave(copies)
    features = None
    if lineage is not None:
        features = spawn_features(table, parents, torch.zeros_like(parents).bool(), time, extent, level_count)
    # Sharing must not reduce the opacity below the limit, or the Gaussian would count as dead. With moments
    # of zero a row would move by several times its learning rate in its next steps, as Adam's bias correction
    # is that of the run, not of the row. Each event copies the most opaque Gaussians, and such steps of all
    # of them undo what a run has learnt (docs/decisions.md). No variable keeps the columns, because `replace`
    # frees those that it makes longer.
    share_rows_(
        table["opacities"], table["scales"], (*table.exp_avgs, *table.exp_avg_sqs), sources, copies + 1,
        opacity_logit(rules.min_opacity),
    )  # fmt: skip
    # Slots after those of clones and splits, which may have the same parents in the same event.
    first = (copies.cumsum(0) - copies).repeat_interleave(copies, output_size=len(parents))
    slots = torch.arange(len(parents), device=parents.device) - first + (CHILDREN_OF_A_SPLIT + 1)
    new = new_rows(table, parents, slots, time, step)
    if lineage is not None and features is not None:
        lineage.born(Births(new["id"], new["parent"], new["means"], features), step)
        lineage.died(table["id"][gone], torch.full_like(gone, Cause.RELOCATED), time, step)
    table.replace(place(len(table), gone, parents, new["means"]), new, most_rows(rules, ranks))
    held_back = max(0, grown - wanted) if ranks.rank == 0 else 0
    return DensityReport(cloned=len(new["id"]), split=0, pruned=0, held_back=held_back, relocated=len(gone))


def shared_among_copies(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scales for N Gaussians at one position that together look like one Gaussian.

    Along a line through the centre, the integral of what the N Gaussians composite equals that of the one
    Gaussian:

        o' = 1 - (1 - o)^(1/N),
        s' = s o / overlap(o', N)

    (Kheradmand et al. 2024, eq. 9; `blitzgs.ops.population.overlap`).

    `opacities`: logits, [M]. `scales`: logarithms, [M, 3]. `copies`: N, int64 [M], 1 to `MAX_COPIES`. Returns
    logits and logarithms, float64.
    """
    logits = opacities.double()
    # -log(1 - o') = -log(1 - o) / N
    depth = softplus(logits) / copies.double()
    factor = torch.nn.functional.logsigmoid(logits) - overlap(-torch.expm1(-depth), copies).log()
    return depth.expm1().log(), scales.double() + factor[:, None]


def draw_in_proportion(
    weights: Tensor, total: int, count: int, ids: Tensor, seed: int, time: int, ranks: Ranks
) -> Tensor:
    """Draw `count` times in proportion to weights, over all ranks; every rank calls this.

    The expectation for each row is count w / sum(w), as in a multinomial draw. A row gets the integer part of
    this number for certain; the fractional parts are drawn without replacement (residual resampling, Liu and
    Chen 1998). This has the least variance, and exactly `count` draws in all, except that no row is drawn
    `MAX_COPIES` times.

    `weights`: int64 [N_rank], 0 to 2^31, fewer than 2^31 over all ranks, as is `count`; `total`: their sum.
    Returns int64 [N_rank], how often each row was drawn; zeros if all weights are 0.
    """
    if total == 0 or count <= 0:
        return torch.zeros_like(weights)
    # Other draws use their event's time, which is >= 0, so a negative number gives separate keys.
    whole, keys = residual_draws(weights, ids, count, total, seed, -1 - time)
    rest = count - int(ranks.all_reduce(whole.sum()))
    return whole.add_(smallest(keys, ids, rest, ranks)).clamp_(max=MAX_COPIES - 1)


@dataclass(frozen=True)
class PositionNoise:
    """The noise term of 3DGS-MCMC (Kheradmand et al. 2024, eq. 8), for the Gaussians that a step sees.

    It contains the covariance, a squared length, and is divided by the squared extent of the scene, so that
    it does not depend on the unit of length.
    """

    factor: float  # `optimiser.position_noise`
    extent: float  # of the scene, in the unit of the means
    threshold: float  # opacity at which the noise falls to a half; Gaussians below it are pruned
    seed: int

    def add(self, table: GaussianTable, visible_ids: Tensor, step: int, position_rate: float) -> None:
        """Add noise to the means of rows, int32 [U], current up to `step`; the rate is that of the means."""
        means, quats, scales, opacities, _ = table.parameters
        position_noise_(
            means, quats, scales, opacities, table["id"], visible_ids, seed=self.seed, step=step,
            threshold=self.threshold, strength=self.factor * position_rate / self.extent**2,
        )  # fmt: skip
