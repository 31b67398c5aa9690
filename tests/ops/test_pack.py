# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.pack import add_rows, pack_rows, unpack_rows


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [0, 1, 5, 6000])
def test_rows_survive_the_round_trip(n, dtype):
    data = columns(n, dtype)
    rows = torch.randperm(n).int()[: n // 2 + n % 2]
    packed = pack_rows(data, rows)
    assert packed.shape == (len(rows), {4: 13, 8: 16}[dtype.itemsize])
    for got, column in zip(unpack_rows(packed, data), data, strict=True):
        assert torch.equal(got, column[rows])


def test_strided_columns_and_single_rows():
    wide = torch.randn(4, 9)
    data = [wide[:, 2:5], wide[:, 0], wide[:1].expand(4, 9)]
    for rows in (torch.tensor([3, 3, 0]), torch.tensor([2])):
        for got, column in zip(unpack_rows(pack_rows(data, rows.int()), data), data, strict=True):
            assert torch.equal(got, column[rows])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_add_rows_adds_in_the_order_of_the_groups(dtype):
    rows = [
        torch.tensor([0, 2, 5]),
        torch.tensor([], dtype=torch.int64),
        torch.tensor([2, 3]),
        torch.arange(6),
    ]
    values = [torch.randn(len(group), 3, dtype=dtype) for group in rows]
    expected = torch.zeros(7, 3, dtype=dtype)
    for group, value in zip(rows, values, strict=True):
        expected[group] += value
    got = add_rows(torch.cat(values), torch.cat(rows).int(), [3, 0, 2, 6], 7)
    assert torch.equal(got, expected)
    assert add_rows(torch.empty(0, 3), torch.empty(0, dtype=torch.int32), [0], 0).shape == (0, 3)


def test_errors():
    with pytest.raises(RuntimeError, match=r"a column must have shape \[4, \*\], got \[3, 1\]"):
        pack_rows([torch.zeros(4), torch.zeros(3)], torch.zeros(1, dtype=torch.int32))
    with pytest.raises(RuntimeError, match="at most 16 columns"):
        pack_rows([torch.zeros(4)] * 17, torch.zeros(1, dtype=torch.int32))
    with pytest.raises(RuntimeError, match=r"packed must have shape \[\*, 2\], got \[1, 1\]"):
        unpack_rows(torch.zeros(1, 1, dtype=torch.int32), [torch.zeros(1, 2)])
    with pytest.raises(RuntimeError, match="adds up to 3, but there are 2 rows"):
        add_rows(torch.zeros(2, 1), torch.zeros(2, dtype=torch.int32), [1, 2], 4)


def test_opcheck():
    ops, rows = torch.ops.blitzgs, torch.tensor([2, 0], dtype=torch.int32)
    words = [torch.arange(6, dtype=torch.int32).view(3, 2), torch.arange(3, dtype=torch.int32).view(3, 1)]
    torch.library.opcheck(ops.pack_rows, (words, rows))
    torch.library.opcheck(ops.unpack_rows, (ops.pack_rows(words, rows), [2, 1]))
    torch.library.opcheck(ops.add_rows, (torch.randn(2, 3), rows, [1, 1], 3))
