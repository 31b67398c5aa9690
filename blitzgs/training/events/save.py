# SPDX-License-Identifier: Apache-2.0
"""The event that writes a checkpoint."""

from __future__ import annotations

from blitzgs.training import run as run_folder
from blitzgs.training.schedule import Event
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event | None = None) -> None:
    """Write a checkpoint; pending optimiser steps stay pending, so that saving changes nothing."""
    run_folder.save(state.folder, state.table, state.progress, state.space, state.config, state.ranks)
