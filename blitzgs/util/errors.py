# SPDX-License-Identifier: Apache-2.0
"""Errors with a remedy: packages that are missing, arguments of the wrong type, and lack of memory."""

from __future__ import annotations

import re
from importlib import import_module
from numbers import Real
from types import ModuleType

import psutil
import torch
from torch import Tensor

from blitzgs.util.terminal import amount


def require(package: str, why: str) -> ModuleType:
    """Import an optional package (ImportError: it is not installed; the message says `why` it is needed)."""
    try:
        return import_module(package)
    except ImportError as error:
        raise ImportError(f"{why} ({error})") from error


def check_tensor(name: str, value: object) -> None:
    """Raise a TypeError unless a value is a tensor."""
    if isinstance(value, Tensor):
        return
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
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return int(psutil.virtual_memory().available)
