# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.rows import put_rows_, take_rows
from tests.helpers import DEVICES

COLUMNS = [
    ((), torch.float32), ((3,), torch.float32), ((4,), torch.float32), ((16, 3), torch.float32),
    ((), torch.int64), ((3,), torch.float64), ((), torch.uint8), ((5,), torch.bool), ((3,), torch.float16),
    ((0,), torch.float32),
]  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("shape", "dtype"), COLUMNS, ids=str)
@pytest.mark.parametrize(("count", "taken"), [(700, 600), (257, 257), (9, 0)])
def test_equals_torch_s_indexing(device, shape, dtype, count, taken):
    g = torch.Generator().manual_seed(count)
    old, fresh = (torch.randint(0, 200, (n, *shape), generator=g).to(device, dtype) for n in (count, taken))
    rows = torch.randperm(count, generator=g)[:taken].to(device)
    got = take_rows(old, rows)
    assert got.dtype == dtype and torch.equal(got, old.index_select(0, rows))
    longer = torch.cat((got, got[:1]))
    assert take_rows(old, rows.flip(0), longer[:taken]).data_ptr() == longer.data_ptr()
    assert torch.equal(longer[:taken], got.flip(0)) and torch.equal(longer[taken:], got[:1])
    for new in (fresh, None):
        expected, changed = old.clone(), old.clone()
        expected[rows] = torch.zeros_like(fresh) if new is None else new
        put_rows_(changed, rows, new)
        assert torch.equal(changed, expected)


@pytest.mark.parametrize("device", DEVICES)
def test_bits_and_unaligned_columns(device):
    numbers = torch.arange(4 * 21, dtype=torch.int32, device=device)
    numbers[::5] = 0x7FC12345  # a NaN with a payload, as float32
    column = numbers.view(torch.float32)[3:-1].view(20, 4)
    rows = torch.tensor([7, 0, 19, 7], device=device)
    got = take_rows(column, rows)
    assert torch.equal(got.view(torch.int32), numbers[3:-1].view(20, 4)[rows])
    assert torch.equal(take_rows(column[:, 1], rows).isnan(), column[:, 1][rows].isnan())
    others = torch.tensor([8, 1, 18], device=device)
    put_rows_(column, others, got[:3])
    assert torch.equal(numbers[3:-1].view(20, 4)[others], got[:3].view(torch.int32))


def test_errors_name_the_value():
    rows = torch.tensor([0])
    with pytest.raises(RuntimeError, match="column must have rows"):
        take_rows(torch.tensor(1.0), rows, torch.zeros(1))
    with pytest.raises(RuntimeError, match="rows must be Long, got Int"):
        take_rows(torch.zeros(3), rows.int())
    with pytest.raises(RuntimeError, match=r"out must have 1 rows, got \[2\]"):
        take_rows(torch.zeros(3), rows, torch.zeros(2))
    with pytest.raises(RuntimeError, match=r"rows of fresh must be like those of column, got \[1, 2\]"):
        put_rows_(torch.zeros(3, 4), rows, torch.zeros(1, 2))
    with pytest.raises(RuntimeError, match="fresh must be Float, got Double"):
        put_rows_(torch.zeros(3), rows, torch.zeros(1, dtype=torch.float64))
    with pytest.raises(RuntimeError, match=r"fresh must have 1 rows, got \[2\]"):
        put_rows_(torch.zeros(3), rows, torch.zeros(2))


def test_opcheck():
    rows, column = torch.tensor([3, 1]), torch.randn(5, 2)
    torch.library.opcheck(torch.ops.blitzgs.take_rows_, (torch.zeros(2, 2), column, rows))
    torch.library.opcheck(torch.ops.blitzgs.put_rows_, (column, rows, torch.randn(2, 2)))
    torch.library.opcheck(torch.ops.blitzgs.put_rows_, (column, rows, None))
