# SPDX-License-Identifier: Apache-2.0
"""A bar for work that goes image by image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int], None]


@contextmanager
def image_progress(what: str, shown: bool = True) -> Iterator[Report]:
    """Show a bar on standard error while the context lasts, where that is a terminal.

    Args:
        what: the work, for its label.
        shown: False for no bar, as on all ranks but one.

    Yields:
        Call it with (images done, images in all).
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
