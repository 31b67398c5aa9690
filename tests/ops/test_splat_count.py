# SPDX-License-Identifier: Apache-2.0
"""Ops take columns with more capacity than splats and read the number of splats on the device."""

import pytest
import torch

from blitzgs.ops.intersect import intersect
from blitzgs.ops.splat_gradients import SPLAT_GRADIENT
from tests.helpers import DEVICES, needs_cuda
from tests.ops.splats import Splats, kept_by, random_splats, with_capacity

WIDTH, HEIGHT = 91, 70
VIEW = (1, WIDTH, HEIGHT, 16)
ops = torch.ops.blitzgs


class Columns:
    """Splats, and the same splats at the start of longer columns."""

    def __init__(self, n, capacity, device, channels=3, cameras=1):
        splats = random_splats(n, WIDTH, HEIGHT, channels=channels, cameras=cameras)
        splats.depths = (splats.depths * 64).round() / 64  # many ties
        self.alone = Splats(*(t.to(device) for t in vars(splats).values()))
        self.padded = Splats(*(with_capacity(t, capacity) for t in vars(self.alone).values()))
        self.ids = torch.randperm(n, generator=torch.Generator().manual_seed(3)).to(device)
        self.padded_ids = with_capacity(self.ids, capacity)
        self.count = torch.tensor([n], device=device)


