# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.counter_random import KEY_BITS, key_histogram, key_of_bits, sampling_keys, uniform
from tests.helpers import DEVICES


@pytest.mark.parametrize("device", DEVICES)
def test_keys_match_the_formula(device):
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(3000, generator=g) * 1e9
    weights[::7] = 0
    ids = torch.randint(0, 2**62, (3000,), generator=g)
    keys = sampling_keys(weights.to(device), ids.to(device), 5, -17).cpu()
    expected = (-uniform(5, -17, ids).log() / weights.double()).float()
    torch.testing.assert_close(keys, expected, rtol=1e-7, atol=0)
    assert keys[::7].isinf().all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 700, 100_000])
def test_digits_of_keys_are_counted_under_a_prefix(device, count):
    g = torch.Generator().manual_seed(count)
    keys = torch.randn(count, generator=g) * torch.randn(count, generator=g).exp()
    keys[::9], keys[1::9], keys[2::9] = torch.inf, 0.0, -0.0
    values, shift = keys.double().tolist(), KEY_BITS - 11
    bits = [int(torch.tensor(abs(v)).float().view(torch.int32)) for v in values]
    ordered = torch.tensor(
        [2**31 + b if v >= 0 else 2**31 - 1 - b for v, b in zip(values, bits, strict=True)]
    )
    assert torch.equal(key_of_bits(ordered.long()), keys.abs().where(keys == 0, keys))
    keys = keys.to(device)
    first = key_histogram(keys, torch.zeros(1, dtype=torch.int64, device=device), shift, 11)
    assert torch.equal(first.cpu(), torch.bincount(ordered.long() >> shift, minlength=2048))
    for prefix in (2**10, 2**11 - 1, 2**10 + 511) if count else ():
        under = ordered[ordered >> shift == prefix]
        second = key_histogram(keys, torch.tensor([prefix], device=device), shift - 10, 10)
        assert torch.equal(second.cpu(), torch.bincount(under >> shift - 10 & 1023, minlength=1024))


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match=r"ids must have shape \[3\], got \[2\]"):
        sampling_keys(torch.ones(3), torch.arange(2), 0, 0)
    with pytest.raises(RuntimeError, match="a digit must have 1 to 11 of 32 bits, got 12 after 20"):
        key_histogram(torch.ones(3), torch.zeros(1, dtype=torch.int64), 20, 12)


def test_opcheck():
    torch.library.opcheck(torch.ops.blitzgs.sampling_keys, (torch.rand(9), torch.arange(9), 1, 2))
    prefix = torch.zeros(1, dtype=torch.int64)
    torch.library.opcheck(torch.ops.blitzgs.key_histogram, (torch.rand(9), prefix, 21, 11))
