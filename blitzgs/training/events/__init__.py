# SPDX-License-Identifier: Apache-2.0
"""What happens between two steps, one file per event: `run(state, event)`.

To add an event, name it in `blitzgs.training.schedule.EventKind`, say there when it happens, and list its
function in `HANDLERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from blitzgs.training.events import clear_cull, densify, evaluate, importance, reset_opacities, save
from blitzgs.training.schedule import Event, EventKind
from blitzgs.training.state import TrainingState

HANDLERS: Mapping[EventKind, Callable[[TrainingState, Event], object]] = {
    "densify": densify.run,
    "reset_opacities": reset_opacities.run,
    "pass_1": importance.run,
    "pass_2": importance.run,
    "clear_cull": clear_cull.run,
    "evaluate": evaluate.run,
    "checkpoint": save.run,
}


def handle(state: TrainingState, event: Event) -> None:
    """Run one event of the schedule; every rank calls this with the same event."""
    HANDLERS[event.kind](state, event)
