# SPDX-License-Identifier: Apache-2.0
"""The event at which a run with `schedule.adaptive` looks at itself and may place the next of its times."""

from __future__ import annotations

import math
from dataclasses import replace

from blitzgs.training.adaptive import WINDOW
from blitzgs.training.schedule import PLACED, Event, Schedule
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Measure, and place a time where the signals say so; every rank decides alike, from sums over all."""
    signals, progress, config = state.signals, state.progress, state.config.schedule
    # Small steps of a compressed schedule may hold several looks.
    if signals is None or signals.step == progress.step:
        return
    pace = state.schedule.pace
    time = pace.time(state.images_seen)
    window = max(len(state.capture.train), math.ceil(WINDOW * config.iterations * pace.scale))
    signals.look(progress.step, time, state.population(), progress.milestones, window)
    found = signals.next_place(config, time)
    if found is None:
        return
    place, reason = found
    name = PLACED[len(config.placed)]
    signals.reasons.append(reason)
    state.config = replace(state.config, schedule=replace(config, placed=(*config.placed, place)))
    # The rates do not depend on these times, so the optimiser need not follow.
    state.schedule = Schedule(state.config.schedule)
    text = f"{name} is placed at {place:,}: {reason}" if place else None
    state.log.event(event.time, "place", {"name": name, "time": place, "reason": reason}, text)
