# SPDX-License-Identifier: Apache-2.0
"""The schedule of a run: the events of each step, the learning rates of all steps, and changes of pace."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, takewhile
from operator import attrgetter
from typing import Literal

import torch
from torch import Tensor

from blitzgs.config.fields import MAX_STRETCH, POSITION_LEFT, SH_SHARE, OptimiserConfig, ScheduleConfig


class Pace:
    """An increasing, piecewise linear map from times of the configuration to images of the run, and back.

    A later change of pace does not change any bit of the map before it.
    """

    def __init__(self, scale: float, changes: Sequence[tuple[int, float]]) -> None:
        """Make a map of `scale` images per image of the configuration, times a factor from an image on.

        `changes`: (image of the run, factor) with increasing images above 0.
        """
        self._images = [0.0, *(float(image) for image, _ in changes)]
        self._scales = [scale, *(scale * factor for _, factor in changes)]
        self._times = [0.0]
        for begin, end, rate in zip(self._images, self._images[1:], self._scales, strict=False):
            self._times.append(self._times[-1] + (end - begin) / rate)

    @property
    def scale(self) -> float:
        """Images of the run per image of the configuration, after the last change."""
        return self._scales[-1]

    def image(self, time: float) -> float:
        """Return the image of the run at a time >= 0 of the configuration."""
        piece = bisect_right(self._times, time) - 1
        return self._images[piece] + (time - self._times[piece]) * self._scales[piece]

    def time(self, image: float) -> float:
        """Return the time of the configuration at an image >= 0 of the run."""
        piece = bisect_right(self._images, image) - 1
        return self._times[piece] + (image - self._images[piece]) / self._scales[piece]

    def times(self, images: Tensor) -> Tensor:
        """Return `time` of each element of a float64 tensor [...]."""
        begins, times, scales = torch.tensor([self._images, self._times, self._scales], dtype=torch.float64)
        piece = torch.bucketize(images, begins, right=True) - 1
        return times[piece] + (images - begins[piece]) / scales[piece]


EventKind = Literal["densify", "reset_opacities", "pass_1", "pass_2", "clear_cull", "evaluate", "checkpoint"]
# The columns of the learning-rate table.
RATES = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")


@dataclass(frozen=True, order=True)
class Event:
    """Something that happens at the end of the step that contains `time` (in images)."""

    time: int
    order: int
    kind: EventKind


def stretched(config: ScheduleConfig, views: int) -> ScheduleConfig:
    """Return a schedule for a number of views: `scale` times what gives each view `images_per_view` images.

    The factor is between 1 and `MAX_STRETCH`. The result has `images_per_view` 0, so that a second call
    changes nothing.
    """
    factor = min(max(config.images_per_view * views / config.iterations, 1.0), MAX_STRETCH)
    if config.minutes > 0:
        factor = 1.0  # The minutes decide how long the run is.
    return replace(config, scale=config.scale * factor, images_per_view=0.0)


class Schedule:
    """Tells which events happen at which step. Time t counts images; step number t / B + 1 covers [t, t + B).

    `pace` maps every time of the configuration to an image of the run (without changes of pace: multiplied by
    `scale`), rounded down. The schedule therefore has the same shape at any length.
    """

    def __init__(self, config: ScheduleConfig) -> None:
        self._config = config
        self.pace = Pace(config.scale, config.pace)
        self.batch_size = config.batch_size  # views per step, B
        self.steps = max(1, math.ceil(self._scaled(config.iterations) / self.batch_size))  # of the whole run
        self.iterations = self.steps * self.batch_size  # images of the whole run
        self._reductions = [(factor, self._scaled(until)) for factor, until in config.resolution]

    def _scaled(self, time: float) -> int:
        # The small term keeps 0.1 * 30 from being rounded down to 2.
        return math.floor(self.pace.image(time) + 1e-6)

    def events(self, begin: int, end: int) -> list[Event]:
        """Return the events with begin <= time < end, in the order in which they happen."""
        first, last = (bisect_left(self._events, time, key=attrgetter("time")) for time in (begin, end))
        return self._events[first:last]

    @cached_property
    def _events(self) -> list[Event]:
        """All events of the run, in the order in which they happen."""
        config = self._config
        # The cull mask is dropped halfway between the last importance pass and the end. A pass that is set
        # to a time after the end does not happen.
        last = max(time for time in (0, config.t1, config.t2) if time < config.iterations)
        middle = (last + config.iterations) // 2
        series: list[tuple[EventKind, float, float, float]] = [
            ("densify", config.densify_from, config.densify_until, config.densify_every),
            # A reset happens after the density event of the same image.
            ("reset_opacities", config.reset_every, config.densify_until, config.reset_every),
            ("pass_1", config.t1, config.t1 + 1, min(config.t1, 1)),
            ("pass_2", config.t2, config.t2 + 1, min(config.t2, 1)),
            ("clear_cull", middle, middle + 1, min(last, 1)),
            ("evaluate", config.evaluate_every, math.inf, config.evaluate_every),
            ("checkpoint", config.checkpoint_every, math.inf, config.checkpoint_every),
        ]
        return sorted(
            Event(time, order, kind)
            for order, (kind, first, until, every) in enumerate(series)
            if every > 0
            for time in self._series(first, until, every)
        )

    def _series(self, first: float, until: float, every: float) -> Iterable[int]:
        """Return the images of the run at the times first + k every < until."""
        images = map(self._scaled, takewhile(lambda time: time < until, count(first, every)))
        # A compressed schedule may map two events of one kind to the same image; they become one event.
        return dict.fromkeys(takewhile(lambda image: image < self.iterations, images))

    def sh_degree(self, begin: int, limit: int) -> int:
        """Return the SH degree of the step at [begin, begin + B): one more each `sh_every`, up to `limit`."""
        time = self.pace.time(begin + self.batch_size)
        return min(limit, max(1, math.ceil(time / self._config.sh_every - 1e-9)) - 1)

    def reduction(self, begin: int) -> int:
        """Return by which factor the photographs of the step at [begin, begin + B) are reduced."""
        return next((factor for factor, until in self._reductions if begin < until), 1)

    def gathers_statistics(self, begin: int) -> bool:
        """Tell whether a later density event uses the statistics of the step at [begin, begin + B)."""
        return self.pace.time(begin) < self._config.densify_until

    def is_last_density_event(self, time: int) -> bool:
        """Tell whether no other density event follows that at `time`."""
        return all(event.kind != "densify" for event in self.events(time + 1, self.iterations))

    def has_new_levels(self, begin: int) -> bool:
        """Tell whether levels follow footprints again before the step at [begin, begin + B)."""
        # Scales and opacities change slowly after the growth, and all rows have to catch up.
        every = 10 * self._config.densify_every
        time, before = self.pace.time(begin), self.pace.time(max(0, begin - self.batch_size))
        return time // every > before // every

    def has_spawn_gate(self, time: int) -> bool:
        """Tell whether the spawn gate judges the candidates of a density event at `time`."""
        return time >= self._scaled(self._config.gate_from)

    def prunes_by_size(self, time: int) -> bool:
        """Tell whether a density event at `time` also prunes by screen and world size."""
        return time > self._scaled(self._config.size_prune_after)

    def learning_rates(self, config: OptimiserConfig, extent: float) -> Tensor:
        """Tabulate the learning rates of the whole run.

        The position rate falls exponentially from `position` times `extent` to `POSITION_LEFT` of it over
        `position_decay` images. The opacity rate is constant; that of SH is `SH_SHARE` of `sh_dc`. The other
        rates fall exponentially from `densify_until` to `position_decay`, where `final` of them is left.
        Every rate, those of `config` for B = 1, is multiplied by sqrt(B). Returns float32 [S + 1, 6]: row s
        holds the rates of step s = 1..S for `RATES`; row 0 is zero.
        """
        begin = torch.arange(self.steps, dtype=torch.float64) * self.batch_size
        times = self.pace.times(begin)
        densify_until, end = self._config.densify_until, self._config.position_decay
        progress = (times / end).clamp(max=1.0)
        position = config.position * POSITION_LEFT**progress * extent
        share = config.final ** ((times - densify_until) / max(end - densify_until, 1)).clamp(0.0, 1.0)
        table = torch.zeros(self.steps + 1, len(RATES), dtype=torch.float64)
        falling = (config.rotation, config.scale, 0.0, config.sh_dc, SH_SHARE * config.sh_dc)
        table[1:, 1:] = share[:, None] * torch.tensor(falling, dtype=torch.float64)
        table[1:, 0], table[1:, RATES.index("opacities")] = position, config.opacity
        return (table * math.sqrt(self.batch_size)).float()
