# SPDX-License-Identifier: Apache-2.0
"""Lists of tiles; ops with room for more splats read the number of splats on the device."""

import pytest
import torch

from blitzgs.ops.intersect import intersect, tile_counts
from blitzgs.ops.rasterize import SPLAT_GRADIENT
from tests.helpers import on_threads, refused
from tests.ops.splats import Splats, kept_by, pixel_alphas, random_splats, with_capacity

WIDTH, HEIGHT = 91, 70
GRID = {"n_cameras": 1, "width": WIDTH, "height": HEIGHT}


def listed(splats, width, height, tile_size, **options):
    """The lists as sets: bool [P, tiles]."""
    n_cameras = options.pop("n_cameras", 1)
    entries, offsets = intersect(
        *splats.geometry(), n_cameras=n_cameras, width=width, height=height, tile_size=tile_size, **options
    )
    tiles = torch.repeat_interleave(torch.arange(len(offsets) - 1), offsets.diff())
    result = torch.zeros(len(splats.depths), len(offsets) - 1, dtype=torch.bool)
    result[entries[: offsets[-1]].long(), tiles] = True
    assert int(result.sum()) == int(offsets[-1])  # no splat twice in a tile
    return result


def by_tile(pixels, tile_size, reduce):
    """Reduce [P, H, W] over the pixels of each tile to [P, tiles]."""
    count, height, width = pixels.shape
    tiles_x, tiles_y = tile_counts(width, height, tile_size)
    rows = torch.arange(height) // tile_size * tiles_x
    tiles = (rows[:, None] + torch.arange(width) // tile_size).flatten().expand(count, -1)
    start = torch.zeros(count, tiles_x * tiles_y, dtype=pixels.dtype)
    return start.scatter_reduce(1, tiles, pixels.flatten(1), reduce)


def extreme_splats(dtype):
    """Tiny, huge, thin, faint and far-off splats, among ordinary ones."""
    parts = [
        random_splats(300, WIDTH, HEIGHT, seed=1),
        random_splats(150, WIDTH, HEIGHT, smallest=1e-8, largest=1e-2, seed=2),
        random_splats(150, WIDTH, HEIGHT, smallest=30, largest=1e5, seed=3),
        random_splats(300, WIDTH, HEIGHT, smallest=0.5, largest=600, seed=4),
        random_splats(150, WIDTH, HEIGHT, opacity=(1 / 255 * 0.99, 1 / 255 * 1.05), seed=5),
        random_splats(150, 40 * WIDTH, 40 * HEIGHT, smallest=5, largest=900, seed=6),
    ]
    joined = (torch.cat(column) for column in zip(*(vars(p).values() for p in parts), strict=True))
    return Splats(*joined).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tile_size", [4, 16, 23])
def test_lists_every_tile_with_a_visible_pixel(dtype, tile_size):
    splats = extreme_splats(dtype)
    alphas = pixel_alphas(*(t.double() for t in splats.values()[:3]), WIDTH, HEIGHT)
    needed = by_tile(alphas, tile_size, "amax") >= 1 / 255
    found = listed(splats, WIDTH, HEIGHT, tile_size)
    assert needed.sum() > 1000
    assert not (needed & ~found).any()


@pytest.mark.parametrize("tile_size", [4, 16])
def test_lists_no_tile_beyond_the_ellipse(tile_size):
    """On some pixel column of a listed tile, between its first and last pixel row, alpha reaches the cut."""
    splats = random_splats(500, WIDTH, HEIGHT, smallest=0.4, largest=60)
    found = listed(splats, WIDTH, HEIGHT, tile_size)
    means, (a, b, c) = splats.means2d.double(), splats.conics.double().T[:, :, None, None]
    tiles_x, tiles_y = tile_counts(WIDTH, HEIGHT, tile_size)
    dx = torch.arange(WIDTH)[None, None, :] + 0.5 - means[:, 0, None, None]
    top = torch.arange(tiles_y)[None, :, None] * tile_size + 0.5 - means[:, 1, None, None]
    bottom = (torch.arange(1, tiles_y + 1) * tile_size).clamp(max=HEIGHT)[None, :, None] - 0.5
    bottom = bottom - means[:, 1, None, None]
    dy = torch.minimum(torch.maximum(-b / c * dx, top), bottom)  # nearest to the centre in each column
    alpha = splats.opacities.double()[:, None, None] * torch.exp(
        -0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2)
    )
    columns = torch.arange(WIDTH) // tile_size
    best = torch.zeros(len(means), tiles_y, tiles_x, dtype=torch.float64)
    best.scatter_reduce_(2, columns.expand(*alpha.shape), alpha, "amax")
    assert (best.flatten(1)[found] * 255).min() > 1 - 1e-3
    assert found.sum() > 1000


