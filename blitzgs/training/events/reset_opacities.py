# SPDX-License-Identifier: Apache-2.0
"""The event that caps all opacities at a low value; Gaussians that the images need become opaque again."""

from __future__ import annotations

from blitzgs.config.fields import RESET_OPACITY
from blitzgs.config.schedule import Event
from blitzgs.population.density import cap_opacities
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event) -> None:
    """Cap all opacities at `RESET_OPACITY` and clear their moments (Kerbl et al. 2023, section 5).

    The pending optimiser steps are applied first, because they would otherwise move the opacities with
    moments that no longer exist.
    """
    state.catch_up()
    cap_opacities(state.table, RESET_OPACITY)
    state.curve.restart()
    state.log.event(event.time, "reset_opacities", {"opacity": RESET_OPACITY})
