# SPDX-License-Identifier: Apache-2.0
"""Long work: a progress bar, the seconds of its parts, and processes that end with their parent."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import psutil
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int], None]
# Least seconds between two lines about long work, without a terminal's bar.
LINE_SECONDS = 30.0


def lines(say: Callable[[str], None]) -> Report:
    """Return a function to call with (number done, number of all), which says both now and then."""
    said = time.monotonic()

    def report(done: int, total: int) -> None:
        nonlocal said
        if time.monotonic() >= said + LINE_SECONDS:
            said = time.monotonic()
            say(f"{done:,} of {total:,}")

    return report


@contextmanager
def image_progress(what: str, shown: bool = True, unit: str = "images") -> Iterator[Report]:
    """Show a bar on standard error while the context lasts; if it is no terminal, a line now and then.

    Yields a function to call with (images done, number of images), or so many of another unit.
    """
    console = Console(stderr=True)
    if shown and not console.is_terminal:
        yield lines(lambda text: print(f"{what}: {text} {unit}", file=sys.stderr, flush=True))
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    rest = TimeRemainingColumn()
    with Progress(*columns, rest, console=console, disable=not shown, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class Laps:
    """The seconds of consecutive parts."""

    def __init__(self, since_start: bool = False) -> None:
        """Begin the first part now, or (`since_start`) at the start of this process."""
        self.seconds: dict[str, float] = {}  # of each part so far, in order
        self._last = psutil.Process().create_time() if since_start else time.time()

    def lap(self, name: str) -> None:
        """End a part, which is called `name`, and begin the next one."""
        now = time.time()
        self.seconds[name] = self.seconds.get(name, 0.0) + max(0.0, now - self._last)
        self._last = now

    def text(self) -> str:
        """Return all parts in a line."""
        parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in self.seconds.items())
        return f"set-up {sum(self.seconds.values()):.1f} s: {parts}"


_PR_SET_PDEATHSIG = 1  # of prctl(2)


def follow_parent() -> None:
    """Make this process leave interrupts to the one that started it, and end with it, however that ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # it has ended before this process asked to know
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def ending_by_exception() -> Iterator[None]:
    """Let SIGTERM and a closing terminal end the process by SystemExit, so that temporary files go.

    A signal that is ignored, as by `nohup`, stays ignored.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) == signal.SIG_DFL:
                before[number] = signal.signal(number, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
