# SPDX-License-Identifier: Apache-2.0
"""Counter-based random numbers: a draw depends on its key alone, not on the rank or on earlier draws."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# SplitMix64 (Steele, Lea, Flood 2014) as signed 64-bit integers, whose products wrap as unsigned ones do.
_GOLDEN = 0x9E3779B97F4A7C15 - (1 << 64)
_MIX_1 = 0xBF58476D1CE4E5B9 - (1 << 64)
_MIX_2 = 0x94D049BB133111EB - (1 << 64)


def hash_keys(*keys: Tensor | int) -> Tensor:
    """Hash tuples of integers to 64 well-mixed bits.

    Args:
        keys: int64 tensors of one shape (or broadcastable) and integers; at least one tensor.

    Returns:
        int64 of the broadcast shape, all 64 bits random. The order of the keys matters.
    """
    tensors = [key for key in keys if isinstance(key, Tensor)]
    state = torch.zeros((), dtype=torch.int64, device=tensors[0].device)
    for key in keys:
        value = key.to(torch.int64) if isinstance(key, Tensor) else key
        state = _mix(state + _GOLDEN ^ value)
    return state


def uniform(*keys: Tensor | int) -> Tensor:
    """Draw float64 numbers uniform in (0, 1), one per key tuple; see `hash_keys`."""
    return (_shift_right(hash_keys(*keys), 11).double() + 0.5) * 2.0**-53


def normal(*keys: Tensor | int) -> Tensor:
    """Draw float64 standard normal numbers, one per key tuple (Box-Muller); see `hash_keys`."""
    device = next(key.device for key in keys if isinstance(key, Tensor))
    pairs = uniform(
        *(key[..., None] if isinstance(key, Tensor) else key for key in keys), torch.arange(2, device=device)
    )
    first, second = pairs.unbind(-1)
    return (-2.0 * first.log()).sqrt() * (2.0 * math.pi * second).cos()


def _mix(value: Tensor) -> Tensor:
    value = (value ^ _shift_right(value, 30)) * _MIX_1
    value = (value ^ _shift_right(value, 27)) * _MIX_2
    return value ^ _shift_right(value, 31)


def _shift_right(value: Tensor, bits: int) -> Tensor:
    """Shift right and fill with zeros; torch's own shift of int64 repeats the sign bit."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)
