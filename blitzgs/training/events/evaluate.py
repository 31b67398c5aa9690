# SPDX-License-Identifier: Apache-2.0
"""The event that measures the held-out views."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from blitzgs.capture.images import PhotographError
from blitzgs.config.schedule import Event
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import files as run_files
from blitzgs.runs.evaluation import EvaluationStoppedError, Lpips, evaluate, spread, worst_views
from blitzgs.runs.lod import scene_gate
from blitzgs.training.state import TrainingState
from blitzgs.util.output import write_file

# The end of a run measures as many training views as take this share of its time, at least and at most:
TRAINED_SHARE, LEAST_TRAINED, MOST_TRAINED = 0.02, 8, 64


def run(state: TrainingState, event: Event | None = None) -> dict[str, Any]:
    """Measure the held-out views, or the training views if none are held out; the training clock pauses.

    Returns:
        The mean of each metric, and under "split" which views were measured; an empty dictionary if the run
        has to stop meanwhile.
    """
    with state.paused_clock():
        folder = state.folder / run_files.EVALUATION / f"{state.images_seen:06d}"
        capture = state.capture
        begin = state.clock()
        try:
            metrics = measure(state, capture.test or capture.train, folder, state.lpips)
            if event is None and capture.test:
                cost = max(1e-9, (state.clock() - begin) / len(capture.test))
                count = int(
                    min(MOST_TRAINED, max(LEAST_TRAINED, TRAINED_SHARE * state.progress.seconds / cost))
                )
                _write_trained(state, spread(capture.train)[: state.ranks.broadcast_object(count)], folder)
        except EvaluationStoppedError:
            text = "evaluation given up: the run has to stop"
            state.log.event(state.images_seen, "evaluation stopped", {}, text)
            return {}
        means = {name: value for name, value in metrics.items() if name != "views"}
        what = "evaluation" if capture.test else "evaluation of TRAINING views (none is held out)"
        figures = "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        text = f"{what}: {figures or 'all pixels are masked'}"
        means["split"] = "test" if capture.test else "train"
        worst = worst_views(metrics["views"])
        state.log.event(state.images_seen, "evaluation", means | {"worst": dict(worst)}, text)
        if event is None and worst:  # at the end
            names = ", ".join(f"{name} {psnr:.2f} dB" for name, psnr in worst)
            state.log.event(state.images_seen, "worst views", {"worst": dict(worst)}, f"worst views: {names}")
    return means


def _write_trained(state: TrainingState, indices: Sequence[int], folder: Path) -> None:
    """Measure some training views, which the report's plan of the cameras shows beside the held-out ones."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* as they are masked")  # the run has warned of its masks
            metrics = measure(state, sorted(indices), None)
        if state.ranks.rank == 0:
            write_file(folder / run_files.TRAINED_VIEWS, json.dumps(metrics, indent=1) + "\n")
    except (OSError, PhotographError) as error:
        warnings.warn(f"the metrics of training views are not written: {error}", stacklevel=3)


def measure(
    state: TrainingState, indices: Sequence[int], folder: Path | None, lpips: Lpips | None = None
) -> dict[str, Any]:
    """Compare the model with the photographs of some cameras; see `blitzgs.runs.evaluation.evaluate`.

    Args:
        state: state of the run; every rank calls this.
        indices: cameras of the capture.
        folder: folder for the metrics and the pictures; None: nothing is written.
        lpips: the perceptual metric, or None.
    """
    state.catch_up()
    with state.log.work("views measured") as report:
        return evaluate(
            state.stepper.scene,
            state.views,
            state.capture.cameras,
            state.images,
            indices,
            state.render_options,
            folder,
            TileOwners(state.ranks),
            pictures=state.config.log.pictures,
            lpips=lpips,
            report=report,
            optional_files=True,
            lod=scene_gate(state.config, state.progress, state.table, state.ranks),
            stops=state.stops,
        )
