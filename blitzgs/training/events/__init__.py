# SPDX-License-Identifier: Apache-2.0
"""The events that happen between two steps, as functions of the state and the event.

To add an event, name it in `blitzgs.config.schedule.EventKind`, say there when it happens, and list its
function in `HANDLERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple

from blitzgs.config.schedule import Event, EventKind
from blitzgs.population.importance import SweepStoppedError
from blitzgs.table.pool import PoolError
from blitzgs.training.events import densify, evaluate, importance, save
from blitzgs.training.state import TrainingState
from blitzgs.training.view_level import clear_cull

HANDLERS: Mapping[EventKind, Callable[[TrainingState, Event], object]] = {
    "densify": densify.run_density_event,
    "reset_opacities": densify.reset_opacities,
    "pass_1": importance.run_importance_pass,
    "pass_2": importance.run_importance_pass,
    "clear_cull": clear_cull,
    "evaluate": evaluate.evaluate_held_out,
    "checkpoint": save.save_checkpoint,
}


def handle_all(state: TrainingState, events: Sequence[Event]) -> bool:
    """Run the schedule's events of one step; every rank calls this with the same events.

    A step covers several images. Events that change the model run first, even if an evaluation or a
    checkpoint of the same step is due some images earlier: a run that is resumed from that checkpoint begins
    with the next step, and would never run them.

    Returns whether all events have run. If not, because a signal stops the run (or the Gaussians do not fit
    into the pool: PoolError), `progress.events_left` holds the others, and a resumed run begins with them.
    """
    state.progress.events_left = []
    ordered = sorted(events, key=lambda event: event.kind in ("evaluate", "checkpoint"))
    for done, event in enumerate(ordered):
        try:
            with state.stage(event.kind):
                HANDLERS[event.kind](state, event)
        except (SweepStoppedError, PoolError) as error:
            state.progress.events_left = [astuple(other) for other in ordered[done:]]
            if isinstance(error, PoolError):
                raise
            return False
    return True
