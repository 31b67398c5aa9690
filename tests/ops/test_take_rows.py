# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.take_rows import take_rows
from tests.helpers import DEVICES

COLUMNS = [
    ((), torch.float32), ((3,), torch.float32), ((4,), torch.float32), ((16, 3), torch.float32),
    ((), torch.int64), ((3,), torch.float64), ((), torch.uint8), ((5,), torch.bool), ((3,), torch.float16),
    ((0,), torch.float32),
]  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("shape", "dtype"), COLUMNS, ids=str)
@pytest.mark.parametrize(("count", "added", "taken"), [(700, 90, 600), (0, 5, 3), (257, 0, 257), (9, 3, 0)])
def test_equals_index_select(device, shape, dtype, count, added, taken):
    g = torch.Generator().manual_seed(count)
    old, fresh = (torch.randint(0, 200, (n, *shape), generator=g).to(device, dtype) for n in (count, added))
    rows = torch.randperm(count + added, generator=g)[:taken].to(device)
    got = take_rows(old, rows, fresh)
    assert got.dtype == dtype and torch.equal(got, torch.cat((old, fresh)).index_select(0, rows))
    zeros = torch.cat((old, torch.zeros_like(fresh)))
    assert torch.equal(take_rows(old, rows), zeros.index_select(0, rows))


@pytest.mark.parametrize("device", DEVICES)
def test_bits_and_unaligned_columns(device):
    numbers = torch.arange(4 * 21, dtype=torch.int32, device=device)
    numbers[::5] = 0x7FC12345  # a NaN with a payload, as float32
    column = numbers.view(torch.float32)[3:-1].view(20, 4)
    rows = torch.tensor([7, 0, 19, 7], device=device)
    got = take_rows(column, rows).view(torch.int32)
    assert torch.equal(got, numbers[3:-1].view(20, 4)[rows])
    assert torch.equal(take_rows(column[:, 1], rows).isnan(), column[:, 1][rows].isnan())


def test_errors_name_the_value():
    rows = torch.tensor([0])
    with pytest.raises(RuntimeError, match="column must have rows"):
        take_rows(torch.tensor(1.0), rows)
    with pytest.raises(RuntimeError, match="rows must be Long, got Int"):
        take_rows(torch.zeros(3), rows.int())
    with pytest.raises(RuntimeError, match=r"like those of column, got \[1, 2\] for \[3, 4\]"):
        take_rows(torch.zeros(3, 4), rows, torch.zeros(1, 2))
    with pytest.raises(RuntimeError, match="fresh must be Float, got Double"):
        take_rows(torch.zeros(3), rows, torch.zeros(1, dtype=torch.float64))


def test_opcheck():
    rows = torch.tensor([3, 1])
    torch.library.opcheck(torch.ops.blitzgs.take_rows, (torch.randn(3, 2), rows, torch.randn(1, 2)))
    torch.library.opcheck(torch.ops.blitzgs.take_rows, (torch.randn(3, 2), rows, None))
