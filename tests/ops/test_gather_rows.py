# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.gather_rows import gather_rows, split_rows
from blitzgs.ops.projection_types import first_rows
from tests.helpers import DEVICES


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int32, torch.int64])
@pytest.mark.parametrize(("count", "taken"), [(700, 600), (9, 300), (5, 0)])
def test_equals_index_select(device, dtype, count, taken):
    g = torch.Generator().manual_seed(count)
    columns, joined = (
        [torch.randint(0, 1000, (count, *shape), generator=g).to(device, dtype) for shape in shapes]
        for shapes in ([(3,), (4,), (), (0,)], [(1, 3), (15, 3), (0, 3)])
    )
    ids = torch.randint(0, count, (taken,), generator=g, dtype=torch.int32).to(device)
    *rows, beside = gather_rows(columns, joined, ids)
    for found, column in zip(rows, columns, strict=True):
        assert found.dtype == dtype and torch.equal(found, column.index_select(0, ids))
    assert torch.equal(beside, torch.cat(joined, dim=1).index_select(0, ids))
    assert len(gather_rows(columns, [], ids)) == len(columns) and gather_rows([], [], ids) == []


@pytest.mark.parametrize("device", DEVICES)
def test_bits_and_columns_that_are_not_contiguous(device):
    numbers = torch.arange(60, dtype=torch.int32, device=device)
    numbers[::5] = 0x7FC12345  # a NaN with a payload, as float32
    column = numbers.view(torch.float32).view(3, 20).T
    ids = torch.tensor([7, 0, 19, 7], dtype=torch.int32, device=device)
    (rows,) = gather_rows([column], [], ids)
    assert torch.equal(rows.view(torch.int32), column.contiguous().view(torch.int32)[ids])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lengths", [(1, 15), (16,), (0, 3, 13)])
@pytest.mark.parametrize("count", [0, 1, 700])
def test_parts_of_rows_are_those_of_split(device, dtype, lengths, count):
    rows = torch.randn(count, 16, 3, dtype=dtype, device=device)
    for part, expected in zip(split_rows(rows, lengths), rows.split(lengths, dim=1), strict=True):
        assert torch.equal(part, expected) and part.is_contiguous()


@pytest.mark.parametrize("device", DEVICES)
def test_first_rows_share_their_memory(device):
    columns = [torch.randn(9, 3, device=device), torch.arange(12, device=device)[3:]]
    for found, column, count in zip(first_rows(columns, [4, 20]), columns, [4, 20], strict=True):
        assert torch.equal(found, column[:count]) and found.data_ptr() == column.data_ptr()
        assert found._base is None


def test_errors_name_the_value():
    ids, column = torch.tensor([0], dtype=torch.int32), torch.zeros(4, 3)
    with pytest.raises(RuntimeError, match="ids must be Int, got Long"):
        gather_rows([column], [], ids.long())
    with pytest.raises(RuntimeError, match="elements of 4 or 8 bytes, got .* of 2 bytes"):
        gather_rows([column.half()], [], ids)
    with pytest.raises(RuntimeError, match=r"alike behind their second dimension, got \[4, 2\] beside"):
        gather_rows([], [column[:, :, None], column[:, :2]], ids)
    for lengths in ([1, 1], [4], [-1, 4]):
        with pytest.raises(RuntimeError, match="split_rows: lengths must add up to 3"):
            split_rows(column, lengths)
    with pytest.raises(RuntimeError, match="first_rows: 1 columns need a length each, got 2"):
        first_rows([column], [1, 2])
    with pytest.raises(RuntimeError, match="at most 8 columns, got 9"):
        gather_rows([column] * 9, [], ids)