@pytest.mark.parametrize(("dtype", "least"), [(torch.float32, 0.0), (torch.float64, 1e-12)])
def test_lists_are_ordered_by_depth_then_id(dtype, least):
    """Depths that differ by `least`, negative ones and many ties."""
    splats = random_splats(2000, WIDTH, HEIGHT, cameras=3, dtype=dtype)
    splats.depths = (splats.depths * 40).round() / 40 - 1 + least * (torch.arange(2000) % 3)
    ids = torch.randperm(2000, generator=torch.Generator().manual_seed(3))
    for given in (None, ids):
        entries, offsets = intersect(*splats.geometry(), given, **GRID | {"n_cameras": 3})
        tiebreak = torch.arange(2000) if given is None else given
        per_image = (len(offsets) - 1) // 3
        for tile in range(len(offsets) - 1):
            part = entries[offsets[tile] : offsets[tile + 1]].long()
            assert (splats.camera_ids[part] == tile // per_image).all()
            keys = list(zip(splats.depths[part].tolist(), tiebreak[part].tolist(), strict=True))
            assert keys == sorted(keys)


def test_tile_ranges_are_parts_of_the_whole():
    splats = random_splats(1500, WIDTH, HEIGHT, cameras=2)
    options = GRID | {"n_cameras": 2}
    entries, offsets = intersect(*splats.geometry(), **options)
    n_tiles = len(offsets) - 1
    for begin, end in [(0, 7), (7, 33), (33, 33), (33, n_tiles)]:
        part, part_offsets = intersect(*splats.geometry(), tile_begin=begin, tile_end=end, **options)
        assert torch.equal(part, entries[offsets[begin] : offsets[end]])
        assert torch.equal(part_offsets, offsets.clamp(offsets[begin], offsets[end]) - offsets[begin])


def test_does_not_depend_on_threads():
    splats = random_splats(5000, WIDTH, HEIGHT)
    results = on_threads(lambda: intersect(*splats.geometry(), **GRID))
    assert all(torch.equal(a, b) for r in results[1:] for a, b in zip(results[0], r, strict=True))


def test_capacity(device):
    splats = Splats(*(t.to(device) for t in vars(random_splats(100, WIDTH, HEIGHT)).values()))
    entries, offsets = intersect(*splats.geometry(), **GRID)
    padded, same_offsets = intersect(*splats.geometry(), n_isects=len(entries) + 5, **GRID)
    assert len(padded) == len(entries) + 5
    assert torch.equal(padded[: len(entries)], entries)
    assert torch.equal(offsets, same_offsets)
    with pytest.raises(RuntimeError, match=f"n_isects is {len(entries) - 1} but there are {len(entries)}"):
        intersect(*splats.geometry(), n_isects=len(entries) - 1, **GRID)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_splats_that_are_not_finite_touch_nothing(value):
    base = random_splats(4, WIDTH, HEIGHT)
    for name, column in [("means2d", 0), ("means2d", 1), ("conics", 0), ("conics", 1), ("conics", 2)]:
        splats = Splats(*(t.clone() for t in vars(base).values()))
        getattr(splats, name)[:, column] = value
        assert not listed(splats, WIDTH, HEIGHT, 16).any()
    splats = Splats(*(t.clone() for t in vars(base).values()))
    splats.opacities[:] = value
    assert not listed(splats, WIDTH, HEIGHT, 16).any()


def test_a_conic_rounded_to_a_stripe_covers_its_line():
    """b^2 >= a c: infinitely long, so it touches the tiles along its axis and no others."""
    conic = torch.tensor([[0.5, -0.5, 0.5]])  # the diagonal dx = dy
    splats = Splats(torch.tensor([[8.0, 8.0]]), conic, torch.ones(1), torch.ones(1, 3), torch.ones(1),
                    torch.zeros(1, dtype=torch.int32))  # fmt: skip
    found = listed(splats, 64, 64, 16)[0].view(4, 4)
    assert found.diagonal().all()
    assert not found[0, 2:].any()
    assert not found[2:, 0].any()


def test_empty_and_one_splat():
    empty = random_splats(0, WIDTH, HEIGHT)
    entries, offsets = intersect(*empty.geometry(), **GRID | {"n_cameras": 2})
    assert entries.shape == (0,)
    assert offsets.shape == (2 * 6 * 5 + 1,)
    assert not offsets.any()
    one = random_splats(1, WIDTH, HEIGHT)
    one.means2d[0] = torch.tensor([40.0, 40.0])
    one.opacities[0] = 0.5
    entries, offsets = intersect(*one.geometry(), **GRID)
    assert len(entries) >= 1
    assert not entries.any()


def test_errors_name_the_value_of_intersect():
    splats = random_splats(3, WIDTH, HEIGHT)
    message = "camera_ids must be a torch.Tensor, got NoneType"
    refused(TypeError, message, intersect, *splats.geometry()[:4], None, **GRID)
    with pytest.raises(RuntimeError, match=r"conics must have shape \[3, 3\], got \[3, 2\]"):
        intersect(splats.means2d, splats.conics[:, :2], *splats.geometry()[2:], **GRID)
    with pytest.raises(RuntimeError, match="camera_ids must be Int"):
        intersect(*splats.geometry()[:4], splats.camera_ids.long(), **GRID)
    with pytest.raises(RuntimeError, match=r"range of the 30 tiles, got \[5, 31\)"):
        intersect(*splats.geometry(), tile_begin=5, tile_end=31, **GRID)
    with pytest.raises(RuntimeError, match=r"tile_size must be in \[1, 64\], got 0"):
        torch.ops.blitzgs.intersect(*splats.geometry(), None, 1, WIDTH, HEIGHT, 0, 0, -1, -1)
    with pytest.raises(RuntimeError, match="tile numbers are 32-bit, got 4294967296 tiles"):
        intersect(*splats.geometry(), n_cameras=1, width=2**20, height=2**20)


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


@pytest.mark.parametrize("with_ids", [False, True])
@pytest.mark.parametrize("n", [0, 1, 1024, 8192, 20_000])
def test_lists_ignore_entries_after_the_last_splat(n, with_ids, device):
    columns = Columns(n, 40_000, device, cameras=2)
    ids, padded_ids = (columns.ids, columns.padded_ids) if with_ids else (None, None)
    view = GRID | {"n_cameras": 2}
    expected, offsets = intersect(*columns.alone.geometry(), ids, **view)
    for capacity in (-1, len(expected), len(expected) + 30_000):
        found, found_offsets = intersect(
            *columns.padded.geometry(), padded_ids, **view, n_isects=capacity, n_splats=columns.count
        )
        assert len(found) == (len(expected) if capacity < 0 else capacity)
        assert torch.equal(found_offsets, offsets)
        assert torch.equal(found[: len(expected)], expected)


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


def test_columns_with_zero_capacity(device):
    columns = Columns(0, 0, device)
    lists = ops.intersect(*columns.padded.geometry(), None, *VIEW, 0, -1, 10, columns.count)
    assert not lists[1].any()
    renders = ops.rasterize_fwd(
        *columns.padded.values(), None, *lists, *VIEW, 0, -1, True, True, columns.count
    )[0]
    assert not renders.any()


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
    torch.testing.assert_close(padded[:4], plain[:4], rtol=0, atol=0)
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


def test_errors_name_the_value_of_splat_count(device):
    columns = Columns(100, 150, device)
    with pytest.raises(RuntimeError, match="n_splats must be Long, got Int"):
        intersect(*columns.padded.geometry(), **GRID, n_splats=columns.count.int())
    with pytest.raises(RuntimeError, match=r"n_splats must have shape \[1\], got \[2\]"):
        intersect(*columns.padded.geometry(), **GRID, n_splats=columns.count.repeat(2))
    lists = intersect(*columns.alone.geometry(), **GRID)
    short = {"n_isects": len(lists[0]) - 1, "n_splats": columns.count}
    message = f"n_isects is {len(lists[0]) - 1} but there are {len(lists[0])}"
    refused(RuntimeError, message, intersect, *columns.padded.geometry(), **GRID, **short)
    image = ops.rasterize_fwd(*columns.alone.values(), None, *lists, *VIEW, 0, -1)
    arguments = (columns.padded.values(), None, lists, kept_by(image), image[0], None, *VIEW, 0, -1)
    refused(RuntimeError, "150 splats .* got 100 and 30", ops.rasterize_bwd, *arguments, False, True)
    if device == "cuda":
        with pytest.raises(RuntimeError, match="n_splats must be on the device of the splats"):
            intersect(*columns.padded.geometry(), **GRID, n_splats=columns.count.cpu())
        with pytest.raises(RuntimeError, match="gradients must have 150 splats or more, got 149"):
            ops.rasterize_fwd_(
                *columns.padded.values(), None, *lists, *VIEW, 0, -1,
                torch.zeros(149, SPLAT_GRADIENT, device=device),
            )  # fmt: skip


def test_opcheck(device):
    columns = Columns(20, 30, device)
    alone, padded = ((*s.geometry(), None, *VIEW, 0, -1) for s in (columns.alone, columns.padded))
    lists = ops.intersect(*alone, -1)
    for capacity in (-1, len(lists[0])):
        torch.library.opcheck(ops.intersect, (*alone, capacity))
        torch.library.opcheck(ops.intersect, (*padded, capacity, columns.count))
    values = [t.requires_grad_() for t in columns.padded.values()]
    torch.library.opcheck(
        ops.rasterize_fwd,
        (*values, None, *lists, *VIEW, 0, -1, True, False, columns.count),
        # Not those that compare the memory between forward and backward, which is not all written.
        test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
    )
