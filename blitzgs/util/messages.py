# SPDX-License-Identifier: Apache-2.0
"""What a user is told: warnings at the line that called this package, and errors that say where they are."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any


def warn(text: str) -> None:
    """Warn of a user's data; the warning is that of the line that called this package."""
    level, frame = 2, sys._getframe(1).f_back
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "blitzgs":
        level, frame = level + 1, frame.f_back
    warnings.warn(text, stacklevel=level + 1)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put a place before the text of a ValueError that leaves the context."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def optional_package(name: str, extra: str, what: str) -> Any:
    """Return a package of one of the extras; `what` needs it (ImportError: it cannot be imported)."""
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(
            f'{what} needs the package {name} ({error}): pip install "blitzgs[{extra}]"'
        ) from error
