# SPDX-License-Identifier: Apache-2.0
"""Fits a schedule into a wall time (`schedule.minutes`) by changing the pace of a run while it trains.

Nothing is known before the first step, and a step becomes slower as the population grows. So the run begins
at `scale` 1, measures the time of an image, and chooses the pace at which what is left of the schedule takes
what is left of the time. It does so again after each eighth of what is left, so that the error shrinks with
what is left. No step is lost to a trial run.
"""

from __future__ import annotations

from dataclasses import dataclass

from blitzgs.training.config import ScheduleConfig
from blitzgs.training.config_ranges import MOST_IMAGES, SCALE
from blitzgs.training.state import TrainingState

# The first steps of a process are slow (memory, kernels, photographs): they are not measured. Nor is an
# interval shorter than these, which one slow step would spoil.
WARM_UP_STEPS = 4
# The pace is looked at after this share of what is left, and before that after twice as many steps each time.
SHARE = 1 / 8
# Beyond this share of the schedule the pace stays: the error is a few percent of it.
LAST_SHARE = 0.03
# At time 0, an image is taken to cost this many times less than those that follow on average, because the
# population grows; at the end of densification, the same. That half then takes about 40 % of the time.
GROWTH = 2.0
# A plan that ends so much of the budget beside it stays: each change costs some milliseconds.
TOLERANCE = 0.005
# One measurement may be spoilt by a disk or another process: it changes the pace by at most this factor.
MOST_CHANGE = 16.0
# A plan is shown when the run's length has changed by more than this share of it.
SHOWN_CHANGE = 0.1


@dataclass(frozen=True)
class Plan:
    """What rank 0 has decided after a step.

    Attributes:
        next: step after which the pace is looked at again.
        factor: of `schedule.scale`, which is 1, from here on; None: as before.
        images_per_second: the measured speed.
        seconds: of training at the end of the run, as foreseen.
    """

    next: int
    factor: float | None = None
    images_per_second: float = 0.0
    seconds: float = 0.0


class Budget:
    """Keeps a run to its time; does nothing for one without."""

    def __init__(self, state: TrainingState) -> None:
        """Begin to measure after the run's next few steps."""
        self._state = state
        self._seconds = 60 * state.config.schedule.minutes
        self._interval = WARM_UP_STEPS
        self._next = state.progress.step + WARM_UP_STEPS
        self._mark: tuple[int, float] | None = None
        self._shown = 0

    def after(self, step: int) -> None:
        """Change the pace after a step, where that is due; every rank calls this after each step's events."""
        state = self._state
        if self._seconds == 0 or step < self._next or step >= state.schedule.steps:
            return
        # The clocks of the ranks differ, and all must take the same steps.
        plan = state.ranks.broadcast_object(self._plan(step) if state.ranks.rank == 0 else None)
        assert plan is not None
        self._next = plan.next
        if plan.factor is not None:
            state.change_pace(plan.factor)
            self._report(plan)

    def _plan(self, step: int) -> Plan:
        """Decide on rank 0, by its clock."""
        images, seconds = self._state.images_seen, self._state.progress.seconds
        mark, self._mark = self._mark, (images, seconds)
        if mark is None:
            return Plan(step + self._interval)
        cost = max(seconds - mark[1], 1e-9) / (images - mark[0])
        config, schedule = self._state.config.schedule, self._state.schedule
        time, old = schedule.pace.time(images), schedule.pace.scale
        rest, left = config.iterations - time, self._seconds - seconds
        # What is left of the run takes this long at a scale of 1.
        at_one = rest * cost * _growth(config, time)
        wanted = old if abs(at_one * old - left) <= TOLERANCE * self._seconds else left / at_one
        most = min(SCALE.high, MOST_IMAGES / config.iterations, old * MOST_CHANGE)
        new = min(max(wanted, SCALE.low, old / MOST_CHANGE), most)
        if new == wanted:
            self._interval *= 2
        steps_left = rest * new / config.batch_size
        self._interval = max(WARM_UP_STEPS, min(self._interval, int(steps_left * SHARE)))
        following = step + self._interval if rest > LAST_SHARE * config.iterations else MOST_IMAGES
        return Plan(following, None if new == old else new, 1 / cost, seconds + at_one * new)

    def _report(self, plan: Plan) -> None:
        """Log a change of pace, and show it when the run has become clearly shorter or longer."""
        state = self._state
        total = state.schedule.iterations
        values = {
            "images": total,
            "scale": total / state.config.schedule.iterations,
            "images_per_second": plan.images_per_second,
            "seconds": plan.seconds,
        }
        text = None
        if abs(total - self._shown) > SHOWN_CHANGE * total:
            self._shown = total
            end = f"ends after {plan.seconds / 60:.3g} of {self._seconds / 60:.3g} minutes"
            text = (
                f"{plan.images_per_second:.1f} images/s: {total:,} images in all, a scale of "
                f"{values['scale']:.3g}; {end}"
            )
        state.log.event(state.images_seen, "pace", values, text)


def _growth(config: ScheduleConfig, time: float) -> float:
    """Return how much longer than now an image will take from `time` on, on average."""
    if config.densify_from >= config.densify_until:
        return 1.0
    return 1 + (GROWTH - 1) * max(0.0, 1 - time / config.densify_until)
