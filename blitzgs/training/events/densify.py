# SPDX-License-Identifier: Apache-2.0
"""The events that clone, split, prune and relocate Gaussians, and that cap their opacities."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch

from blitzgs.config.fields import RESET_OPACITY
from blitzgs.config.schedule import Event
from blitzgs.population.density import (
    STATISTICS,
    DensityReport,
    DensityRules,
    GrowthLimit,
    cap_opacities,
    densify,
    growth_limit,
    memory_limit,
)
from blitzgs.population.relocation import relocate
from blitzgs.runs.guard import ModelLostError, check_table
from blitzgs.table.blocks import sort_rows, spread
from blitzgs.table.host_table import HostTable
from blitzgs.table.placement import MAX_IMBALANCE, redistribute
from blitzgs.table.table import PARAMETERS
from blitzgs.training.state import TrainingState

# The table is sorted again when the spread of its blocks exceeds that of the sorted table by this factor
# (docs/decisions.md).
MOST_SPREAD = 4.0


def run_density_event(state: TrainingState, event: Event) -> None:
    """Run one density event and log what it did (errors: NonFiniteError, ModelLostError)."""
    state.stepper.write_back()
    # The largest column, sh, does not decide anything; it is checked with each record of the log.
    check_table(state.table, state.progress.step, PARAMETERS[:-1])
    points, memory = len(state.capture.points), memory_limit(state.table, state.ranks)
    limit = growth_limit(state.config.population, training_pixels(state), points, memory)
    report = change_population(state, event.time, density_rules(state, event.time, limit))
    moved = redistribute(state.table, state.ranks, MAX_IMBALANCE)
    # Views copy whole blocks of a table in host memory.
    is_sorted = moved or isinstance(state.table, HostTable)
    if is_sorted:
        sort_rows(state.table)
    state.stepper.reindex()
    counts, spread_now = _over_all_ranks(state, dataclasses.asdict(report) | {"gaussians": len(state.table)})
    if counts["gaussians"] == 0:
        raise ModelLostError(
            f"the density event after {event.time:,} images pruned the last Gaussian: check that the poses "
            "and points belong together, or prune less (population.min_opacity, prune_screen_radius, "
            "prune_world_scale; schedule.size_prune_after)"
        )
    if _keep_sorted(state, event, spread_now, is_sorted):
        counts["sorted"] = 1
    if moved:
        counts["redistributed"] = 1
    state.progress.peak_gaussians = max(state.progress.peak_gaussians, counts["gaussians"])
    _log(state, event, counts, limit)


def _keep_sorted(state: TrainingState, event: Event, spread_now: int, is_sorted: bool) -> bool:
    """Sort the table if its blocks have become too large; no result depends on it. Every rank calls this.

    After the last event the order stays for the rest of the run, so that sorting always pays. `is_sorted`:
    whether the event has sorted the table already. Returns whether this did.
    """
    if not is_sorted:
        is_compact = spread_now <= MOST_SPREAD * state.progress.sorted_spread
        if is_compact and not state.schedule.is_last_density_event(event.time):
            return False
        sort_rows(state.table)
        state.stepper.reindex()
        _, spread_now = _over_all_ranks(state, {})
    state.progress.sorted_spread = spread_now
    return not is_sorted


def _over_all_ranks(state: TrainingState, counts: dict[str, int]) -> tuple[dict[str, int], int]:
    """Return the sums of named counts over all ranks, and that of the spread of their blocks."""
    own = torch.tensor(list(counts.values()), dtype=torch.int64, device=state.ranks.device)
    # The spread is in thousandths of the scene's extent.
    extent = state.space.extent
    wide = (spread(state.stepper.bounds, extent) * (1000 / extent)).long().to(own.device)
    *sums, spread_now = state.ranks.all_reduce(torch.cat((own, wide[None]))).tolist()
    return dict(zip(counts, sums, strict=True)), spread_now


def _log(state: TrainingState, event: Event, counts: dict[str, int], limit: GrowthLimit | None) -> None:
    """Log the counts of a density event; print a line when a limit holds growth back for the first time."""
    record: dict[str, Any] = counts | {"pixels_per_gaussian": training_pixels(state) / counts["gaussians"]}
    text = None
    if limit is not None:
        record |= {"limit": limit.count, "limited_by": limit.reason}
        if counts["held_back"] and not state.growth_was_limited:
            # A limit ends the growth, but removes nothing.
            more = counts["gaussians"] > limit.count
            has = f", fewer than the {counts['gaussians']:,} that it has, so it does not grow" if more else ""
            text = (
                f"{limit.reason} limits the model to {limit.count:,} Gaussians{has}; this event would have "
                f"added {counts['held_back']:,} more"
            )
            state.growth_was_limited = True
    state.log.event(event.time, "densify", record, text)


def change_population(state: TrainingState, time: int, rules: DensityRules) -> DensityReport:
    """Run the strategy of `population.strategy`. Every rank calls this."""
    population, progress = state.config.population, state.progress
    call: dict[str, Any] = {
        "time": time,
        "step": progress.step,
        "seed": state.config.seed,
        "level_count": progress.level_count,
        "ranks": state.ranks,
        "extent": state.space.extent,
        "lineage": state.lineage,
        "pending": state.optimiser.pending(state.table, progress.step),
    }
    if population.strategy == "relocation":
        report = relocate(state.table, rules, growth=population.growth, **call)
        for name in STATISTICS:
            state.table[name].zero_()
        return report
    veto = state.veto if state.schedule.has_spawn_gate(time) else None
    return densify(state.table, rules, veto=veto, **call)


def training_pixels(state: TrainingState) -> int:
    """Count the pixels of all training photographs."""
    cameras = state.capture.cameras
    return sum(cameras[i].width * cameras[i].height for i in state.capture.train)


def density_rules(state: TrainingState, time: int, limit: GrowthLimit | None) -> DensityRules:
    """Return the rules of a density event at `time`, with lengths in the unit of the means."""
    population, extent = state.config.population, state.space.extent
    by_size = state.schedule.prunes_by_size(time)
    is_limited = state.config.model.random_background  # steps keep to the limit
    return DensityRules(
        grad_threshold=population.grad_threshold,
        clone_scale=population.clone_scale * extent,
        min_opacity=population.min_opacity,
        max_screen_radius=(population.prune_screen_radius or None) if by_size else None,
        max_scale=(population.prune_world_scale * extent or None) if by_size and not is_limited else None,
        max_gaussians=None if limit is None else limit.count,
        min_observations=population.min_observations,
    )


def reset_opacities(state: TrainingState, event: Event) -> None:
    """Cap all opacities at `RESET_OPACITY` and clear their moments (Kerbl et al. 2023, section 5).

    The pending optimiser steps are applied first, because they would otherwise move the opacities with
    moments that no longer exist.
    """
    state.catch_up()
    cap_opacities(state.table, RESET_OPACITY)
    state.curve.restart()
    state.log.event(event.time, "reset_opacities", {"opacity": RESET_OPACITY})