def empty_room(device, number):
    """Return columns with a capacity of 500 splats, none of them valid, and a given number of splats."""
    return Columns(0, 500, device).padded, torch.tensor([number], device=device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("with_ids", [False, True])
@pytest.mark.parametrize("n", [0, 1, 1024, 8192, 20_000])
def test_lists_ignore_entries_after_the_last_splat(n, with_ids, device):
    columns = Columns(n, 40_000, device, cameras=2)
    ids, padded_ids = (columns.ids, columns.padded_ids) if with_ids else (None, None)
    view = {"n_cameras": 2, "width": WIDTH, "height": HEIGHT}
    expected, offsets = intersect(*columns.alone.geometry(), ids, **view)
    for capacity in (-1, len(expected), len(expected) + 30_000):
        found, found_offsets = intersect(
            *columns.padded.geometry(), padded_ids, **view, n_isects=capacity, n_splats=columns.count
        )
        assert len(found) == (len(expected) if capacity < 0 else capacity)
        assert torch.equal(found_offsets, offsets)
        assert torch.equal(found[: len(expected)], expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("number", [0, -1, 501, 2**62, -(2**63)])
def test_a_number_out_of_range_is_no_splat(number, device):
    splats, count = empty_room(device, number)
    for capacity in (-1, 100):
        entries, offsets = ops.intersect(*splats.geometry(), None, *VIEW, 0, -1, capacity, count)
        assert len(entries) == max(capacity, 0) and not offsets.any()
    background = torch.rand(1, 3, device=device)
    image = ops.rasterize_fwd(*splats.values(), background, entries, offsets, *VIEW, 0, -1, True, True, count)
    assert torch.equal(image[0], background.expand(1, HEIGHT, WIDTH, 3))
    assert (image[1] == 1).all() and not image[2].any() and not image[3].any()


@pytest.mark.parametrize("device", DEVICES)
def test_columns_with_zero_capacity(device):
    columns = Columns(0, 0, device)
    lists = ops.intersect(*columns.padded.geometry(), None, *VIEW, 0, -1, 10, columns.count)
    assert not lists[1].any()
    renders = ops.rasterize_fwd(
        *columns.padded.values(), None, *lists, *VIEW, 0, -1, True, True, columns.count
    )[0]
    assert not renders.any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("channels", "composited", "owned"),
    [(3, (0, -1), (0, -1)), (3, (2, 25), (7, 20)), (3, (0, -1), (4, 30)), (9, (0, -1), (0, -1)),
     (9, (3, 30), (3, 30))],
)  # fmt: skip
@pytest.mark.parametrize("n", [1, 700])
def test_images_and_gradients_ignore_entries_after_the_last_splat(n, channels, composited, owned, device):
    """The backward pass gets columns without spare capacity in both cases."""
    columns = Columns(n, 1500, device, channels)
    lists = ops.intersect(*columns.alone.geometry(), None, *VIEW, *composited, -1)
    plain = ops.rasterize_fwd(*columns.alone.values(), None, *lists, *VIEW, *composited)
    padded = ops.rasterize_fwd(
        *columns.padded.values(), None, *lists, *VIEW, *composited, True, True, columns.count
    )
    for found, expected in zip(padded[:4], plain[:4], strict=True):
        assert torch.equal(found, expected)
    v_renders = torch.randn(plain[0].shape, generator=torch.Generator().manual_seed(1)).to(device)
    gradients = [
        ops.rasterize_bwd(
            columns, None, lists, kept_by(image), v_renders, None, *VIEW, *owned, True, True
        )
        for columns, image in (
            (columns.alone.values(), plain), ([c[:n] for c in columns.padded.values()], padded),
        )
    ]  # fmt: skip
    assert n == 1 or gradients[0][0].any()
    for expected, found in zip(*gradients, strict=True):
        assert torch.equal(found, expected)


@needs_cuda
@pytest.mark.cuda
@pytest.mark.parametrize("tiles", [(0, -1), (3, 9)])
@pytest.mark.parametrize(("n", "capacity"), [(700, 1500), (0, 900), (50_000, 60_000)])
def test_a_table_of_gradients_is_zeroed_for_the_splats(n, capacity, tiles):
    """The table is zeroed even if there are too few tiles to write the zeros."""
    columns = Columns(n, capacity, "cuda")
    memory = torch.full((capacity + 100, SPLAT_GRADIENT), float("nan"), device="cuda")
    table = memory[40 : capacity + 60]
    lists = ops.intersect(*columns.alone.geometry(), None, *VIEW, *tiles, -1)
    plain = ops.rasterize_fwd(*columns.alone.values(), None, *lists, *VIEW, *tiles, False)
    image = ops.rasterize_fwd_(*columns.padded.values(), None, *lists, *VIEW, *tiles, table, columns.count)
    assert (table[:n] == 0).all()
    assert memory[:40].isnan().all() and memory[40 + capacity :].isnan().all()
    v_renders = torch.randn(plain[0].shape, generator=torch.Generator().manual_seed(1)).cuda()
    arguments = ([c[:n] for c in columns.padded.values()], None, lists, kept_by(image), v_renders)
    ops.rasterize_bwd(*arguments, None, *VIEW, *tiles, False, True, table)
    expected = ops.rasterize_bwd(
        columns.alone.values(), None, lists, kept_by(plain), v_renders, None, *VIEW, *tiles, False, True
    )
    assert torch.equal(table[:n, :9], torch.cat([c if c.dim() == 2 else c[:, None] for c in expected[:4]], 1))
    assert memory[:40].isnan().all() and memory[40 + capacity :].isnan().all()


@needs_cuda
@pytest.mark.cuda
@pytest.mark.parametrize("share", [0.999, 0.5, 0.1, 0.0])
@pytest.mark.parametrize("tiles", [(0, -1), (5, 40)])
def test_lists_with_too_little_room_are_the_nearest_splats(share, tiles):
    columns = Columns(20_000, 30_000, "cuda", cameras=2)
    view = [2, *VIEW[1:], *tiles]
    whole, offsets = (t.cpu() for t in ops.intersect(*columns.alone.geometry(), None, *view, -1))
    capacity = int(share * len(whole))
    cut, cut_offsets = (
        t.cpu() for t in ops.intersect(*columns.padded.geometry(), None, *view, capacity, columns.count, True)
    )
    assert len(cut) == capacity == cut_offsets[-1]
    assert (cut_offsets.diff() >= 0).all() and cut_offsets[0] == 0
    for tile in range(len(offsets) - 1):
        found = cut[cut_offsets[tile] : cut_offsets[tile + 1]]
        assert torch.equal(found, whole[offsets[tile] :][: len(found)])
        assert len(found) <= offsets[tile + 1] - offsets[tile]


@pytest.mark.parametrize("device", DEVICES)
def test_lists_with_too_little_room_are_an_error(device):
    columns = Columns(100, 150, device)
    count = len(ops.intersect(*columns.alone.geometry(), None, *VIEW, 0, -1, -1)[0])
    with pytest.raises(RuntimeError, match=f"n_isects is {count - 1} but there are {count}"):
        ops.intersect(*columns.padded.geometry(), None, *VIEW, 0, -1, count - 1, columns.count)


@pytest.mark.parametrize("device", DEVICES)
def test_errors_name_the_value(device):
    columns = Columns(100, 150, device)
    view = {"n_cameras": 1, "width": WIDTH, "height": HEIGHT}
    with pytest.raises(RuntimeError, match="n_splats must be Long, got Int"):
        intersect(*columns.padded.geometry(), **view, n_splats=columns.count.int())
    with pytest.raises(RuntimeError, match=r"n_splats must have shape \[1\], got \[2\]"):
        intersect(*columns.padded.geometry(), **view, n_splats=columns.count.repeat(2))
    lists = intersect(*columns.alone.geometry(), **view)
    image = ops.rasterize_fwd(*columns.alone.values(), None, *lists, *VIEW, 0, -1)
    arguments = (columns.padded.values(), None, lists, kept_by(image), image[0], None, *VIEW, 0, -1)
    with pytest.raises(RuntimeError, match="for 150 splats and 30 tiles or more, got 100 and 30"):
        ops.rasterize_bwd(*arguments, False, True)
    if device == "cuda":
        with pytest.raises(RuntimeError, match="n_splats must be on the device of the splats"):
            intersect(*columns.padded.geometry(), **view, n_splats=columns.count.cpu())
        with pytest.raises(RuntimeError, match="gradients must have 150 splats or more, got 149"):
            ops.rasterize_fwd_(
                *columns.padded.values(),
                None,
                *lists,
                *VIEW,
                0,
                -1,
                torch.zeros(149, SPLAT_GRADIENT, device=device),
            )


@pytest.mark.parametrize("device", DEVICES)
def test_opcheck(device):
    columns = Columns(20, 30, device)
    arguments = (*columns.padded.geometry(), None, *VIEW, 0, -1)
    torch.library.opcheck(ops.intersect, (*arguments, -1, columns.count))
    lists = ops.intersect(*columns.alone.geometry(), None, *VIEW, 0, -1, -1)
    torch.library.opcheck(ops.intersect, (*arguments, len(lists[0]), columns.count))
    values = [t.requires_grad_() for t in columns.padded.values()]
    torch.library.opcheck(
        ops.rasterize_fwd,
        (*values, None, *lists, *VIEW, 0, -1, True, False, columns.count),
        # Not those that compare the memory between forward and backward, which is not all written.
        test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
    )
