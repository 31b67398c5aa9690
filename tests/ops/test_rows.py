# SPDX-License-Identifier: Apache-2.0
"""Rows of columns: placed, chosen, summed, sent to groups, and searched for what is not finite."""

import pytest
import torch

from blitzgs.call.layout import Places
from blitzgs.ops.derivatives import KeptMarks, distinct_rows, sparse_rows
from blitzgs.ops.exchange import PLACE_SPLATS, gather_splats, scatter_splats
from blitzgs.ops.projection_types import first_rows
from tests.helpers import refused

COLUMNS = [((2,), torch.float32), ((3,), torch.float64), ((), torch.int64), ((), torch.float32)]


def places_of(device, ordered, scenes=2, views=3, gaussians=301, splats=700):
    """An order of splats, or splats that some of the entries of all Gaussians have."""
    g = torch.Generator().manual_seed(splats)
    if ordered:
        return Places((torch.randperm(splats, generator=g).to(device),), (splats,))
    chosen = torch.randperm(scenes * views * gaussians, generator=g)[:splats].to(device)
    index = ((chosen // gaussians).int(), (chosen % gaussians).int())
    return Places(index, (scenes, views, gaussians))


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("splats", [700, 1, 0])
def test_columns_are_at_their_places_and_come_back(device, ordered, splats):
    places = places_of(device, ordered, splats=splats)
    columns = [
        torch.arange(splats * max(1, sum(shape)), device=device).view(splats, *shape).to(dtype) + 1
        for shape, dtype in COLUMNS
    ]
    flat, arranged = places.flat(), places.arrange(columns)
    for column, got in zip(columns, arranged, strict=True):
        wanted = column.new_zeros(*places.shape, *column.shape[1:])
        wanted.view(-1, *column.shape[1:])[flat] = column
        assert got.dtype == column.dtype and torch.equal(got, wanted)
    assert all(map(torch.equal, places.gather(arranged), columns))
    strided = [t.transpose(0, -1).contiguous().transpose(0, -1) for t in arranged]
    assert all(map(torch.equal, places.gather(strided), columns))


@pytest.mark.parametrize("ordered", [True, False])
def test_columns_of_a_table_and_repeated_rows(device, ordered):
    places = places_of(device, ordered)
    table = torch.randn(700, 12, device=device)
    columns = [table[:, :2], table[:, 5], table[:1].expand(700, 12), table[0, 0].expand(700)]
    copies = [column.clone(memory_format=torch.contiguous_format) for column in columns]
    assert all(map(torch.equal, places.arrange(columns), places.arrange(copies)))


def test_entries_without_a_splat_have_the_values_of_their_gaussians(device):
    places = places_of(device, ordered=False)
    under, column = torch.randn(2, 301, device=device), torch.randn(700, device=device)
    first, got = places.arrange([column, column], under)
    wanted = under[:, None].expand(places.shape).clone()
    wanted.view(-1)[places.flat()] = column
    assert torch.equal(got, wanted) and (first == 0).sum() == first.numel() - 700


@pytest.mark.parametrize("ordered", [True, False])
def test_derivatives_of_both_orders(ordered):
    places = places_of("cpu", ordered, gaussians=5, splats=9)
    column, arranged = torch.randn(9, 2).double(), torch.randn(*places.shape, 2).double()
    under = None if ordered else torch.randn(2, 5).double().requires_grad_()
    opacities = torch.randn(9).double()
    inputs = [t.requires_grad_() for t in (column, opacities, arranged)]

    def both(column, opacities, arranged, under=None):
        # Squares, so that the second derivatives are not zero.
        found = (*places.arrange([column, opacities], under), *places.gather([arranged]))
        return tuple(t * t for t in found)

    given = (*inputs, *([] if under is None else [under]))
    assert torch.autograd.gradcheck(both, given)
    assert torch.autograd.gradgradcheck(both, given)


def test_arrange_splats_errors_name_the_value():
    places = places_of("cpu", ordered=True, splats=4)
    refused(RuntimeError, r"columns must have 4 rows, got \[3\]", places.arrange, [torch.zeros(3)])
    refused(RuntimeError, r"dimensions of the arrangement, got \[3\]", places.gather, [torch.zeros(3)])
    refused(RuntimeError, "of 4 or 8 bytes, got Half", places.arrange, [torch.zeros(4, dtype=torch.float16)])
    refused(RuntimeError, "under.* last column of numbers", places.arrange, [torch.zeros(4)], torch.zeros(4))
    with pytest.raises(RuntimeError, match="5 entries cannot be an order of 4 splats"):
        places._replace(shape=(5,)).arrange([torch.zeros(4)])
    with pytest.raises(RuntimeError, match=r"under must have 602 values, got \[301\]"):
        places_of("cpu", ordered=False).arrange([torch.zeros(700)], torch.zeros(301))


def test_arrange_splats_opcheck():
    places = places_of("cpu", ordered=False)
    columns, under = [torch.randn(700, 2), torch.randn(700)], torch.randn(2, 301)
    arguments = columns, list(places.indices), list(places.shape)
    torch.library.opcheck(torch.ops.blitzgs.arrange_splats, (*arguments, under))
    arranged = list(places.arrange(columns))
    torch.library.opcheck(torch.ops.blitzgs.splats_of_arranged, (arranged, *arguments[1:]))


def test_first_rows_share_their_memory(device):
    columns = [torch.randn(9, 3, device=device), torch.arange(12, device=device)[3:]]
    for found, column, count in zip(first_rows(columns, [4, 20]), columns, [4, 20], strict=True):
        assert torch.equal(found, column[:count]) and found.data_ptr() == column.data_ptr()
        assert found._base is None


def test_first_rows_errors_name_the_value():
    refused(RuntimeError, "first_rows: 1 columns need .* got 2", first_rows, [torch.zeros(4, 3)], [1, 2])


class Rows(torch.autograd.Function):
    """Some rows of a table; the gradient is sparse."""

    @staticmethod
    def forward(ctx, table, ids):
        ctx.shape, ctx.ids = table.shape, ids
        return table[ids]

    @staticmethod
    def backward(ctx, v_rows):
        return sparse_rows(ctx.ids.long()[None], v_rows, ctx.shape), None


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_a_gradient_that_autograd_hands_on_is_not_sorted(device, dtype):
    table, marks = torch.randn(9, 3, device=device, requires_grad=True), KeptMarks()
    marks.of(table)
    ids = torch.tensor([1, 4, 7], dtype=dtype, device=device)
    (Rows.apply(table, ids) * torch.arange(3.0, device=device)).sum().backward()
    rows, values = distinct_rows(table.grad)
    assert values.data_ptr() == table.grad._values().data_ptr()  # sorting would copy them
    assert torch.equal(rows[0], ids.long())
    assert torch.equal(values, torch.arange(3.0, device=device).expand(3, 3))


def test_sums_of_gradients_are_summed(device):
    table = torch.zeros(9, 3, device=device, requires_grad=True)
    for ids in ([1, 4, 7], [4, 8]):
        Rows.apply(table, torch.tensor(ids, device=device)).sum().backward()
    rows, values = distinct_rows(table.grad)
    assert rows[0].tolist() == [1, 4, 7, 8]
    assert values[:, 0].tolist() == [1, 2, 1, 1]


def test_foreign_sparse_tensors_are_coalesced():
    kept = sparse_rows(torch.tensor([[0, 1]]), torch.ones(2, 1), torch.Size([3, 1]))
    doubled = torch.sparse_coo_tensor(torch.tensor([[2, 2]]), torch.ones(2, 1), (3, 1))
    rows, values = distinct_rows(doubled)
    assert rows[0].tolist() == [2] and values.tolist() == [[2]]
    assert distinct_rows(kept)[0].tolist() == [[0, 1]]


RANKS = 3
sum_splats = torch.ops.blitzgs.sum_splats


def columns(n, dtype=torch.float32):
    g = torch.Generator().manual_seed(0)
    return [
        torch.randn(n, 2, generator=g).to(dtype), torch.randn(n, generator=g).to(dtype),
        torch.arange(n, dtype=torch.int32), torch.randint(0, 2**62, (n,), generator=g),
        torch.randn(n, 3, 2, generator=g).to(dtype),
    ]  # fmt: skip


def destinations(n):
    """Masks and group sizes; rank 1 gets nothing, some splats go to several ranks and some to none."""
    masks = torch.randint(0, 8, (n,), generator=torch.Generator().manual_seed(1)) & 0b101
    return masks, [int(((masks >> m) & 1).sum()) for m in range(RANKS)]


def on(device, tensors):
    return [tensor.to(device) for tensor in tensors]


@pytest.mark.parametrize("n", [0, 1, 5, 6000])
def test_splats_reach_their_groups(n, device):
    data, (masks, sizes) = columns(n), destinations(n)
    packed, places = scatter_splats(on(device, data), masks.to(device), sizes)
    assert packed.shape == (12 * sum(sizes),) and places.shape == (-(-n // PLACE_SPLATS), RANKS)
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


@pytest.mark.parametrize("n", [0, 1, 5000])
@pytest.mark.parametrize("widths", [[2, 0, 17, 1], [12]])  # 12: on CUDA read by whole rows, as from peers
def test_sums_follow_the_splats_back(n, widths, device):
    masks, sizes = destinations(n)
    numbers = torch.arange(n, dtype=torch.int32)
    packed, places = scatter_splats([numbers.to(device)], masks.to(device), sizes)
    splats = packed.cpu().long()
    values = torch.randn(len(splats), sum(widths), generator=torch.Generator().manual_seed(2))
    expected = torch.zeros(n, sum(widths))
    for part, group in zip(values.split(sizes), splats.split(sizes), strict=True):
        expected[group] += part
    got = sum_splats(values.to(device).split(sizes), places, n, widths)
    assert [part.shape[1] for part in got] == widths
    assert torch.equal(torch.cat(got, 1).cpu(), expected)


def test_doubles_and_strided_columns_are_scattered():
    wide = torch.randn(4, 9, dtype=torch.float64)
    data = [wide[:, 2:5], wide[:, 0], wide[:1].expand(4, 9)]
    masks = torch.tensor([1, 0, 3, 2])
    packed, places = scatter_splats(data, masks, [2, 2])
    for got, column in zip(gather_splats(packed, data, [2, 2]), data, strict=True):
        assert torch.equal(got, column[[0, 2, 2, 3]])
    values = torch.arange(4, dtype=torch.float64)[:, None]
    assert sum_splats(values.split(2), places, 4, [1])[0].squeeze(1).tolist() == [0, 0, 3, 3]


def test_scatter_errors_name_the_value():
    masks = torch.ones(4, dtype=torch.int64)
    with pytest.raises(RuntimeError, match=r"a column must have shape \[4, \*\], got \[3, 1\]"):
        scatter_splats([torch.zeros(4), torch.zeros(3)], masks, [4])
    refused(RuntimeError, "at most 8 columns", scatter_splats, [torch.zeros(4)] * 9, masks, [4])
    refused(RuntimeError, "group_.* 1 to 63 .*, got 64", scatter_splats, [torch.zeros(4)], masks, [0] * 64)
    with pytest.raises(RuntimeError, match=r"packed must have shape \[4\], got \[3\]"):
        gather_splats(torch.zeros(3, dtype=torch.int32), [torch.zeros(1, 2)], [1, 1])
    places = torch.zeros(1, 2, dtype=torch.int64)
    with pytest.raises(RuntimeError, match=r"values of a rank must have shape \[\*, 2\], got \[2, 1\]"):
        sum_splats([torch.zeros(2, 1), torch.zeros(2, 2)], places, 4, [1, 1])
    with pytest.raises(RuntimeError, match=r"places must have shape \[1, 1\], got \[1, 2\]"):
        sum_splats([torch.zeros(3, 1)], places, 4, [1])
    refused(RuntimeError, "values must have 1 to 63 entries, got 0", sum_splats, [], places, 4, [1])


def test_scatter_opcheck():
    ops, masks = torch.ops.blitzgs, torch.tensor([2, 0, 3])
    words = [torch.arange(6, dtype=torch.int32).view(3, 2), torch.arange(3, dtype=torch.int32).view(3, 1)]
    torch.library.opcheck(ops.scatter_splats, (words, masks, [1, 2]))
    packed, places = ops.scatter_splats(words, masks, [1, 2])
    torch.library.opcheck(ops.gather_splats, (packed, [2, 1], [1, 2]))
    torch.library.opcheck(ops.sum_splats, (torch.randn(3, 3).split([1, 2]), places, 3, [2, 1]))


find_non_finite = torch.ops.blitzgs.find_non_finite


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_each_value_of_each_column_is_looked_at(backend, value):
    device, dtype = backend
    # 20 columns take two launches; a value of 1e38 squares to infinity, but is finite.
    columns = [torch.full((n, 3), 1e38, dtype=dtype, device=device) for n in (0, 1, 7, 300_000, *[5] * 16)]
    opacities = torch.full((9,), 1e-45, device=device, dtype=dtype)
    assert not find_non_finite(columns, [opacities])
    for column in columns[1:]:
        column[-1, 2] = value
        assert find_non_finite(columns, [opacities]) and not find_non_finite([columns[0]], [])
        column[-1, 2] = 0.0
    assert not find_non_finite(columns, [opacities])
    opacities[8] = -0.0
    assert find_non_finite(columns, [opacities]) and find_non_finite(columns, [opacities[8:]])


def test_columns_that_are_searched_need_not_be_contiguous():
    column = torch.ones(4, 6).T
    column[5, 3] = torch.nan
    assert find_non_finite([column], []) and not find_non_finite([column[:5]], [])


def test_find_non_finite_errors_name_the_value():
    with pytest.raises(RuntimeError, match="find_non_finite: a column must be Float, got Double"):
        find_non_finite([torch.ones(2)], [torch.ones(2, dtype=torch.float64)])
    with pytest.raises(RuntimeError, match="find_non_finite: there must be columns"):
        torch.ops.blitzgs.find_non_finite([], [torch.ones(2)])
