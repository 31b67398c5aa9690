# SPDX-License-Identifier: Apache-2.0
"""Intersection on CUDA gives the CPU's lists in the same order."""

import pytest
import torch

from tests.cuda.scenes import Scene, ops


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
