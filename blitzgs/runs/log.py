# SPDX-License-Identifier: Apache-2.0
"""The log of a run: a progress bar (or plain lines), a JSONL file and TensorBoard events.

A failure to write never ends a run. If the disk is full, one warning is printed, and records are kept in
memory to be written later. What is printed survives a closed terminal by `blitzgs.cli.output`.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column

from blitzgs.runs.run_files import LOG
from blitzgs.util.errors import printable, warn
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report, lines

BOARD = "tensorboard"
# Largest number of records that are kept while the disk is full; then the oldest are dropped.
_MAX_WAITING = 10_000
# Least seconds between two moves of a terminal's bar.
_BAR_SECONDS = 0.5
# The loss and the PSNR that are shown are means over this number of records; the file has each record's own.
# The remaining time follows from the speed over as many, which resolution and population change.
_RECENT = 20
# Events after the last image, which a run that is resumed there logs again.
_AT_THE_END = ("population", "image_memory", "evaluation", "worst views")

_SHOWN: dict[str, Callable[[float], str]] = {
    "loss": lambda value: f"loss {value:.4f}",
    "psnr": lambda value: f"train {value:.2f} dB",
    "held_out": lambda value: f"held-out {value:.2f} dB",
    "gaussians": lambda value: f"{_count(value)} Gaussians",
    "images_per_second": lambda value: f"{value:.1f} images/s",
}


def _count(value: float) -> str:
    return f"{value / 1e6:.2f}M" if value >= 1e6 else f"{value / 1e3:.1f}k"


class RunLog:
    """Writes the records of a run; without a folder (on ranks other than 0) it does nothing."""

    # Called with the time and the values of every record.
    listener: Callable[[int, Mapping[str, Any]], object] | None = None

    def __init__(
        self, folder: Path | None, total: int, done: int, tensorboard: bool, run_id: str = ""
    ) -> None:
        """Open the log, and drop the records that a resumed run, with `done` images, will write again.

        Records are appended to `folder/log.jsonl` and, if the package is installed, to `folder/tensorboard`.
        Without a folder nothing is logged.
        """
        self._failed: set[str] = set()  # kinds of logs of which a failure was told
        self._file = None if folder is None else folder / LOG
        self._waiting: deque[bytes] = deque(maxlen=_MAX_WAITING)  # lines that are not in the file yet
        self._board: Path | None = None  # folder of TensorBoard's events
        self._writer: Any = None  # of these events
        self._done = done
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._moved = 0.0
        self._recent: dict[str, deque[float]] = {}
        self._held_out: float | None = None
        self._run_id = run_id
        self._marks = deque([(done, time.monotonic())], maxlen=_RECENT)
        self.total = total  # images of the whole run, from which the remaining time is estimated
        self.console = Console(quiet=folder is None, highlight=False)
        if folder is None:
            return
        with self._tolerated("log file"):
            folder.mkdir(parents=True, exist_ok=True)
            _drop_repeated(folder / LOG, run_id, done, total)
        if tensorboard and find_spec("tensorboard") is not None:
            self._board = folder / BOARD
        if self.console.is_terminal:
            bar = [BarColumn(bar_width=8)] if self.console.width >= 60 else []
            self._progress = Progress(
                TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
                *bar,
                TextColumn("{task.description}", table_column=Column()),  # may wrap, the others do not
                TextColumn("ETA"),
                TimeRemainingColumn(compact=True),
                console=self.console,
            )
            self._task = self._progress.add_task("", total=total, completed=done)
            self._progress.start()

    def advance(self, t: int) -> None:
        """Move the terminal's bar to time `t` (images): every half second at most, and at the end."""
        if self._progress is None:
            return
        now = time.monotonic()
        if now >= self._moved + _BAR_SECONDS or t >= self.total:
            self._moved = now
            self._progress.update(self._task, completed=t, total=self.total)

    @contextlib.contextmanager
    def work(self, what: str) -> Iterator[Report]:
        """Show how far other work is while the context lasts: a bar on a terminal, else a line now and then.

        Yields a function to call with (number done, number of all) of `what`, for example "views measured".
        """
        if self._progress is not None:
            bar = self._progress
            task = bar.add_task(what, total=0)
            try:
                yield lambda done, total: bar.update(task, completed=done, total=total)
            finally:
                bar.remove_task(task)
            return
        yield lines(lambda text: self._print(f"        {text} {what}") if self._file is not None else None)

    def scalars(self, t: int, values: Mapping[str, float]) -> None:
        """Record numbers at time `t` (images)."""
        self._write(t, values)
        self._draw(t, values)
        text = self._shown(values)
        if self._progress is not None:
            self._progress.update(self._task, completed=t, total=self.total, description=text)
        elif self._file is not None:
            first, since = self._marks[0]
            self._marks.append((t, now := time.monotonic()))
            left = timedelta(seconds=round((now - since) / max(1, t - first) * (self.total - t)))
            self._print(f"{t:>7,}/{self.total:,} images  {text}  ETA {left}")

    def _shown(self, values: Mapping[str, float]) -> str:
        """Return the text of a record: running means, because a record is that of a few views."""
        shown = dict(values)
        for name in ("loss", "psnr"):
            if name in values:
                recent = self._recent.setdefault(name, deque(maxlen=_RECENT))
                recent.append(values[name])
                shown[name] = fmean(recent)
        if self._held_out is not None:
            shown["held_out"] = self._held_out
        return "  ".join(show(shown[name]) for name, show in _SHOWN.items() if name in shown)

    def event(self, t: int, kind: str, values: Mapping[str, Any], text: str | None = None) -> None:
        """Record something that happened at time `t`; print `text` if given."""
        self._write(t, {"event": kind, **values})
        is_held_out = kind == "glance" or (kind == "evaluation" and values.get("split") == "test")
        if is_held_out and "psnr" in values:
            self._held_out = values["psnr"]
        numbers = {name: value for name, value in values.items() if isinstance(value, (int, float))}
        self._draw(t, {f"{kind}/{name}": value for name, value in numbers.items()})
        if text is not None:
            self._print(f"{t:>7,} {text}")

    def close(self) -> None:
        """Write remaining records and end the progress display."""
        if self._progress is not None:
            self._progress.stop()
        if self._writer is not None:
            with self._tolerated("TensorBoard"):
                self._writer.close()
        self._flush()
        self._file = None

    def _write(self, t: int, values: Mapping[str, Any]) -> None:
        if self.listener is not None:
            self.listener(t, values)
        if self._file is not None:
            record = {"t": t} | ({"run": self._run_id} if self._run_id else {}) | dict(values)
            self._waiting.append(json.dumps(record).encode() + b"\n")
            self._flush()

    def _flush(self) -> None:
        """Write the lines that wait; those that cannot be written go on waiting."""
        if self._file is None or not self._waiting:
            return
        # Open the file each time, because its disk may have been detached and attached again.
        with self._tolerated("log file"), open(self._file, "ab", buffering=0) as file:
            while self._waiting:
                line = self._waiting[0]
                written = file.write(line)
                if written < len(line):
                    # Write the rest when there is space again; readers skip lines that stay incomplete.
                    self._waiting[0] = line[written:]
                    raise OSError("the disk is full")
                self._waiting.popleft()

    def _draw(self, t: int, values: Mapping[str, float]) -> None:
        # Where the log file has no space, each writer's thread would end with a traceback on the terminal.
        if self._board is None or self._waiting:
            return
        with self._tolerated("TensorBoard"):
            from torch.utils.tensorboard import SummaryWriter

            # Drop the steps after `done` that an interrupted run has logged: they will be logged again.
            purge = self._done + 1 if self._done else None
            writer = self._writer or SummaryWriter(str(self._board), purge_step=purge)
            self._writer = None  # after an error its thread has ended, and the next record makes a new one
            for name, value in values.items():
                writer.add_scalar(name, value, t)
            self._writer = writer

    def _print(self, text: str) -> None:
        self.console.print(printable(text), soft_wrap=True, markup=False, emoji=False)

    @contextlib.contextmanager
    def _tolerated(self, kind: str) -> Iterator[None]:
        """Make a warning of the first error of a kind of log, and nothing of later ones."""
        try:
            yield
        except (OSError, ValueError, RuntimeError, ImportError) as error:
            if kind not in self._failed:
                self._failed.add(kind)
                with contextlib.suppress(OSError):
                    warn(f"{kind}: {error}; training goes on, records may be missing there")


def records(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a log, oldest first, without lines that a crash or a full disk left incomplete."""
    if not path.exists():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            if isinstance(record := json.loads(line), dict):
                yield record


def _drop_repeated(path: Path, run_id: str, done: int, total: int) -> None:
    """Drop the records of run `run_id` after `done` images: the resumed run will write them again."""
    if not run_id or not path.exists():
        return
    kept = []
    for record in records(path):
        own, t = record.get("run") == run_id, record.get("t")
        is_at_the_end = t == total and record.get("event") in _AT_THE_END
        if not own or (isinstance(t, int) and t <= done and not is_at_the_end):
            kept.append(json.dumps(record) + "\n")
    write_file(path, "".join(kept))
