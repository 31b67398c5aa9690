# SPDX-License-Identifier: Apache-2.0
"""Checks the types of arguments of public functions, with messages that name the argument."""

from __future__ import annotations

from numbers import Real

from torch import Tensor


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
