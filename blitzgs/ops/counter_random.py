# SPDX-License-Identifier: Apache-2.0
"""Counter-based random numbers, which depend on their key alone, not on the rank or on earlier draws."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def hash_keys(*keys: Tensor | int) -> Tensor:
    """Hash tuples of integers to 64 well-mixed bits (SplitMix64; Steele, Lea, Flood 2014).

    `keys`: int64 tensors of one shape (or broadcastable) and integers; at least one tensor. Returns int64 of
    the broadcast shape, all 64 bits random. The order of the keys matters.
    """
    tensors = torch.broadcast_tensors(*(key.long() for key in keys if isinstance(key, Tensor)))
    flat = iter([tensor.reshape(-1) for tensor in tensors])
    state = torch.zeros(tensors[0].numel(), dtype=torch.int64, device=tensors[0].device)
    for key in keys:
        state = torch.ops.blitzgs.hash_key(
            state, *((next(flat), 0) if isinstance(key, Tensor) else (None, key))
        )
    return state.view(tensors[0].shape)


def uniform(*keys: Tensor | int) -> Tensor:
    """Draw float64 numbers uniform in (0, 1), one per key tuple; see `hash_keys`."""
    return (((hash_keys(*keys) >> 11) & ((1 << 53) - 1)).double() + 0.5) * 2.0**-53


def normal(*keys: Tensor | int) -> Tensor:
    """Draw float64 standard normal numbers, one per key tuple (Box-Muller); see `hash_keys`."""
    device = next(key.device for key in keys if isinstance(key, Tensor))
    pairs = uniform(
        *(key[..., None] if isinstance(key, Tensor) else key for key in keys), torch.arange(2, device=device)
    )
    first, second = pairs.unbind(-1)
    return (-2.0 * first.log()).sqrt() * (2.0 * math.pi * second).cos()


KEY_BITS = 32


@torch.no_grad()
def sampling_keys(weights: Tensor, ids: Tensor, seed: int, event: int) -> Tensor:
    """Draw keys; the k smallest are a sample without replacement, with probability proportional to weight.

    key = -log(u) / weight with u uniform in (0, 1) from (seed, event, id) alone (exponential races,
    Efraimidis and Spirakis 2006).

    Args:
        weights: float32 [N], >= 0; zero gives an infinite key, never chosen while a positive one remains.
        ids: int64 [N], persistent.
        event: number that differs between draws.

    Returns:
        float32 [N].
    """
    return torch.ops.blitzgs.sampling_keys(weights, ids, seed, event)


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
    """
    return torch.ops.blitzgs.key_histogram(keys, prefix, shift, width)


def find_digit_(search: Tensor, counts: Tensor) -> None:
    """Take the digit at which counts reach the number of keys that a search is still to find.

    Args:
        search: int64 [3], changed in place: the digits so far, as a number; how many keys are still to be
            found under them, from 1 on; and how many keys have them, which is only written. If there are too
            few keys, the last digit is taken.
        counts: of the keys by their next digit, int64 [2^width].
    """
    torch.ops.blitzgs.find_digit_(search, counts)


def keys_up_to(keys: Tensor, limit: Tensor) -> Tensor:
    """Mark the keys, float32 [N], whose ordered bits are at most `limit` (int64 [1]); bool [N]."""
    return torch.ops.blitzgs.keys_up_to(keys, limit)
