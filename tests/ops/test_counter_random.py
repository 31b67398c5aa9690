# SPDX-License-Identifier: Apache-2.0
import torch

from blitzgs.ops.counter_random import hash_keys, normal, uniform


def splitmix(state: int) -> int:
    mask = 2**64 - 1
    state = ((state ^ state >> 30) * 0xBF58476D1CE4E5B9) & mask
    state = ((state ^ state >> 27) * 0x94D049BB133111EB) & mask
    return state ^ state >> 31


def test_hash_is_chained_splitmix64():
    keys = torch.tensor([0, 1, -5, 2**62])
    for key, got in zip(keys.tolist(), hash_keys(keys, 7).tolist(), strict=True):
        state = 0
        for value in (key, 7):
            state = splitmix(((state + 0x9E3779B97F4A7C15) ^ value) % 2**64)
        assert got % 2**64 == state


def test_draws_depend_on_the_key_alone():
    keys = torch.arange(1000)
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    assert torch.equal(uniform(keys, 3)[order], uniform(keys[order], 3))
    assert hash_keys(keys, 3, 4).unique().numel() == 1000
    assert not torch.equal(hash_keys(keys, 3, 4), hash_keys(keys, 4, 3))


def test_distributions():
    keys = torch.arange(200_000)
    flat, bell = uniform(keys, 1), normal(keys, 1)
    assert flat.min() > 0 and flat.max() < 1
    histogram = torch.histc(flat, bins=20, min=0, max=1)
    assert (histogram - 10_000).abs().max() < 500
    assert abs(bell.mean()) < 0.01 and abs(bell.std() - 1) < 0.01
    assert abs((bell**4).mean() - 3) < 0.1
    assert abs((normal(keys, 2) * bell).mean()) < 0.01
