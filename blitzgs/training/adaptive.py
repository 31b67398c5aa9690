# SPDX-License-Identifier: Apache-2.0
"""`schedule.adaptive`: measures a run and places T1, the end of densification and T2 by what it measures.

Two signals decide. Each is the same on every rank, because it is computed from sums over all ranks:

- the demand of density control: the share of the Gaussians that an event would clone or split, those included
  that a limit of the population or the spawn gate held back. The rules below compare the mean over the last
  events with the highest such mean so far;
- the loss, mean |render - photograph| over whole epochs, so that every view has the same weight. How fast it
  falls, relative to the length of the schedule, tells how much further training would still improve the
  model.

T1 is placed when demand has fallen to `FALLEN`. Densification ends when demand has fallen to `GONE` or the
loss has settled. T2 is placed when the loss has settled after that. Each time differs from the fixed
schedule's by at most `schedule.adaptive_limit` of it, and the three times keep this order.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.pace import Pace
from blitzgs.config.schedule import PLACED, latest_times
from blitzgs.distributed.host_sum import HostSum

# Number of events over which demand is averaged.
EVENTS = 3
# Demand relative to its highest value: at T1, and at the end of densification. No other values were measured
# (docs/decisions/population.md).
FALLEN, GONE = 0.5, 0.1
# The loss is compared between neighbouring spans of whole epochs, each at least this share of the schedule.
SPAN = 1 / 60
# The fall of the logarithm of the loss, per length of the schedule, below which it counts as settled. No
# other value was measured.
SETTLED = 0.5


@dataclass
class Signals:
    """The measurements of a run so far; saved with every checkpoint.

    Attributes:
        loss: sum of the views' mean losses in the present epoch, and the number of these views.
        epochs: for each finished epoch (images seen at its end, mean loss), oldest first.
        demand: for each density event, the share of the Gaussians that it would clone or split.
        reasons: for each placed time, why it was placed there.
    """

    loss: tuple[float, int] = (0.0, 0)
    epochs: list[list[float]] = field(default_factory=list)
    demand: list[float] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    _pending: tuple[HostSum, list[int]] | None = None

    @classmethod
    def of(cls, saved: dict[str, Any]) -> Signals:
        """Restore the signals from what `saved` returned; an empty dictionary gives new ones."""
        return cls(**saved | ({"loss": tuple(saved["loss"])} if saved else {}))

    def saved(self) -> dict[str, Any]:
        """Return all measurements, the last step's included, as JSON values."""
        self._read()
        names = [entry.name for entry in dataclasses.fields(self) if entry.name != "_pending"]
        return {name: list(x) if isinstance(x := getattr(self, name), (list, tuple)) else x for name in names}

    def add(self, sums: HostSum, views: int, pixels: int, images: int, epoch: int) -> None:
        """Store a step's loss; it is read together with the next step's, when that needs no wait.

        Args:
            sums: loss sums of the step.
            views: views of the step, B.
            pixels: pixels of each view.
            images: images that the run has seen at the end of the step.
            epoch: number of training views.
        """
        self._read()
        self._pending = sums, [views, pixels, images, epoch]

    def _read(self) -> None:
        if self._pending is None:
            return
        (sums, (views, pixels, images, epoch)), self._pending = self._pending, None
        total, count = self.loss
        total, count = total + math.fsum(sums.read()[:views].tolist()) / (3 * pixels), count + views
        if count >= epoch:
            self.epochs.append([images, total / count])
            total, count = 0.0, 0
        self.loss = total, count

    def densified(self, counts: Mapping[str, int]) -> None:
        """Store a density event: its `DensityReport` of all ranks, and "gaussians", the number after it."""
        grown = counts["cloned"] + counts["split"] - counts["relocated"]
        before = counts["gaussians"] + counts["pruned"] - grown
        self.demand.append((grown + counts["held_back"] + counts["vetoed"]) / max(1, before))

    def next_place(self, config: ScheduleConfig, pace: Pace, images: int) -> tuple[int, str] | None:
        """Return the place of the next of the three times and the reason; None: not yet, or all are placed.

        Args:
            config: the schedule with the times placed so far.
            pace: maps times of the configuration to images of the run.
            images: images that the run has seen.
        """
        self._read()
        time = pace.time(images)
        index = len(config.placed)
        if index == len(PLACED):
            return None
        fixed = (config.t1, config.densify_until, config.t2)[index]
        if fixed == 0:
            return 0, "there is none"
        latest = latest_times(config)[index]
        if time >= latest:
            return latest, "the latest that schedule.adaptive_limit allows"
        if time < self._earliest(config, index, fixed):
            return None
        reason = self._low_demand(FALLEN if index == 0 else GONE) if index < 2 else None
        if reason is None and index > 0:
            reason = self._settled_loss(config, pace, config.placed[index - 1])
        return None if reason is None else (math.ceil(time), reason)

    def _earliest(self, config: ScheduleConfig, index: int, fixed: int) -> float:
        least = 1 - config.adaptive_limit
        if index < 2:
            return least * fixed
        # T2 keeps some of its distance from the end of densification.
        return config.placed[1] + least * (config.t2 - config.densify_until)

    def _low_demand(self, share: float) -> str | None:
        if len(self.demand) <= EVENTS:
            return None
        means = [sum(self.demand[k : k + EVENTS]) / EVENTS for k in range(len(self.demand) - EVENTS + 1)]
        if means[-1] > share * max(means):
            return None
        return f"density control asks for {means[-1]:.2%} of the Gaussians, {max(means):.2%} at most before"

    def _settled_loss(self, config: ScheduleConfig, pace: Pace, since: float) -> str | None:
        ends = [pace.time(images) for images, _ in self.epochs]
        lengths = [end - begin for begin, end in pairwise([0.0, *ends])]
        span = max(1, math.ceil(SPAN * config.iterations / lengths[-1])) if lengths else 1
        after = [k for k, end in enumerate(ends) if end - lengths[k] >= since]
        if len(after) < 2 * span:
            return None
        first, last = (
            sum(loss for _, loss in epochs) / span
            for epochs in (self.epochs[-2 * span : -span], self.epochs[-span:])
        )
        fall = math.log(max(first, 1e-12) / max(last, 1e-12)) * config.iterations / sum(lengths[-span:])
        begin = ends[-2 * span] - lengths[-2 * span]
        if fall > SETTLED or _last_reset(config, ends[-1]) >= begin:
            return None
        return f"the loss went from {first:.5f} to {last:.5f} until {ends[-1]:,.0f}, over {span} epochs each"


def _last_reset(config: ScheduleConfig, time: float) -> float:
    """Return when opacities were last reset until `time`, which raises the loss; -1: they were not."""
    if config.reset_every == 0:
        return -1
    until = config.placed[1] if len(config.placed) > 1 else config.densify_until
    last = min(time, until - 1) // config.reset_every * config.reset_every
    return last if last > 0 else -1
