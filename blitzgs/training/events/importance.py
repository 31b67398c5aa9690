# SPDX-License-Identifier: Apache-2.0
"""The two importance passes: score all Gaussians over the training views, and prune by the scores."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from blitzgs.config.schedule import Event
from blitzgs.population.importance import Importance, ViewBatch, sample_by_score, sweep, top_by_score
from blitzgs.runs.guard import ModelLostError, check_table
from blitzgs.spawn.lineage import Cause
from blitzgs.table.blocks import sort_rows
from blitzgs.table.placement import redistribute
from blitzgs.table.table import opacity_logit
from blitzgs.training import view_level
from blitzgs.training.state import TrainingState
from blitzgs.util.progress import Report

# Smallest number of views to survey together; with fewer, a GPU would wait for the host.
LEAST_VIEWS = 4


def run_importance_pass(state: TrainingState, event: Event) -> None:
    """Score all Gaussians, store phi and the cull mask, prune by the scores and redistribute the rows.

    No view is surveyed if all Gaussians are kept and nothing uses phi or the cull matrix. Errors are
    NonFiniteError, ModelLostError, and SweepStoppedError if the run has to stop: the pass has then changed
    nothing.
    """
    if not state.config.population.importance:
        return
    state.catch_up()
    check_table(state.table, state.progress.step)
    before, views = state.population(), 0
    # Relocation does not use phi.
    uses_signals = state.config.view.cull or state.config.population.strategy == "density"
    if uses_signals or not _keeps_all(state, event):
        views = len(state.capture.train)
        found = _surveyed(state, views)
        found.store(state.table, state.config.view.cull)
        causes = causes_of_death(state, event, found)
        if state.lineage is not None:
            gone = causes.nonzero().squeeze(1)
            state.lineage.died(state.table["id"][gone], causes[gone], event.time, state.progress.step)
        state.table.keep(causes == 0)
    after = state.population()
    if after == 0:
        raise ModelLostError(_nothing_kept(state, event, before))
    redistribute(state.table, state.ranks, max_imbalance=0)
    sort_rows(state.table)
    state.stepper.reindex()
    state.progress.milestones |= {f"before_{event.kind}": before, f"after_{event.kind}": after}
    state.progress.sorted_spread = 0
    view_level.choose_views(state)
    counts = {"before": before, "gaussians": after, "views": views}
    state.log.event(event.time, event.kind, counts, _described(state, event, before, after))


def _surveyed(state: TrainingState, views: int) -> Importance:
    subject = state.subject()
    with state.log.work("views surveyed") as report:
        return sweep(
            subject.gaussians,
            _reported(view_batches(state), report, views),
            views,
            subject.options,
            state.ranks,
            owners=state.owners,
            rule=state.config.population.score,
            lod=subject.lod,
            stops=state.stops,
        )


def _described(state: TrainingState, event: Event, before: int, after: int) -> str | None:
    """Return in words how many Gaussians a pass kept; None: all, as the configuration says."""
    if after < before:
        return f"the importance pass keeps {after:,} of {before:,} Gaussians"
    population, views = state.config.population, len(state.capture.train)
    prunes = min(population.pass2_mass, population.pass2_keep) < 1
    if event.kind == "pass_2" and prunes and views < population.pass2_views:
        few = f"{views} training views are fewer than population.pass2_views ({population.pass2_views})"
        return f"the importance pass keeps all Gaussians: {few}"
    return None


def _keeps_all(state: TrainingState, event: Event) -> bool:
    """Tell whether the configuration lets a pass keep all Gaussians, whatever their scores are."""
    population = state.config.population
    if event.kind == "pass_1":
        return population.pass1_keep == 1
    few = len(state.capture.train) < population.pass2_views
    return few or min(population.pass2_mass, population.pass2_keep) == 1


def _nothing_kept(state: TrainingState, event: Event, before: int) -> str:
    population = state.config.population
    if event.kind == "pass_1":
        remedy = f"raise population.pass1_keep ({population.pass1_keep:g})"
    else:
        remedy = (
            f"raise population.pass2_mass ({population.pass2_mass:g}) or population.pass2_keep "
            f"({population.pass2_keep:g}), or lower population.min_opacity ({population.min_opacity:g})"
        )
    return f"the importance pass after {event.time:,} images kept none of {before:,} Gaussians: {remedy}"


def view_batches(state: TrainingState) -> Iterator[ViewBatch]:
    """Yield the training views by image size; a view's column is its place among the training views."""
    by_size: dict[tuple[int, int], list[int]] = {}
    for column, index in enumerate(state.capture.train):
        by_size.setdefault(state.views.size([index]), []).append(column)
    # A pool has room for at least the views of one step.
    least = 1 if state.config.memory.resident_gb > 0 else LEAST_VIEWS
    length = max(state.schedule.batch_size, least)
    for columns in by_size.values():
        for begin in range(0, len(columns), length):
            some = columns[begin : begin + length]
            indices = [state.capture.train[column] for column in some]
            yield ViewBatch(some, state.views.pick(indices), indices)


def _reported(batches: Iterator[ViewBatch], report: Report, total: int) -> Iterator[ViewBatch]:
    """Yield the batches; report the views of each when the next one is asked for."""
    done = 0
    for batch in batches:
        yield batch
        done += len(batch.columns)
        report(done, total)


def causes_of_death(state: TrainingState, event: Event, found: Importance) -> Tensor:
    """Return why a pass prunes each row, uint8 [N] of `Cause`; 0: it is kept. Every rank calls this."""
    population, table, ids = state.config.population, state.table, state.table["id"]
    causes = torch.zeros_like(ids, dtype=torch.uint8)
    if _keeps_all(state, event):
        return causes
    if event.kind == "pass_1":
        kept = sample_by_score(
            found.score, ids, population.pass1_keep, seed=state.config.seed, event=event.time,
            ranks=state.ranks,
        )  # fmt: skip
        causes[~kept] = Cause.PASS_1
        return causes
    # If no Gaussian contributes to any view, the total is zero and no share of it can be kept.
    if state.ranks.all_reduce(found.score.double().sum()).item() > 0:
        causes[table["opacities"] < opacity_logit(population.min_opacity)] = Cause.LATE_OPACITY
        kept = top_by_score(found.score, ids, population.pass2_mass, population.pass2_keep, state.ranks)
        causes[~kept] = Cause.PASS_2
    return causes
