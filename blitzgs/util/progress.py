# SPDX-License-Identifier: Apache-2.0
"""A progress bar for work on a sequence of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int], None]


@contextmanager
def image_progress(what: str, shown: bool = True) -> Iterator[Report]:
    """Show a bar on standard error while the context lasts, if standard error is a terminal.

    Args:
        what: label of the bar.
        shown: False: show no bar, for ranks other than 0.

    Yields:
        A function to call with (images done, number of images).
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("images"),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns, console=console, disable=not (shown and console.is_terminal), transient=True
    ) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
