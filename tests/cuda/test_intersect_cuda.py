# SPDX-License-Identifier: Apache-2.0
"""Intersection gives the CPU's lists in the same order; contributions equal the renderer's bits."""

import pytest
import torch

from blitzgs.ops.blocks import gate_views_
from blitzgs.ops.importance import STEPS, MassCut
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import ViewGate, all_rows
from tests.cuda.conftest import Scene, ops
from tests.table.test_blocks import make_views
from tests.view.test_gate import GATE, bits, kept_by_definition, make_scene


def lists(splats, grid, device, ids=None, count=-1):
    means2d, conics, depths, opacities = (splats[i].to(device) for i in (4, 5, 6, 7))
    entries, offsets = ops.intersect(
        means2d, conics, opacities, depths, splats[1].to(device), ids if ids is None else ids.to(device),
        *grid, count,
    )  # fmt: skip
    offsets = offsets.cpu()
    return entries[: offsets[-1]].cpu(), offsets  # behind these nothing was written


def require_same_lists(splats, grid, ids):
    entries, offsets = lists(splats, grid, "cuda", ids)
    expected, expected_offsets = lists(splats, grid, "cpu", ids)
    different = 0
    for tile in range(len(offsets) - 1):
        ours = entries[offsets[tile] : offsets[tile + 1]].tolist()
        theirs = expected[expected_offsets[tile] : expected_offsets[tile + 1]].tolist()
        different += len(set(ours) ^ set(theirs))  # a boundary may round either way
        common = set(ours) & set(theirs)
        assert [r for r in ours if r in common] == [r for r in theirs if r in common]
    assert different <= 1e-4 * len(expected)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("with_ids", [False, True])
def test_lists_match_the_cpu(scene, tile_size, with_ids):
    splats = list(scene.project("cpu"))
    splats[6] = (splats[6] * 8).round() / 8  # many equal depths
    ids = None
    if with_ids:
        ids = torch.randperm(len(splats[0]), generator=torch.Generator().manual_seed(0))
    require_same_lists(splats, scene.grid(tile_size), ids)


@pytest.mark.parametrize("tiles", [(0, -1), (700, 2600)])
def test_splats_of_every_shape(tiles):
    """Splats from a point to the whole image: needles and discs, upright and slanted."""
    g = torch.Generator().manual_seed(4)
    n, views, width, height = 3000, 2, 900, 700
    long = 10 ** (torch.rand(n, generator=g) * 3)  # pixels
    short = long * 10 ** (-3 * torch.rand(n, generator=g))
    turn = torch.rand(n, generator=g) * 3.2
    axes = torch.stack(
        [torch.stack([turn.cos(), turn.sin()], -1), torch.stack([-turn.sin(), turn.cos()], -1)], -1
    )
    variances = torch.stack([long, short], -1).square() + 0.3
    conics = axes @ torch.diag_embed(1 / variances) @ axes.mT
    splats = [None] * 8
    splats[1] = torch.randint(0, views, (n,), generator=g, dtype=torch.int32)
    splats[4] = torch.rand(n, 2, generator=g) * torch.tensor([width, height]) * 1.4 - 100
    splats[5] = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], -1)
    splats[6] = torch.rand(n, generator=g)
    splats[7] = torch.rand(n, generator=g)
    require_same_lists(splats, (views, width, height, 16, *tiles), None)


def small_splats(n, depths, views=1):
    """Splats some pixels wide, all over images of 200 x 150 pixels."""
    g = torch.Generator().manual_seed(6)
    splats = [None] * 8
    splats[1] = torch.randint(0, views, (n,), generator=g, dtype=torch.int32)
    splats[4] = torch.rand(n, 2, generator=g) * torch.tensor([220.0, 170.0]) - 10
    splats[5] = torch.tensor([0.3, 0.1, 0.2]).repeat(n, 1)
    splats[6] = depths[torch.randperm(n, generator=g)]
    splats[7] = torch.rand(n, generator=g)
    return splats, torch.randperm(n, generator=g)


