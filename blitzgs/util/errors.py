# SPDX-License-Identifier: Apache-2.0
"""What a user is told: texts, warnings and errors at the right place, wrong arguments, too little memory.

Packages are imported where they are needed, as what warns may do without.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from numbers import Real
from typing import TYPE_CHECKING, Any

from blitzgs.util.memory import available_bytes

if TYPE_CHECKING:
    import torch


class UserError(RuntimeError):
    """An error that a user can cause and correct: commands print its message, without a traceback."""


# What the use of JSON with other fields, kinds or sizes of values than expected may raise.
WRONG_CONTENT = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError)
# Control characters except tab, and the marks that change the direction of text.
_CONTROLS = re.compile("[\x00-\x08\x0a-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str, lines: bool = False) -> str:
    """Return text for a terminal: control characters are escapes, but line feeds may stay (`lines`)."""
    return _CONTROLS.sub(lambda match: "\n" if lines and match[0] == "\n" else ascii(match[0])[1:-1], text)


def amount(size: float) -> str:
    """Return a number of bytes as text, in a unit that leaves three digits or so."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= 0.9995 * factor:
            return f"{size / factor:,.{max(0, 3 - len(str(int(size / factor))))}f} {unit}"
    return f"{size:.0f} bytes"


# Between a line of this package and its caller are contexts, and what torch wraps a function in.
_PASSED = ("blitzgs", "contextlib", "torch")


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn of a user's data; the warning is that of the line that called this package."""
    level, frame = 2, sys._getframe(1).f_back
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _PASSED:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level + 1)


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Yield a list that gets the texts of all warnings inside the context, which are shown as usual."""
    texts: list[str] = []
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if issubclass(category, UserWarning):
            texts.append(str(message))
        usual(message, category, *place, **more)

    warnings.showwarning = show
    try:
        yield texts
    finally:
        warnings.showwarning = usual


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


def check_tensors(**values: object) -> None:
    """Raise a TypeError unless all values are tensors; it names the first that is none."""
    import torch

    for name, value in values.items():
        if not isinstance(value, torch.Tensor):
            hint = ": convert it with torch.from_numpy" if type(value).__module__ == "numpy" else ""
            raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}{hint}")


def check_number(name: str, value: object) -> None:
    """Raise a TypeError unless a value is a number."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r} ({type(value).__name__})")


# What torch says when memory is missing; kernels only learn that the call of an allocation failed.
_MESSAGES = re.compile(
    r"can't allocate memory|not enough memory|out of memory|aoti_torch_empty\w*\(.*API call failed", re.DOTALL
)


class NotEnoughMemoryError(MemoryError, RuntimeError):
    """There is too little memory; the message says for what, how much that takes and how much is free."""


def is_lack_of_memory(error: BaseException) -> bool:
    """Tell whether an error is that of a failed allocation."""
    import torch

    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    return isinstance(error, RuntimeError) and _MESSAGES.search(str(error)) is not None


def explain_memory(
    error: BaseException, views: int, width: int, height: int, gaussians: int, device: torch.device
) -> None:
    """Raise NotEnoughMemoryError for an error with which rendering ended, if an allocation failed."""
    if isinstance(error, NotEnoughMemoryError) or not is_lack_of_memory(error):
        return
    # A pixel has three colours, an opacity and the number of its last splat.
    needed = views * width * height * 5 * 4
    count = "1 view" if views == 1 else f"{views:,} views"
    raise NotEnoughMemoryError(
        f"not enough memory to render {count} of {width:,} x {height:,} pixels with {gaussians:,} "
        f"Gaussians: the pixels alone take {amount(needed)}, and {amount(_free(device))} are "
        f"free on {device}. Render smaller views, or fewer at once"
    ) from error


def _free(device: torch.device) -> int:
    """Return the bytes that are free on a device."""
    import torch

    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return available_bytes()
