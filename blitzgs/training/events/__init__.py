# SPDX-License-Identifier: Apache-2.0
"""The events that happen between two steps, one file per event with a function `run(state, event)`.

To add an event, name it in `blitzgs.training.schedule.EventKind`, say there when it happens, and list its
function in `HANDLERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from blitzgs.training.events import clear_cull, densify, evaluate, importance, place, reset_opacities, save
from blitzgs.training.schedule import Event, EventKind
from blitzgs.training.state import TrainingState

HANDLERS: Mapping[EventKind, Callable[[TrainingState, Event], object]] = {
    "densify": densify.run,
    "reset_opacities": reset_opacities.run,
    "pass_1": importance.run,
    "pass_2": importance.run,
    "clear_cull": clear_cull.run,
    "place": place.run,
    "evaluate": evaluate.run,
    "checkpoint": save.run,
}


def handle_all(state: TrainingState, events: Sequence[Event]) -> None:
    """Run the schedule's events of one step; every rank calls this with the same events.

    A step covers several images. Events that change the model run first, even if an evaluation or a
    checkpoint of the
    same step is due some images earlier: a run that is resumed from that checkpoint begins with the next
        step, and
    would never run them.
    """
    for event in sorted(events, key=lambda event: event.kind in ("evaluate", "checkpoint")):
        HANDLERS[event.kind](state, event)
