# SPDX-License-Identifier: Apache-2.0
"""The event that measures the held-out views."""

from __future__ import annotations

from typing import Any

from blitzgs.distributed.ownership import TileOwners
from blitzgs.training import run as run_folder
from blitzgs.training.evaluation import evaluate
from blitzgs.training.schedule import Event
from blitzgs.training.state import TrainingState


def run(state: TrainingState, event: Event | None = None) -> dict[str, Any]:
    """Evaluate the held-out views (the training views when there are none), while the clock stands still.

    Returns:
        The mean of each metric.
    """
    with state.paused_clock():
        state.catch_up()
        metrics = evaluate(
            state.table,
            state.views,
            state.capture.cameras,
            state.images,
            state.capture.test or state.capture.train,
            state.render_options,
            state.folder / run_folder.EVALUATION / f"{state.images_seen:06d}",
            TileOwners(state.ranks),
            pictures=state.config.log.pictures,
            lpips=state.lpips,
        )
        means = {name: value for name, value in metrics.items() if name != "views"}
        text = "evaluation: " + "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        state.log.event(state.images_seen, "evaluation", means, text)
    return means
