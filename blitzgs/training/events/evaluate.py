# SPDX-License-Identifier: Apache-2.0
"""Measures held-out views: all of them as an event, and a few now and then for the progress display."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from blitzgs.capture.images import PhotographError
from blitzgs.config.schedule import Event
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import run_files
from blitzgs.runs.evaluation import EvaluationStoppedError, Lpips, evaluate, evenly_ordered, worst_views
from blitzgs.training.state import TrainingState
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file

# The number of side-by-side pictures that an evaluation writes.
PICTURES = 8
# The end of a run measures as many training views as take this share of its time, at least and at most:
TRAINED_SHARE, LEAST_TRAINED, MOST_TRAINED = 0.02, 8, 64


def evaluate_held_out(state: TrainingState, event: Event | None = None) -> dict[str, Any]:
    """Measure the held-out views, or the training views if none are held out; the training clock pauses.

    Returns the mean of each metric, and under "split" which views were measured; nothing if the run has to
    stop meanwhile.
    """
    with state.paused_clock():
        folder = state.folder / run_files.EVALUATION / f"{state.images_seen:06d}"
        capture = state.capture
        begin = state.clock()
        try:
            metrics = measure(state, capture.test or capture.train, folder)
            if event is None and capture.test:
                cost = max(1e-9, (state.clock() - begin) / len(capture.test))
                affordable = max(LEAST_TRAINED, TRAINED_SHARE * state.progress.seconds / cost)
                count = state.ranks.broadcast_object(int(min(MOST_TRAINED, affordable)))
                _write_trained(state, evenly_ordered(capture.train)[:count], folder)
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
        warn(f"the metrics of training views are not written: {error}")


def measure(
    state: TrainingState, indices: Sequence[int], folder: Path | None, lpips: Lpips | None = None
) -> dict[str, Any]:
    """Compare the model with photographs; see `evaluate`. Without a folder nothing is written."""
    state.catch_up()
    with state.log.work("views measured") as report:
        return evaluate(
            state.subject(),
            state.views,
            state.capture.cameras,
            state.images,
            indices,
            folder,
            TileOwners(state.ranks),
            pictures=PICTURES,
            lpips=lpips,
            report=report,
            optional_files=True,
            stops=state.stops,
        )


# The views are measured at most this often in a run, evenly.
POINTS = 20
# Largest share of the training time, and number of views at one point.
MAX_SHARE = 0.008
LEAST_VIEWS, MAX_VIEWS = 2, 16
# Assumed before the first measurement: the time of a view is that of this number of training images.
FIRST_COST = 1.0


class Glances:
    """Measures held-out views at `POINTS` points of a run, unless `schedule.evaluate_every` measures all."""

    def __init__(self, state: TrainingState) -> None:
        """Begin; time is counted from here, also in a run that is resumed."""
        self._state = state
        self._begin = state.progress.seconds
        self._spent, self._cost = 0.0, 0.0  # seconds in all, and the largest so far for a view
        self._order = evenly_ordered(state.capture.test)
        if state.config.schedule.evaluate_every > 0:
            self._order = []

    def after(self, begin: int, end: int) -> None:
        """Measure after the step at the images [begin, end) if it ends a part of the run. Collective."""
        state, total = self._state, self._state.schedule.iterations
        if not self._order or end >= total or POINTS * begin // total == POINTS * end // total:
            return
        # Pending steps are applied at every point, as this rounds: the clock must not decide on bits.
        state.catch_up()
        # Rank 0 decides, because the clocks of the ranks differ.
        count = state.ranks.broadcast_object(self._affordable() if state.ranks.rank == 0 else 0)
        if count > 0:
            with state.stage("glances"):
                self._measure(count)

    def _measure(self, count: int) -> None:
        state = self._state
        started, views = state.clock(), sorted(self._order[:count])
        try:
            metrics = measure(state, views, None)
        except EvaluationStoppedError:
            return
        except PhotographError as error:  # on every rank
            self._order = []
            text = f"{error}: the run goes on, but this held-out view cannot be measured at the end"
            state.log.event(state.images_seen, "glance failed", {"reason": str(error)}, text)
            return
        seconds = state.clock() - started
        self._spent += seconds
        self._cost = max(self._cost, seconds / count)
        if "psnr" in metrics:
            values = {"psnr": metrics["psnr"], "views": count, "seconds": seconds}
            text = f"held-out views: {metrics['psnr']:.2f} dB ({count} of {len(self._order)})"
            state.log.event(state.images_seen, "glance", values, text)

    def _affordable(self) -> int:
        """Return how many views may be measured now; 0 if too few."""
        progress = self._state.progress
        cost = self._cost or FIRST_COST * progress.seconds / max(1, self._state.images_seen)
        left = MAX_SHARE * (progress.seconds - self._begin) - self._spent
        count = min(MAX_VIEWS, len(self._order), math.floor(left / max(cost, 1e-9)))
        return count if count >= min(LEAST_VIEWS, len(self._order)) else 0
