# SPDX-License-Identifier: Apache-2.0
"""Agreement of the ranks on what interrupts training: a signal, a checkpoint that is due, a lost photograph.

All ranks must act on these after the same step, so every few steps one small reduction tells each rank the
requests of all. torchrun kills a process 30 seconds after SIGTERM, so the number of steps depends on their
duration.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.ops.host import to_device
from blitzgs.runs.checkpoint import Saving

# The ranks agree at least this often: in steps, and in seconds as far as single steps allow.
MAX_STEPS = 16
MAX_SECONDS = 4.0

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopRequest:
    """Turns SIGTERM, SIGINT and SIGHUP into a request that the loop handles between two steps.

    A second SIGINT raises KeyboardInterrupt at once. If SIGHUP was ignored before (`nohup`), it stays
    ignored.
    """

    def __init__(self) -> None:
        self.number = 0
        self._previous: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: FrameType | None) -> None:
        # A closing terminal sends SIGHUP and SIGTERM together, so only a second SIGINT means "at once".
        if number == signal.SIGINT and self.number == signal.SIGINT:
            raise KeyboardInterrupt
        self.number = number


class SaveClock:
    """Tells when the next checkpoint by wall time is due."""

    def __init__(self, seconds: float) -> None:
        """Start the clock; `seconds` is the time between two checkpoints; 0: none by wall time."""
        # The checkpoint that is being written; None: there is none. No other one is due meanwhile.
        self.saving: Saving | None = None
        self._seconds = seconds or math.inf
        self.restart()

    def restart(self, seconds: float | None = None) -> None:
        """Restart the clock, for the usual number of seconds or another one."""
        self._at = time.monotonic() + (self._seconds if seconds is None else seconds)

    @property
    def is_due(self) -> bool:
        """Tell whether the time has passed."""
        return self.saving is None and time.monotonic() >= self._at


@dataclass(frozen=True)
class Decision:
    """What all ranks must do after a step."""

    signal: str | None  # name of the signal that ends the run, or None
    save: bool  # whether a checkpoint is due
    written: bool = False  # whether all ranks have written their parts of the checkpoint that has begun
    lost: bool = False  # whether a rank could not read a photograph and continues without it
    watched: bool = False  # whether those who watch the run want something


class Agreement:
    """Gives every rank the same decision after the same step."""

    def __init__(
        self, ranks: Ranks, stop: StopRequest, clock: SaveClock, wants: Callable[[], bool] = lambda: False
    ) -> None:
        """Prepare; `wants` returns whether those who watch the run want something of all ranks."""
        self._ranks, self._stop, self._clock, self._wants = ranks, stop, clock, wants
        self._next = 0  # the step after which the ranks agree again
        self._last: tuple[int, float] | None = None  # the step after which they agreed last, and when

    def after(self, step: int, lost: bool = False) -> Decision:
        """Return the decision for `step`; every rank calls this after every step.

        `lost`: whether this rank continues without a photograph that it could not read.
        """
        if self._ranks.world_size > 1 and step < self._next:
            return Decision(None, False)
        return self.now(step, lost)

    def now(self, step: int, lost: bool = False) -> Decision:
        """Return a decision at once, whatever the step; every rank calls this."""
        clock, ranks, now = self._clock, self._ranks, time.monotonic()
        # The duration of a step is not known at first, so the ranks agree again after the next one.
        seconds = MAX_SECONDS
        if self._last is not None and step > self._last[0]:
            seconds = (now - self._last[1]) / (step - self._last[0])
        unfinished = clock.saving is None or not clock.saving.is_written
        requests = [self._stop.number, clock.is_due, unfinished, lost, self._wants(), seconds]
        if ranks.world_size > 1:
            values = to_device(torch.tensor(requests, dtype=torch.float64), ranks.device)
            with ranks.watchdog.waiting("agree"):
                requests = ranks.all_reduce(values, "max").tolist()
        number, due, unwritten, any_lost, watched, slowest = requests
        interval = max(1, min(MAX_STEPS, int(MAX_SECONDS / max(slowest, 1e-9))))
        self._next, self._last = (step // interval + 1) * interval, (step, time.monotonic())
        name = None
        if number > 0:
            name, self._next = signal.Signals(int(number)).name, 0
        return Decision(name, due > 0, not unwritten, any_lost > 0, watched > 0)
