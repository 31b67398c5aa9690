# SPDX-License-Identifier: Apache-2.0
"""The event that clones, splits and prunes Gaussians."""

from __future__ import annotations

import dataclasses

import torch

from blitzgs.population.density import DensityRules, decay_opacities, densify
from blitzgs.population.growth import GrowthLimit, growth_limit, memory_limit
from blitzgs.population.redistribution import redistribute
from blitzgs.training.guard import ModelLostError, check_table
from blitzgs.training.schedule import Event
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Run one density event and log what it did.

    Raises:
        NonFiniteError: a parameter is not finite.
        ModelLostError: no Gaussian is left.
    """
    step = state.progress.step
    state.catch_up()
    check_table(state.table, step)
    if state.config.population.opacity_decay > 0:
        decay_opacities(state.table, state.config.population.opacity_decay)
    population = state.config.population
    pixels = training_pixels(state)
    limit = growth_limit(
        population.max_gaussians,
        pixels,
        population.pixels_per_gaussian,
        memory_limit(state.table, state.ranks),
    )
    report = densify(
        state.table,
        density_rules(state, event.time, limit),
        time=event.time,
        step=step,
        seed=state.config.seed,
        level_count=state.progress.level_count,
        ranks=state.ranks,
        extent=state.space.extent,
        veto=state.veto if state.schedule.gates(event.time) else None,
        lineage=state.lineage,
    )
    counts = dataclasses.asdict(report) | {"gaussians": len(state.table)}
    values = state.ranks.all_reduce(torch.tensor(list(counts.values()), device=state.ranks.device))
    counts = dict(zip(counts, values.tolist(), strict=True))
    if counts["gaussians"] == 0:
        raise ModelLostError(
            f"the density event after {event.time:,} images pruned the last Gaussian: check that the poses "
            "and points belong together, or prune less (population.min_opacity, prune_screen_radius, "
            "prune_world_scale; schedule.size_prune_after)"
        )
    held_back = counts["held_back"]
    if redistribute(state.table, state.ranks, state.config.ranks.max_imbalance):
        counts["redistributed"] = 1
        state.sort()
    state.stepper.reindex()
    peak = max(state.progress.peak_gaussians, counts["gaussians"])
    state.progress = dataclasses.replace(state.progress, peak_gaussians=peak)
    record = counts | {"pixels_per_gaussian": pixels / max(1, counts["gaussians"])}
    text = None
    if limit is not None:
        record |= {"limit": limit.count, "limited_by": limit.reason}
        if held_back and not state.growth_was_limited:
            text = (
                f"{limit.reason} limits the model to {limit.count:,} Gaussians: "
                f"{held_back:,} weaker candidates wait"
            )
            state.growth_was_limited = True
    state.log.event(event.time, "densify", record, text)


def training_pixels(state: TrainingState) -> int:
    """Count the pixels of all training photographs."""
    cameras = state.capture.cameras
    return sum(cameras[i].width * cameras[i].height for i in state.capture.train)


def density_rules(state: TrainingState, time: int, limit: GrowthLimit | None) -> DensityRules:
    """Return the rules of a density event at `time`, with lengths in the unit of the means."""
    population, extent = state.config.population, state.space.extent
    by_size = state.schedule.prunes_by_size(time)
    return DensityRules(
        grad_threshold=population.grad_threshold,
        clone_scale=population.clone_scale * extent,
        min_opacity=population.min_opacity,
        max_screen_radius=(population.prune_screen_radius or None) if by_size else None,
        max_scale=(population.prune_world_scale * extent or None) if by_size else None,
        max_gaussians=None if limit is None else limit.count,
        min_observations=population.min_observations,
    )
