# SPDX-License-Identifier: Apache-2.0
"""The event that drops the cull mask, so that every Gaussian is trained in all its views again."""

from __future__ import annotations

from blitzgs.config.schedule import Event
from blitzgs.table.layouts import CULL
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Delete the cull mask and free its memory."""
    if CULL not in state.table:
        return
    state.stepper.write_back()
    del state.table[CULL]
    state.stepper.reindex()
    state.log.event(event.time, "clear_cull", {}, "the cull mask is cleared")