DEPTHS = {
    "18 decades": lambda n: 10 ** torch.linspace(-8, 10, n),
    "18 decades and many splats a few roundings apart": lambda n: torch.cat(
        [torch.tensor([1e-8, 1e10]), 1 + torch.arange(n - 2) % 200 * 2.0**-23]
    ),
    "four neighbouring numbers": lambda n: 1 + torch.arange(n) % 4 * 2.0**-23,
    "one number": lambda n: torch.full((n,), 3.0),
    "both signs and both zeros": lambda n: torch.cat(
        [torch.tensor([0.0, -0.0]).repeat(n // 4), torch.linspace(-1e5, 1e5, n - n // 4 * 2)]
    ),
    "all of a factor of four": lambda n: torch.linspace(100, 400, n),
}


@pytest.mark.parametrize("depths", DEPTHS)
@pytest.mark.parametrize("with_ids", [False, True])
@pytest.mark.parametrize(("n", "views"), [(1, 1), (5000, 1), (60_000, 3)])
def test_depths_of_every_kind(depths, with_ids, n, views):
    n_depths = max(n, 8)
    splats, ids = small_splats(n, DEPTHS[depths](n_depths)[:n], views)
    require_same_lists(splats, (views, 200, 150, 16, 0, -1), ids if with_ids else None)


@pytest.mark.parametrize("tile_size", [8, 16, 64])
def test_many_splats_and_entries(tile_size):
    """Every pass of the sorts has hundreds of blocks."""
    g = torch.Generator().manual_seed(2)
    splats, ids = small_splats(1_000_000, torch.rand(1_000_000, generator=g), 2)
    require_same_lists(splats, (2, 200, 150, tile_size, 0, -1), ids)


def test_more_tiles_than_16_bits_hold():
    scene = Scene(500, views=2, width=4600, height=4100)
    splats = scene.project("cpu")
    entries, offsets = lists(splats, scene.grid(), "cuda")
    assert len(offsets) - 1 > 65536
    assert torch.equal(entries, lists(splats, scene.grid(), "cpu")[0])


def test_tile_ranges_cut_the_whole(scene):
    splats = scene.project("cpu")
    entries, offsets = lists(splats, scene.grid(), "cuda")
    tiles = len(offsets) - 1
    cuts = [0, 17, 18, 60, tiles]
    for begin, end in zip(cuts, cuts[1:], strict=False):
        part, part_offsets = lists(splats, scene.grid(16, begin, end), "cuda")
        assert torch.equal(part, entries[offsets[begin] : offsets[end]])
        sizes, part_sizes = offsets.diff(), part_offsets.diff()
        assert torch.equal(part_sizes[begin:end], sizes[begin:end])
        assert not part_sizes[:begin].any() and not part_sizes[end:].any()


def test_no_splats(scene):
    splats = [t[:0] for t in scene.project("cpu")]
    entries, offsets = lists(splats, scene.grid(), "cuda")
    assert len(entries) == 0 and not offsets.any()


def survey(scene):
    """Splats, lists and contributions of a scene whose splats and lists are those of the CPU."""
    projected, grid = scene.project("cpu"), scene.grid()
    splats = [projected.means2d, projected.conics, projected.opacities]
    lists = ops.intersect(*splats, projected.depths, projected.camera_ids, None, *grid, -1)
    splats, lists = ([t.cuda() for t in tensors] for tensors in (splats, lists))
    return splats, lists, grid, ops.contributions(*splats, *lists, *grid, squares=True)


def test_a_crowded_scene_has_the_bits_of_its_image():
    """Each chosen splat has its own channel, four splats per image."""
    scene = Scene(5000, width=170, height=110)
    splats, lists, grid, (weights, pixels, squares) = survey(scene)
    count = len(splats[0])
    without = ops.contributions(*splats, *lists, *grid)
    assert torch.equal(without[0], weights) and torch.equal(without[1], pixels) and not len(without[2])
    chosen = torch.randperm(count, generator=torch.Generator().manual_seed(1))[:64]
    assert pixels.max() > 256
    for four in chosen.view(-1, 4):
        channels = torch.zeros(count, 4, device="cuda")
        channels[four, torch.arange(4)] = 1
        images = ops.rasterize_fwd(*splats, channels, None, *lists, *grid, True, False)[0]
        units = (images.double() * 2.0**32).round().long().sum((0, 1, 2))
        assert torch.equal(weights[four.cuda()], units)
        assert torch.equal(pixels[four.cuda()], (images > 0).sum((0, 1, 2)).int())
        # A float64 holds the square of the 24 bits of a float32 exactly.
        exact = ((images.double() * 2.0**32).round() ** 2 / 2.0**32).floor().long().sum((0, 1, 2))
        assert torch.equal(squares[four.cuda()], exact)


def test_repeats_and_adds_up():
    scene = Scene(20_000, views=4, width=500, height=300)
    splats, lists, grid, sums = survey(scene)
    for _ in range(20):
        again = ops.contributions(*splats, *lists, *grid, squares=True)
        assert all(torch.equal(a, b) for a, b in zip(again, sums, strict=True))
    tiles = len(lists[1]) - 1
    cuts = [0, 1, 1, 90, tiles // 2, tiles]
    parts = [
        ops.contributions(*splats, *lists, *grid[:4], a, b, squares=True)
        for a, b in zip(cuts, cuts[1:], strict=False)
    ]
    assert all(torch.equal(sum(pieces), whole) for *pieces, whole in zip(*parts, sums, strict=True))


def test_entries_after_the_last_splat_are_not_read():
    splats, lists, grid, sums = survey(Scene(500))
    count = len(splats[0])
    padded = [torch.cat((t, torch.full_like(t, float("nan")))) for t in splats]
    known = torch.tensor([count], device="cuda")
    got = ops.contributions(*padded, *lists, *grid, known, squares=True)
    assert all(torch.equal(a[:count], b) and not a[count:].any() for a, b in zip(got, sums, strict=True))


def test_a_splat_over_every_pixel_fits():
    """Even the largest sums that a tile can have do not overflow from one field into the next."""
    means2d = torch.tensor([[64.0, 64.0]] * 3, device="cuda")
    conics = torch.tensor([[1e-9, 0.0, 1e-9]] * 3, device="cuda")
    opacities = torch.tensor([1.0, 0.9, 0.95], device="cuda")
    grid = [1, 128, 128, 16, 0, -1]
    tiles = (128 // 16) ** 2
    entries = torch.arange(3, dtype=torch.int32, device="cuda").repeat(tiles)
    offsets = torch.arange(0, 3 * tiles + 1, 3, device="cuda")
    weights, pixels, squares = ops.contributions(
        means2d, conics, opacities, entries, offsets, *grid, squares=True
    )
    assert pixels.tolist() == [128 * 128, 128 * 128, 0]  # the third would take T below 1e-4
    alpha = torch.tensor(0.99)
    units = (alpha.double() * 2.0**32).round().long().item()
    assert weights[0].item() == units * 128 * 128
    assert squares[0].item() == (units**2 >> 32) * 128 * 128
    assert abs(weights[1].item() / 2.0**32 / (128 * 128) - 0.9 * 0.01) < 1e-5


def test_other_tile_sizes_are_refused():
    splats, lists, grid, _ = survey(Scene(50))
    with pytest.raises(RuntimeError, match="tile_size must be 16 on CUDA, got 64"):
        ops.contributions(*splats, lists[0], lists[1][:13], *grid[:3], 64, 0, -1)


SHARE = 99, 100


@pytest.mark.parametrize("n_segments", [4, 32])
def test_cuda_equals_cpu_on_many_items(n_segments):
    g = torch.Generator().manual_seed(2)
    n = 300_000
    owners = torch.arange(n, dtype=torch.int32).repeat_interleave(3)
    segments = torch.randint(0, n_segments, (3 * n,), generator=g, dtype=torch.int32)
    weights = (torch.randn(3 * n, generator=g) * 3 + 22).exp().long()
    weights[::5] = 1 << 30
    ids = torch.randperm(n, generator=g)
    found = []
    for device in ("cpu", "cuda"):
        cut = MassCut.begin(*(t.to(device) for t in (weights, segments, owners, ids)), n_segments)
        cut.take_steps(SHARE, 0, STEPS)
        found.append(cut.chosen.cpu())
    assert torch.equal(*found) and 0.1 < found[0].double().mean() < 0.99


def gated(table, viewmats, gate, count):
    """Gate the first `count` rows of lists with a capacity for all rows; return their views."""
    active = all_rows(len(table), 32, table.device)
    active.length.fill_(count)
    gate_views_(active, table["means"], viewmats, gate.rules(table))
    assert (active.views[count:] == -1).all()
    return active.views[:count]


# The launch has as many threads as fit on the GPU; the last sizes make them take turns.
@pytest.mark.parametrize("count", [0, 1, 255, 257, 100_000, 1_000_000])
def test_the_gpu_leaves_out_what_the_cpu_leaves_out(count):
    table = make_scene(1_000_000)
    viewmats, _ = make_views(32)
    gate = ViewGate(GATE.reach(), 0xFFFF0FF1, [view * 2 if view % 3 else -1 for view in range(32)])
    on_gpu = GaussianTable({name: table[name].cuda() for name in table})
    expected = gated(table, viewmats, gate, count)
    found = gated(on_gpu, viewmats.cuda(), gate, count).cpu()
    _, close = kept_by_definition(table, viewmats)
    assert torch.equal(bits(found, 32) | close[:count], bits(expected, 32) | close[:count])
    assert count < 1000 or 0.1 < bits(found, 32).double().mean() < 0.9
