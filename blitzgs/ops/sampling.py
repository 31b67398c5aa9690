# SPDX-License-Identifier: Apache-2.0
"""Keys that sample without replacement in proportion to weights, and counts of keys by their bits."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

KEY_BITS = 32


@torch.no_grad()
def sampling_keys(weights: Tensor, ids: Tensor, seed: int, event: int) -> Tensor:
    """Draw keys; the k smallest are a sample without replacement, with probability proportional to weight.

    key = -log(u) / weight with u uniform in (0, 1) from (seed, event, id) alone (exponential races,
    Efraimidis and Spirakis 2006).

    Args:
        weights: float32 [N], >= 0; zero gives an infinite key, never chosen while a positive one remains.
        ids: int64 [N], persistent.
        seed: of the run.
        event: number that differs between draws.

    Returns:
        float32 [N].

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    keys: Tensor = torch.ops.blitzgs.sampling_keys(weights, ids, seed, event)
    return keys


@torch.no_grad()
def key_histogram(keys: Tensor, prefix: Tensor, shift: int, width: int) -> Tensor:
    """Count keys by a digit of their ordered bits: 32-bit integers with the order of the keys.

    Args:
        keys: float32 [N].
        prefix: int64 [1], the bits before the digit; keys with others are not counted.
        shift: number of bits after the digit.
        width: number of bits of the digit, 1 to 11.

    Returns:
        int64 [2^width].

    Raises:
        RuntimeError: wrong shapes, dtypes or bits.
    """
    counts: Tensor = torch.ops.blitzgs.key_histogram(keys, prefix, shift, width)
    return counts


def key_of_bits(bits: Tensor) -> Tensor:
    """Return the keys, float32, with the given ordered bits (int64)."""
    bits = bits ^ torch.where(bits >> (KEY_BITS - 1) > 0, 1 << (KEY_BITS - 1), (1 << KEY_BITS) - 1)
    return bits.to(torch.int32).view(torch.float32)
