# SPDX-License-Identifier: Apache-2.0
"""The view level in a run: opens the LOD gate, chooses its views, and makes each batch's gate."""

from __future__ import annotations

import dataclasses
import math

from blitzgs.capture.capture import Capture
from blitzgs.config.schedule import Event
from blitzgs.distributed.group import Ranks
from blitzgs.runs.trained_model import Progress
from blitzgs.table.table import CULL, GaussianTable
from blitzgs.training.state import TrainingState
from blitzgs.util.errors import warn
from blitzgs.view.gate import ViewGate, lod_bits
from blitzgs.view.levels import FOOTPRINT_LEVELS, footprint_levels, footprint_sizes, level_fork


def follow_schedule(state: TrainingState, begin: int) -> None:
    """Open the LOD gate, if the step at [begin, begin + B) is the first that has it. Collective.

    With `view.footprint`, levels follow opacities and scales (`Schedule.has_new_levels`).
    """
    view = state.config.view
    # A Gaussian that is left out gathers no gradients for density control.
    if not view.lod or state.schedule.gathers_statistics(begin):
        return
    opens = state.progress.finest_level is None
    if view.footprint > 0 and (opens or state.schedule.has_new_levels(begin)):
        follow_footprints(state)
    if opens or not state.progress.gated_views:
        state.progress.finest_level = state.progress.level_count - 1
        choose_views(state)


def follow_footprints(state: TrainingState) -> None:
    """Give each Gaussian the level that follows from its footprint. Collective."""
    state.catch_up()
    config, table = state.config, state.table
    # In no training view is a Gaussian larger than at the largest focal length.
    focal = max(float(state.capture.cameras[index].K[0, 0]) for index in state.capture.train)
    sizes = footprint_sizes(table["scales"], table["opacities"])
    distance, fork = state.progress.reference_distance, level_fork(config)
    table["level"] = footprint_levels(sizes, focal / config.view.footprint, distance, fork)
    state.progress.level_count = FOOTPRINT_LEVELS
    state.stepper.reindex()


def choose_views(state: TrainingState) -> None:
    """If the LOD gate is open, choose the training views in which it leaves out enough to pay. Collective.

    The choice holds until an importance pass prunes Gaussians. It is saved with the checkpoints: a resumed
    run has other Gaussians than at the time of the choice, and might choose other views.
    """
    if state.progress.finest_level is None:
        return
    state.catch_up()  # the prediction reads the means
    # Without the earlier choice, by which the gate may be closed.
    unchosen = dataclasses.replace(state.progress, gated_views="", least_kept=0.0)
    gate = unchosen.model_gate(state.config, state.table, state.ranks)
    assert gate is not None  # the gate is open
    kept = gate.kept(state.views.centres(state.capture.train))
    gated = [gate.applies(share) for share in kept]
    state.progress.gated_views = "".join("1" if has_gate else "0" for has_gate in gated)
    state.progress.least_kept = min(kept, default=0.0)
    mean = sum(share if has_gate else 1.0 for share, has_gate in zip(kept, gated, strict=True)) / len(kept)
    values = {"finest_level": state.progress.finest_level, "gated_views": sum(gated), "kept": mean}
    text = (
        f"the LOD gate keeps levels up to {state.progress.finest_level} (the finest is "
        f"{state.progress.level_count - 1}), and is applied in {sum(gated)} of {len(gated)} training views; "
        f"a training view keeps {mean:.0%} of the Gaussians on average"
    )
    state.log.event(state.images_seen, "lod_gate", values, text)


def forget_views(table: GaussianTable, progress: Progress, capture: Capture, ranks: Ranks) -> None:
    """Drop what table and progress have by the index of a training view.

    The gated views are chosen again before the next step.
    """
    progress.gated_views = ""
    if CULL in table:
        del table[CULL]
        if ranks.rank == 0:
            warn(
                f"the checkpoint was trained on other views than the {len(capture.train)} of today: the cull "
                "mask is dropped, and comes back with the next importance pass, if there is one"
            )


def batch_gate(state: TrainingState, indices: list[int]) -> ViewGate | None:
    """Return LOD gate and cull mask of training views (indices into the capture); None: there is neither."""
    columns = [state.columns[index] for index in indices]
    lod, flags = state.progress.lod_gate(state.config), state.progress.gated_views
    lod_views = 0 if lod is None else lod_bits([flags[column] == "1" for column in columns])
    masked = state.config.view.cull and CULL in state.table
    if not (lod_views or masked):
        return None
    return ViewGate(lod.reach() if lod is not None else [math.inf], lod_views, columns if masked else ())


def clear_cull(state: TrainingState, event: Event) -> None:
    """Delete the cull mask and free its memory."""
    if CULL not in state.table:
        return
    state.stepper.write_back()
    del state.table[CULL]
    state.stepper.reindex()
    state.log.event(event.time, "clear_cull", {}, "the cull mask is cleared")
