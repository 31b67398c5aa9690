# SPDX-License-Identifier: Apache-2.0
"""The event at which a run with `schedule.adaptive` looks at itself and may place the next of its times."""

from __future__ import annotations

import math
from dataclasses import replace

from blitzgs.training.adaptive import WINDOW
from blitzgs.training.schedule import PLACED, Event, Schedule
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Measure, and place what the signals say; every rank decides alike, from sums over all."""
    signals = state.signals
    if signals is None:
        return
    pace, config = state.schedule.pace, state.config.schedule
    time = pace.time(state.images_seen)
    signals.look(time, max(len(state.capture.train), math.ceil(WINDOW * config.iterations * pace.scale)))
    # A compressed schedule may have passed the latest places of several.
    while (found := signals.next_place(config, time)) is not None:
        place, reason = found
        name = PLACED[len(config.placed)]
        signals.reasons.append(reason)
        config = replace(config, placed=(*config.placed, place))
        text = f"{name} is placed at {place:,}: {reason}" if place else None
        state.log.event(event.time, "place", {"name": name, "time": place, "reason": reason}, text)
    if config != state.config.schedule:
        # The rates do not depend on these times, so the optimiser need not follow.
        state.config = replace(state.config, schedule=config)
        state.schedule = Schedule(config)
