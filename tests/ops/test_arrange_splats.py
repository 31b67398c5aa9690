# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.arrange_splats import Places
from tests.helpers import DEVICES

COLUMNS = [((2,), torch.float32), ((3,), torch.float64), ((), torch.int64), ((), torch.float32)]


def places_of(device, ordered, scenes=2, views=3, gaussians=301, splats=700):
    """An order of splats, or splats that some of the entries of all Gaussians have."""
    g = torch.Generator().manual_seed(splats)
    if ordered:
        return Places((torch.randperm(splats, generator=g).to(device),), (splats,))
    chosen = torch.randperm(scenes * views * gaussians, generator=g)[:splats].to(device)
    index = ((chosen // gaussians).int(), (chosen % gaussians).int())
    return Places(index, (scenes, views, gaussians))


@pytest.mark.parametrize("device", DEVICES)
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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("ordered", [True, False])
def test_columns_of_a_table_and_repeated_rows(device, ordered):
    places = places_of(device, ordered)
    table = torch.randn(700, 12, device=device)
    columns = [table[:, :2], table[:, 5], table[:1].expand(700, 12), table[0, 0].expand(700)]
    copies = [column.clone(memory_format=torch.contiguous_format) for column in columns]
    assert all(map(torch.equal, places.arrange(columns), places.arrange(copies)))


@pytest.mark.parametrize("device", DEVICES)
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


def test_errors_name_the_value():
    places = places_of("cpu", ordered=True, splats=4)
    with pytest.raises(RuntimeError, match=r"columns must have 4 rows, got \[3\]"):
        places.arrange([torch.zeros(3)])
    with pytest.raises(RuntimeError, match=r"dimensions of the arrangement, got \[3\]"):
        places.gather([torch.zeros(3)])
    with pytest.raises(RuntimeError, match="elements of 4 or 8 bytes, got Half"):
        places.arrange([torch.zeros(4, dtype=torch.float16)])
    with pytest.raises(RuntimeError, match="`under` is for a last column of numbers"):
        places.arrange([torch.zeros(4)], torch.zeros(4))
    with pytest.raises(RuntimeError, match="5 entries cannot be an order of 4 splats"):
        places._replace(shape=(5,)).arrange([torch.zeros(4)])
    with pytest.raises(RuntimeError, match=r"under must have 602 values, got \[301\]"):
        places_of("cpu", ordered=False).arrange([torch.zeros(700)], torch.zeros(301))


def test_opcheck():
    places = places_of("cpu", ordered=False)
    columns, under = [torch.randn(700, 2), torch.randn(700)], torch.randn(2, 301)
    arguments = columns, list(places.indices), list(places.shape)
    torch.library.opcheck(torch.ops.blitzgs.arrange_splats, (*arguments, under))
    arranged = list(places.arrange(columns))
    torch.library.opcheck(torch.ops.blitzgs.splats_of_arranged, (arranged, *arguments[1:]))
