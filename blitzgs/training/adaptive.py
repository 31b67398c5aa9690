# SPDX-License-Identifier: Apache-2.0
"""What a run with `schedule.adaptive` measures, and where it places T1, the end of densification and T2.

Two signals are looked at, each the same on every rank because it is made of sums over all ranks:

- the demand of density control: the share of the Gaussians that an event would clone or split, those included
  that a limit of the population or the spawn gate held back. It is the mean over the last events that counts,
  relative to the highest such mean; early in a run it is high;
- the loss, mean |render - photograph| over whole epochs, in which all views count alike. Its relative fall
  per share of the schedule says what more of the same would still bring.

T1 comes when demand has fallen, densification ends when demand has all but gone or the loss no longer falls,
and T2 comes when the loss has settled after that. Each of them lies within `schedule.adaptive_limit` of where
the fixed schedule has it, and all three in this order.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from blitzgs.distributed.host_sum import HostSum
from blitzgs.training.config import ScheduleConfig
from blitzgs.training.pace import Pace
from blitzgs.training.schedule import PLACED, latest_times

# Demand is the mean over so many events.
EVENTS = 3
# Demand relative to its highest: fallen, and all but gone.
FALLEN, GONE = 0.5, 0.1
# The loss is compared between neighbouring spans of whole epochs, each at least this share of the schedule.
SPAN = 1 / 60
# The fall of the logarithm of the loss, per length of the schedule, below which it counts as settled.
SETTLED = 0.5


@dataclass
class Signals:
    """What has been measured so far; saved with every checkpoint.

    Attributes:
        loss: sum of the views' mean losses in this epoch, and how many views these are.
        epochs: pairs (images of the run at the end, mean loss), oldest first.
        demand: share of the Gaussians that each density event wanted to clone or split.
        reasons: for each of the times that are placed.
    """

    loss: tuple[float, int] = (0.0, 0)
    epochs: list[list[float]] = field(default_factory=list)
    demand: list[float] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    _pending: tuple[HostSum, list[int]] | None = None

    @classmethod
    def of(cls, saved: dict[str, Any]) -> Signals:
        """Go on from what `saved` returned; anew from an empty dictionary."""
        return cls(**saved | ({"loss": tuple(saved["loss"])} if saved else {}))

    def saved(self) -> dict[str, Any]:
        """Return everything that is known, of the last step too, as JSON holds it."""
        self._read()
        names = [entry.name for entry in dataclasses.fields(self) if entry.name != "_pending"]
        return {name: list(x) if isinstance(x := getattr(self, name), (list, tuple)) else x for name in names}

    def add(self, sums: HostSum, views: int, pixels: int, images: int, epoch: int) -> None:
        """Note a step's loss, to be read with the next step's, when nothing has to be waited for.

        Args:
            sums: of the step.
            views: B.
            pixels: of each view.
            images: of the run, at the end of the step.
            epoch: training views.
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
        """Note a density event: its `DensityReport` over all ranks, and the "gaussians" after it."""
        grown = counts["cloned"] + counts["split"] - counts["relocated"]
        before = counts["gaussians"] + counts["pruned"] - grown
        self.demand.append((grown + counts["held_back"] + counts["vetoed"]) / max(1, before))

    def next_place(self, config: ScheduleConfig, pace: Pace, images: int) -> tuple[int, str] | None:
        """Return where the next of the three times lies, and why; None: not yet, or all are placed.

        Args:
            config: with the times that are placed.
            pace: between times of the configuration and images of the run.
            images: of the run, now.
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
        if fall > SETTLED:
            return None
        return f"the loss went from {first:.5f} to {last:.5f} until {ends[-1]:,.0f}, over {span} epochs each"
