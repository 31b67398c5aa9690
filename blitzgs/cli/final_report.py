# SPDX-License-Identifier: Apache-2.0
"""The report that `blitzgs train` writes at its end."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TextIO

# The model in 3D is read from the checkpoint, beside the model in memory: only up to so many Gaussians.
_MAX_GAUSSIANS = 2_000_000


@contextlib.contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Yield a list that gets the texts of all warnings inside the context, which are shown as usual."""
    texts: list[str] = []
    usual = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, UserWarning):
            texts.append(str(message))
        usual(message, category, filename, lineno, file, line)

    warnings.showwarning = show
    try:
        yield texts
    finally:
        warnings.showwarning = usual


def write_final_report(folder: Path, summary: Mapping[str, object] | None) -> None:
    """Write the report of a run that ends; a failure is a warning.

    Args:
        folder: the run.
        summary: its summary; None: it was stopped.
    """
    from blitzgs.report.look import look_of
    from blitzgs.report.report import write_report

    count = 0 if summary is None else summary["gaussians"]
    try:
        look = look_of(folder) if isinstance(count, int) and 0 < count <= _MAX_GAUSSIANS else None
        write_report(folder, look)
    except Exception as error:
        warnings.warn(
            f"the report was not written ({type(error).__name__}: {error}); blitzgs report RUN tries again",
            stacklevel=2,
        )
