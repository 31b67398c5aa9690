# SPDX-License-Identifier: Apache-2.0
"""The event that ends the use of the cull mask: what it left out is trained in all its views again."""

from __future__ import annotations

from blitzgs.model import CULL
from blitzgs.training.schedule import Event
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Drop the mask, and the memory it takes, from a run that used it."""
    if CULL not in state.table:
        return
    state.stepper.settle()
    del state.table[CULL]
    state.stepper.reindex()
    state.log.event(event.time, "clear_cull", {}, "the cull mask is cleared")
