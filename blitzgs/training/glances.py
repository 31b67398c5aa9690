# SPDX-License-Identifier: Apache-2.0
"""Measures a few held-out views now and then while a run trains, for its progress display.

The measurements take at most a small share of the time of training. They change no bit of the result, so the
number of views may depend on the clock.
"""

from __future__ import annotations

import math

from blitzgs.capture.images import PhotographError
from blitzgs.runs.evaluation import EvaluationStoppedError, spread
from blitzgs.training.events.evaluate import measure
from blitzgs.training.state import TrainingState

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
        self._order = spread(state.capture.test)
        if state.config.schedule.evaluate_every > 0:
            self._order = []

    def after(self, begin: int, end: int) -> None:
        """Measure after the step at the images [begin, end) if it ends a part of the run. Collective."""
        state, total = self._state, self._state.schedule.iterations
        if not self._order or end >= total or POINTS * begin // total == POINTS * end // total:
            return
        # Rank 0 decides, because the clocks of the ranks differ.
        count = state.ranks.broadcast_object(self._affordable() if state.ranks.rank == 0 else 0)
        if count > 0:
            with state.stage("glances"):
                self._measure(count)

    def _measure(self, count: int) -> None:
        """Measure the first views, as many as `count`."""
        state = self._state
        started, views = state.clock(), sorted(self._order[:count])
        try:
            metrics = measure(state, views, None, lpips=None)
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
