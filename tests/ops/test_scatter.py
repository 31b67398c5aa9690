# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.scatter import RUN, gather_splats, scatter_splats
from blitzgs.ops.splat_gradients import sum_splats
from tests.helpers import DEVICES

RANKS = 3


def columns(n, dtype=torch.float32):
    g = torch.Generator().manual_seed(0)
    return [
        torch.randn(n, 2, generator=g).to(dtype),
        torch.randn(n, generator=g).to(dtype),
        torch.arange(n, dtype=torch.int32),
        torch.randint(0, 2**62, (n,), generator=g),
        torch.randn(n, 7, generator=g).half(),
        torch.randn(n, 3, 2, generator=g).bfloat16(),
    ]


def destinations(n):
    """Masks and group sizes; rank 1 gets nothing, some splats go to several ranks and some to none."""
    masks = torch.randint(0, 8, (n,), generator=torch.Generator().manual_seed(1)) & 0b101
    return masks, [int(((masks >> m) & 1).sum()) for m in range(RANKS)]


def on(device, tensors):
    return [tensor.to(device) for tensor in tensors]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n", [0, 1, 5, 6000])
def test_splats_reach_their_groups(n, device):
    data, (masks, sizes) = columns(n), destinations(n)
    packed, places = scatter_splats(on(device, data), masks.to(device), sizes)
    assert packed.shape == (13 * sum(sizes),) and places.shape == (-(-n // RUN), RANKS)
    received = gather_splats(packed, data, sizes)
    splats = received[2].cpu().long()  # the column of splat numbers
    begin = 0
    for m, size in enumerate(sizes):
        group = splats[begin : begin + size]
        assert torch.equal(group.sort().values, ((masks >> m) & 1).nonzero().squeeze(1))
        begin += size
    if device == "cpu":
        assert all(torch.equal(part, part.sort().values) for part in splats.split(sizes))
    for got, column in zip(received, data, strict=True):
        assert torch.equal(got.cpu(), column[splats])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n", [0, 1, 5000])
def test_sums_follow_the_splats_back(n, device):
    masks, sizes = destinations(n)
    numbers = torch.arange(n, dtype=torch.int32)
    packed, places = scatter_splats([numbers.to(device)], masks.to(device), sizes)
    splats = packed.cpu().long()
    values = torch.randn(len(splats), 20, generator=torch.Generator().manual_seed(2))
    expected = torch.zeros(n, 20)
    for part, group in zip(values.split(sizes), splats.split(sizes), strict=True):
        expected[group] += part
    got = sum_splats(values.to(device), places, sizes, n, [2, 0, 17, 1])
    assert [part.shape[1] for part in got] == [2, 0, 17, 1]
    assert torch.equal(torch.cat(got, 1).cpu(), expected)


def test_doubles_and_strided_columns():
    wide = torch.randn(4, 9, dtype=torch.float64)
    data = [wide[:, 2:5], wide[:, 0], wide[:1].expand(4, 9)]
    masks = torch.tensor([1, 0, 3, 2])
    packed, places = scatter_splats(data, masks, [2, 2])
    for got, column in zip(gather_splats(packed, data, [2, 2]), data, strict=True):
        assert torch.equal(got, column[[0, 2, 2, 3]])
    values = torch.arange(4, dtype=torch.float64)[:, None]
    assert sum_splats(values, places, [2, 2], 4, [1])[0].squeeze(1).tolist() == [0, 0, 3, 3]


def test_errors_name_the_value():
    masks = torch.ones(4, dtype=torch.int64)
    with pytest.raises(RuntimeError, match=r"a column must have shape \[4, \*\], got \[3, 1\]"):
        scatter_splats([torch.zeros(4), torch.zeros(3)], masks, [4])
    with pytest.raises(RuntimeError, match="at most 8 columns"):
        scatter_splats([torch.zeros(4)] * 9, masks, [4])
    with pytest.raises(RuntimeError, match="group_sizes must have 1 to 63 entries, got 64"):
        scatter_splats([torch.zeros(4)], masks, [0] * 64)
    with pytest.raises(RuntimeError, match=r"packed must have shape \[4\], got \[3\]"):
        gather_splats(torch.zeros(3, dtype=torch.int32), [torch.zeros(1, 2)], [1, 1])
    with pytest.raises(RuntimeError, match=r"values must have shape \[3, 1\], got \[2, 1\]"):
        sum_splats(torch.zeros(2, 1), torch.zeros(1, 2, dtype=torch.int64), [1, 2], 4, [1])
    with pytest.raises(RuntimeError, match=r"places must have shape \[1, 2\], got \[1, 3\]"):
        sum_splats(torch.zeros(3, 1), torch.zeros(1, 3, dtype=torch.int64), [1, 2], 4, [1])


def test_opcheck():
    ops, masks = torch.ops.blitzgs, torch.tensor([2, 0, 3])
    words = [torch.arange(6, dtype=torch.int32).view(3, 2), torch.arange(3, dtype=torch.int32).view(3, 1)]
    torch.library.opcheck(ops.scatter_splats, (words, masks, [1, 2]))
    packed, places = ops.scatter_splats(words, masks, [1, 2])
    torch.library.opcheck(ops.gather_splats, (packed, [2, 1], [1, 2]))
    torch.library.opcheck(ops.sum_splats, (torch.randn(3, 3), places, [1, 2], 3, [2, 1]))
