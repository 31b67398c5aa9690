# SPDX-License-Identifier: Apache-2.0
"""Agreement of the ranks on what interrupts training: a signal, a checkpoint that is due, a lost photograph.

All ranks must act on these after the same step, so every few steps one small reduction tells each rank the
requests of all. torchrun kills a process 30 seconds after SIGTERM, so the number of steps depends on their
duration.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.ops.host import HostCopy, to_device
from blitzgs.runs.checkpoint import Saving

# The ranks agree at least this often: in steps, and in seconds as far as single steps allow. On GPUs they
# learn the decision one step later.
MAX_STEPS = 16
MAX_SECONDS = 4.0

# torchrun sends a terminal's SIGINT once more, which is no second one.
REPEAT_SECONDS = 1.0
_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopRequest:
    """Turns SIGTERM, SIGINT and SIGHUP into a request that the loop handles between two steps.

    A second SIGINT, `REPEAT_SECONDS` later, raises KeyboardInterrupt at once. If SIGHUP was ignored before
    (`nohup`), it stays ignored.
    """

    def __init__(self) -> None:
        self.number = 0
        self._again = 0.0  # from when on a SIGINT is a second one: torchrun repeats the terminal's
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
        if number == signal.SIGINT == self.number:
            if "TORCHELASTIC_RUN_ID" in os.environ and time.monotonic() < self._again:
                return
            raise KeyboardInterrupt
        self.number, self._again = number, time.monotonic() + REPEAT_SECONDS


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

    @property
    def is_written(self) -> bool:
        """Tell whether this rank has written its part of a checkpoint."""
        return self.saving is not None and self.saving.is_written


@dataclass(frozen=True)
class Decision:
    """What all ranks must do after a step."""

    signal: str | None = None  # name of the signal that ends the run, or None
    save: bool = False  # whether a checkpoint is due
    written: bool = False  # whether all ranks have written their parts of the checkpoint that has begun
    lost: bool = False  # whether a rank could not read a photograph and continues without it
    watched: bool = False  # whether those who watch the run want something


class Agreement:
    """Gives every rank the same decision after the same step.

    On GPUs the requests are collected while the next step runs, so the host does not wait for them.
    """

    def __init__(
        self, ranks: Ranks, stop: StopRequest, clock: SaveClock, wants: Callable[[], bool] = lambda: False
    ) -> None:
        """Prepare; `wants` returns whether those who watch the run want something of all ranks."""
        self._ranks, self._stop, self._clock, self._wants = ranks, stop, clock, wants
        self._next = 0
        self._last: tuple[int, float] | None = None
        # The requests of all ranks and the step after which they were collected, until they are read.
        self._asked: tuple[int, HostCopy] | None = None
        self._reads_late = ranks.device.type == "cuda"
        self._agreed_to_stop = False

    def after(self, step: int, lost: bool = False) -> Decision:
        """Return the decision for `step`; every rank calls this after every step.

        `lost`: whether this rank continues without a photograph that it could not read.
        """
        if self._ranks.world_size == 1 or self._agreed_to_stop:
            return self.now(step, lost)
        if self._asked is None:
            if step < self._next:
                return Decision()
            self._asked = self._ask(step, lost)
            if self._reads_late:
                return Decision()
        return self._answer(step, *self._asked)

    def now(self, step: int, lost: bool = False) -> Decision:
        """Return a decision at once, whatever the step; every rank calls this."""
        if self._ranks.world_size == 1:
            clock = self._clock
            return _decision(self._stop.number, clock.is_due, clock.is_written, lost, self._wants())
        return self._answer(step, *self._ask(step, lost))

    def _ask(self, step: int, lost: bool) -> tuple[int, HostCopy]:
        """Collect the requests of all ranks after `step`."""
        now = time.monotonic()
        # The duration of a step is not known at first, so the ranks agree again after the next one.
        seconds = MAX_SECONDS
        if self._last is not None and step > self._last[0]:
            seconds = (now - self._last[1]) / (step - self._last[0])
        unwritten = not self._clock.is_written
        requests = [self._stop.number, self._clock.is_due, unwritten, seconds, lost, self._wants()]
        values = to_device(torch.tensor(requests, dtype=torch.float64), self._ranks.device)
        return step, HostCopy(self._ranks.all_reduce(values, "max").view(torch.int64))

    def _answer(self, step: int, asked: int, requests: HostCopy) -> Decision:
        """Decide after `step` by the requests of all ranks after step `asked`; wait for them."""
        with self._ranks.watchdog.waiting("agree"):
            number, due, unwritten, slowest, any_lost, watched = requests.read().view(torch.float64).tolist()
        self._asked = None
        interval = max(1, min(MAX_STEPS, int(MAX_SECONDS / max(slowest, 1e-9))))
        self._next, self._last = (asked // interval + 1) * interval, (step, time.monotonic())
        self._agreed_to_stop = number > 0
        return _decision(int(number), due > 0, not unwritten, any_lost > 0, watched > 0)


def _decision(number: int, *others: bool) -> Decision:
    return Decision(signal.Signals(number).name if number else None, *others)
