# SPDX-License-Identifier: Apache-2.0
"""What a run shows while it works: a progress bar (or plain lines), a JSONL file and TensorBoard events."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

_SHOWN: dict[str, Callable[[float], str]] = {
    "loss": lambda value: f"loss {value:.4f}",
    "psnr": lambda value: f"{value:.2f} dB",
    "gaussians": lambda value: f"{_count(value)} Gaussians",
    "images_per_second": lambda value: f"{value:.1f} images/s",
}


def _count(value: float) -> str:
    return f"{value / 1e6:.2f}M" if value >= 1e6 else f"{value / 1e3:.1f}k"


class RunLog:
    """Writes records of a run. Silent without a folder (the ranks other than 0)."""

    def __init__(self, folder: Path | None, total: int, done: int, tensorboard: bool) -> None:
        """Open the log.

        Args:
            folder: of the run; appends to its `log.jsonl`. None: log nothing.
            total: images of the whole run.
            done: images seen before (a resumed run).
            tensorboard: also write events to `folder/tensorboard`, if the package is installed.
        """
        self._file: TextIO | None = None
        self._board: Any = None
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._total, self._first, self._started = total, done, time.monotonic()
        self.console = Console(quiet=folder is None, highlight=False)
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._file = (folder / "log.jsonl").open("a", encoding="utf-8")
        if tensorboard:
            self._board = _summary_writer(folder / "tensorboard")
        if self.console.is_terminal:
            self._progress = Progress(
                TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
                BarColumn(bar_width=8),
                TextColumn("{task.description}  ETA"),
                TimeRemainingColumn(compact=True),
                console=self.console,
            )
            self._task = self._progress.add_task("", total=total, completed=done)
            self._progress.start()

    def scalars(self, t: int, values: Mapping[str, float]) -> None:
        """Record numbers at time `t` (images)."""
        self._write({"t": t, **values})
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(name, value, t)
        text = "  ".join(_SHOWN[name](value) for name, value in values.items() if name in _SHOWN)
        if self._progress is not None:
            self._progress.update(self._task, completed=t, description=text)
        elif self._file is not None:
            rate = (time.monotonic() - self._started) / max(1, t - self._first)
            left = timedelta(seconds=round(rate * (self._total - t)))
            self.console.print(f"{t:>7,}/{self._total:,} images  {text}  ETA {left}", soft_wrap=True)

    def event(self, t: int, kind: str, values: Mapping[str, Any], text: str | None = None) -> None:
        """Record something that happened at time `t`; print `text` if given."""
        self._write({"t": t, "event": kind, **values})
        if self._board is not None:
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    self._board.add_scalar(f"{kind}/{name}", value, t)
        if text is not None:
            self.console.print(f"{t:>7,} {text}", soft_wrap=True)

    def close(self) -> None:
        """Flush and end the progress display."""
        if self._progress is not None:
            self._progress.stop()
        if self._board is not None:
            self._board.close()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, record: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(record) + "\n")
            self._file.flush()


def _summary_writer(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder))
