# SPDX-License-Identifier: Apache-2.0
"""The event at which a run with `schedule.adaptive` reads its signals and may place its next time."""

from __future__ import annotations

from dataclasses import replace

from blitzgs.config.schedule import PLACED, Event, Schedule
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Place the times for which the signals give a reason; every rank decides the same."""
    signals = state.signals
    if signals is None:
        return
    pace, config = state.schedule.pace, state.config.schedule
    # A compressed schedule may have passed the latest places of several times.
    while (found := signals.next_place(config, pace, state.images_seen)) is not None:
        place, reason = found
        name = PLACED[len(config.placed)]
        signals.reasons.append(reason)
        config = replace(config, placed=(*config.placed, place))
        text = f"{name} is placed at {place:,}: {reason}" if place else None
        state.log.event(event.time, "place", {"name": name, "time": place, "reason": reason}, text)
    if config != state.config.schedule:
        # The learning rates do not depend on these times, so the optimiser need not be updated.
        state.config = replace(state.config, schedule=config)
        state.schedule = Schedule(config)
