# SPDX-License-Identifier: Apache-2.0
"""Changes the length of a run: fits it into a wall time while it goes on, or extends it when it is finished.

The time of a step is not known before the run begins, and it grows with the population. The run therefore
begins with `scale` 1, measures the time per image, and chooses the pace at which the rest of the schedule
takes the rest of the time. It repeats this after each eighth of the rest, so the error shrinks towards the
end. No trial run is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from blitzgs.config.fields import SCALE, Config, ScheduleConfig
from blitzgs.config.files import ConfigError
from blitzgs.config.ranges import MAX_IMAGES, problems
from blitzgs.config.schedule import Schedule
from blitzgs.training.state import TrainingState

# The first steps of a process are slow (memory, kernels, photographs), so they are not measured. Intervals
# shorter than the following limits are not used either, because one slow step would distort them.
WARM_UP_STEPS = 4
# The pace is reconsidered after this share of the remaining run; at the beginning, after a number of steps
# that doubles each time.
SHARE = 1 / 8
# When less than this share of the schedule remains, the pace no longer changes: the error is a few percent of
# the remainder.
LAST_SHARE = 0.03
# The population grows until the end of densification. The average image after time 0 is assumed to take this
# many times as long as an image at time 0; the factor falls to 1 at the end of densification. The run up to
# there then takes about 40 % of the time, if densification covers half of it.
GROWTH = 2.0
# A plan whose end misses the budget by less than this share is kept, because each change costs some
# milliseconds.
TOLERANCE = 0.005
# One measurement may be distorted by a disk or another process, so it changes the pace by at most this
# factor.
MAX_CHANGE = 16.0
# A plan is shown when the run's length has changed by more than this share of it.
SHOWN_CHANGE = 0.1


@dataclass(frozen=True)
class Plan:
    """What rank 0 decides after a step."""

    next: int  # step after which the pace is reconsidered
    factor: float | None = None  # factor of `schedule.scale` (which is 1) from this step on; None: unchanged
    images_per_second: float = 0.0  # the measured speed
    seconds: float = 0.0  # predicted training time of the whole run


class Budget:
    """Keeps a run within `schedule.minutes`; does nothing if that is 0."""

    def __init__(self, state: TrainingState) -> None:
        """Begin; the next few steps are not measured."""
        self._state = state
        self._seconds = 60 * state.config.schedule.minutes
        self._interval = WARM_UP_STEPS
        self.next_step = state.progress.step + WARM_UP_STEPS  # after which the pace is reconsidered
        self._mark: tuple[int, float] | None = None
        self._shown = 0

    def after(self, step: int) -> None:
        """Change the pace after a step if that is due; every rank calls this after each step's events."""
        state = self._state
        if self._seconds == 0 or step < self.next_step or step >= state.schedule.steps:
            return
        # Rank 0 decides, because the clocks of the ranks differ and all ranks must take the same steps.
        plan = state.ranks.broadcast_object(self._plan(step) if state.ranks.rank == 0 else Plan(step))
        self.next_step = plan.next
        if plan.factor is not None:
            state.change_pace(plan.factor)
            self._report(plan)

    def _plan(self, step: int) -> Plan:
        """Decide on rank 0, from its clock."""
        images, seconds = self._state.images_seen, self._state.progress.seconds
        mark, self._mark = self._mark, (images, seconds)
        if mark is None:
            return Plan(step + self._interval)
        cost = max(seconds - mark[1], 1e-9) / (images - mark[0])
        config, schedule = self._state.config.schedule, self._state.schedule
        time, old = schedule.pace.time(images), schedule.pace.scale
        rest, left = config.iterations - time, self._seconds - seconds
        # Time that the rest of the run would take at a scale of 1.
        at_one = rest * cost * _growth(config, time)
        wanted = old if abs(at_one * old - left) <= TOLERANCE * self._seconds else left / at_one
        most = min(SCALE.high, MAX_IMAGES / config.iterations, old * MAX_CHANGE)
        new = min(max(wanted, SCALE.low, old / MAX_CHANGE), most)
        if new == wanted:
            self._interval *= 2
        steps_left = rest * new / config.batch_size
        self._interval = max(WARM_UP_STEPS, min(self._interval, int(steps_left * SHARE)))
        following = step + self._interval if rest > LAST_SHARE * config.iterations else MAX_IMAGES
        return Plan(following, None if new == old else new, 1 / cost, seconds + at_one * new)

    def _report(self, plan: Plan) -> None:
        """Log a change of pace; print it too if the length of the run has changed by `SHOWN_CHANGE`."""
        state, total = self._state, self._state.schedule.iterations
        speed, seconds = plan.images_per_second, plan.seconds
        scale, text = total / state.config.schedule.iterations, None
        if abs(total - self._shown) > SHOWN_CHANGE * total:
            self._shown = total
            text = (
                f"{speed:.1f} images/s: {total:,} images in all, a scale of {scale:.3g}; will end after "
                f"about {seconds / 60:.3g} minutes (--minutes: {self._seconds / 60:.3g})"
            )
        values = {"images": total, "scale": scale, "images_per_second": speed, "seconds": seconds}
        state.log.event(state.images_seen, "pace", values, text)


def _growth(config: ScheduleConfig, time: float) -> float:
    """Return by which factor an average image after `time` takes longer than an image at `time`."""
    if config.densify_from >= config.densify_until:
        return 1.0
    return 1 + (GROWTH - 1) * max(0.0, 1 - time / config.densify_until)


# From this number on, `by` counts images; below, it is a factor.
LEAST_IMAGES = 100


def extended(config: Config, step: int, by: float) -> Config:
    """Return the configuration of a finished run with a longer schedule: `by` images, or `by` times as long.

    It is a number of images from `LEAST_IMAGES` on. The times of all events stay, so the new part of the run
    has no density events and no importance passes. Learning rates stay at their final values. ConfigError:
    the run is not finished, or would become too long.
    """
    schedule = Schedule(config.schedule)
    if step < schedule.steps:
        raise ConfigError(
            f"the run is not finished ({step * schedule.batch_size:,} of {schedule.iterations:,} images): "
            "continue it with --resume instead of --extend"
        )
    images = by if by >= LEAST_IMAGES else (by - 1) * schedule.iterations
    iterations = config.schedule.iterations + math.ceil(images / schedule.pace.scale)
    # The pace that the run has measured stays as it is.
    longer = replace(config.schedule, iterations=iterations, minutes=0.0, images_per_view=0.0)
    config = replace(config, schedule=longer)
    for problem in problems(config):
        raise ConfigError(problem)
    return config
