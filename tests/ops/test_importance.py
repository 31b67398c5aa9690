# SPDX-License-Identifier: Apache-2.0
"""The instrumented rasterisation has the renderer's bits; thresholds and features are exact."""

from fractions import Fraction

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.ops.importance import CHOICE_STEP, ROUNDS, STEPS, TIES_STEP, UNITS, MassCut
from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import project
from blitzgs.ops.rasterize import rasterize
from blitzgs.reference.render import contributions as by_definition
from blitzgs.reference.render import top_mass
from blitzgs.spawn.candidates import FEATURES, spawn_features
from blitzgs.table.table import GaussianTable
from tests.helpers import random_scene, refused
from tests.population.test_density import LEVELS, random_table


def lists_of(scene, tile_size=16):
    """Projected splats and their lists, and the grid as keywords."""
    projected = project(
        scene.means, scene.quats, scene.scales, scene.opacities, None, scene.viewmats, scene.Ks, scene.width,
        scene.height, raw=False,
    )  # fmt: skip
    splats = projected.means2d, projected.conics, projected.opacities
    grid = {
        "n_cameras": len(scene.Ks), "width": scene.width, "height": scene.height, "tile_size": tile_size,
    }  # fmt: skip
    return splats, intersect(*splats, projected.depths, projected.camera_ids, **grid), grid


def splat_contributions(splats, lists, grid, tiles=(0, -1), squares=False):
    return torch.ops.blitzgs.contributions(*splats, *lists, *grid.values(), *tiles, None, squares)


def crowded(device="cpu", dtype=torch.float32):
    """Opaque splats in front of others, so that pixels end, over several tiles and uneven borders."""
    scene = random_scene(150, 3, 45, 37, seed=3, scale=0.2)
    scene.opacities[::3] = 0.999
    return scene.to(dtype, device)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
def test_sees_what_the_renderer_composites_bit_for_bit(backend, tile_size):
    if backend[0] == "cuda" and tile_size != 16:
        pytest.skip("CUDA composites tiles of 16 pixels")
    """One channel per splat: its image is alpha T of that splat."""
    splats, lists, grid = lists_of(crowded(*backend), tile_size)
    count = len(splats[0])
    channels = torch.eye(count, device=backend[0], dtype=backend[1])
    images, _ = rasterize(*splats, channels, *lists, **grid)
    weights, pixels, squares = splat_contributions(splats, lists, grid, squares=True)
    shares = images.double() * UNITS
    assert torch.equal(weights, shares.round().long().sum((0, 1, 2)))
    assert torch.equal(pixels, (images > 0).sum((0, 1, 2)).int())
    high, low = shares.round().long() >> 16, shares.round().long() & 0xFFFF
    exact = high**2 + (
        (high * low << 17) + low**2 >> 32
    )  # of 64 bits, of which neither int64 nor float64 holds all
    assert torch.equal(squares, exact.sum((0, 1, 2)))
    assert pixels.max() > 100 and (pixels == 0).any()
    without = splat_contributions(splats, lists, grid)
    assert torch.equal(without[0], weights) and torch.equal(without[1], pixels) and not len(without[2])


def test_parts_add_up_and_repeat(backend):
    splats, lists, grid = lists_of(crowded(*backend))
    sums = splat_contributions(splats, lists, grid, squares=True)
    tiles = len(lists[1]) - 1
    cuts = [0, 1, 1, 7, 20, tiles]
    parts = [
        splat_contributions(splats, lists, grid, (begin, end), squares=True)
        for begin, end in zip(cuts, cuts[1:], strict=False)
    ]
    assert all(torch.equal(sum(pieces), whole) for *pieces, whole in zip(*parts, sums, strict=True))
    for _ in range(3):
        again = splat_contributions(splats, lists, grid, squares=True)
        assert all(torch.equal(a, b) for a, b in zip(again, sums, strict=True))


@pytest.mark.parametrize("squares", [False, True])
def test_opcheck(squares):
    splats, lists, _ = lists_of(random_scene(20, 1, 40, 32))
    torch.library.opcheck(
        torch.ops.blitzgs.contributions, (*splats, *lists, 1, 40, 32, 16, 0, -1, None, squares)
    )


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_contributions_equal_the_definition(backend, mode):
    # These are more views than one call takes.
    scene = random_scene(70, 10, seed=5, scale=0.15).to(backend[1], backend[0])
    scene.means[:25] *= 4  # beyond the borders and in front of the near plane, in some views
    arguments = (
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, scene.width,
        scene.height,
    )  # fmt: skip
    weights, pixels, visible = blitzgs.contributions(*arguments, near_plane=2.5, rasterize_mode=mode)
    expected = by_definition(
        *(x.cpu() if isinstance(x, torch.Tensor) else x for x in arguments),
        near_plane=2.5,
        antialiased=mode == "antialiased",
    )
    weights, pixels, visible = weights.cpu(), pixels.cpu(), visible.cpu()
    assert weights.dtype == torch.float64 and pixels.dtype == torch.int64 and visible.dtype == torch.bool
    exact = backend[1] == torch.float64
    # At a pixel on a cut, rounding decides, and the splats behind may change, too.
    allowed = 0 if exact else 3 * expected.undecided + 3
    assert ((pixels - expected.pixels).abs() <= allowed).all()
    decided = expected.undecided == 0
    assert decided.float().mean() > 0.5
    tolerance = expected.pixels / UNITS if exact else 1e-4 * expected.pixels
    assert ((weights - expected.weights).abs() <= tolerance + 1e-12)[decided].all()
    assert torch.equal(visible, expected.visible)
    assert 0.1 < visible.double().mean() < 1


def test_hidden_and_missing_gaussians_contribute_nothing():
    scene = random_scene(4, 1)
    scene.means[:, 2] -= 100.0
    scene.scales[3] = float("nan")
    with pytest.warns(
        RuntimeWarning, match="contributions: NaN or infinite values in scales, first at 3;"
    ) as w:
        weights, pixels, visible = blitzgs.contributions(
            scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, 40, 32
        )
    assert w[0].filename == __file__
    assert not weights.any() and not pixels.any() and not visible.any()
    none = [scene.means[:0], scene.quats[:0], scene.scales[:0], scene.opacities[:0]]
    assert blitzgs.contributions(*none, scene.viewmats, scene.Ks, 40, 32)[0].shape == (1, 0)
    no_views = blitzgs.contributions(*none, scene.viewmats[:0], scene.Ks[:0], 40, 32)
    assert no_views[1].shape == (0, 0)


def test_bad_arguments_are_named():
    splats, lists, grid = lists_of(random_scene(5))
    with pytest.raises(RuntimeError, match="contributions: conics must have shape"):
        splat_contributions((splats[0], splats[1][:, :2], splats[2]), lists, grid)
    with pytest.raises(RuntimeError, match="tile_begin and tile_end must be a range"):
        splat_contributions(splats, lists, grid, (5, 99))
    with pytest.raises(ValueError, match="rasterize_mode must be one of classic, antialiased, got 'ewa'"):
        blitzgs.contributions(*splats, splats[2], *lists, 4, 4, rasterize_mode="ewa")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"means": np.zeros((5, 3))}, TypeError, "means must be a torch.Tensor, got ndarray"),
        ({"quats": torch.zeros(5, 3)}, ValueError, "quats must be"),
        ({"Ks": torch.zeros(1, 3, 3).double()}, ValueError, "Ks is torch.float64 and means torch.float32"),
        ({"means": torch.zeros(1, 5, 3)}, ValueError, r"means must be \[N, 3\]"),
        ({"width": 0}, ValueError, "width must be 1 to"),
        ({"eps2d": -1.0}, ValueError, "eps2d must be"),
    ],
    ids=str,
)
def test_bad_arguments_of_contributions_are_named(change, error, message):
    scene = random_scene(5, 1)
    given = {
        name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks")
    }
    refused(error, message, blitzgs.contributions, **{**given, "width": 40, "height": 32, **change})


SHARE = 99, 100


def by_sorting(weights, segments, ids, share):
    """Return the chosen items by the definition: sorted by descending weight and ascending id."""
    chosen = [False] * len(weights)
    for segment in set(segments):
        mine = [i for i, s in enumerate(segments) if s == segment]
        picked = top_mass([weights[i] for i in mine], [ids[i] for i in mine], Fraction(*share))
        for i, is_chosen in zip(mine, picked, strict=True):
            chosen[i] = is_chosen
    return chosen


def items(kind, n_segments, seed=0):
    """Weights [P], segments [P], owners [P] and ids [N]; each owner has an item in some of the segments."""
    g = torch.Generator().manual_seed(seed)
    n = 400
    ids = torch.randperm(n, generator=g) * ((1 << 61) // n)
    ids[0] = (1 << 63) - 1
    pairs = torch.rand(n, n_segments, generator=g) < 0.6
    pairs[:, 1:2] = False  # a segment without items
    owners, segments = pairs.nonzero().unbind(1)
    count = len(owners)
    small = torch.randint(0, 1 << 50, (count,), generator=g) >> torch.randint(0, 50, (count,), generator=g)
    weights = {
        "many sizes": small,
        "ties": torch.randint(0, 4, (count,), generator=g) * 1_234_567_890_123,
        "all alike": torch.full((count,), 7),
        "tiny": torch.randint(0, 40, (count,), generator=g),
        "zeros": torch.zeros(count, dtype=torch.int64),
    }[kind]
    weights[:: n + 1] = 1 << 55
    if kind == "zeros":
        weights[:] = 0
    return weights, segments.int(), owners.int(), ids


@pytest.mark.parametrize("n_segments", [1, 3, 11])
@pytest.mark.parametrize("kind", ["many sizes", "ties", "all alike", "tiny", "zeros"])
@pytest.mark.parametrize("share", [(0, 1), (1, 2), (99, 100), (123_456_789, 1_000_000_000), (1, 1)])
def test_mass_cuts_equal_sorting(device, n_segments, kind, share):
    weights, segments, owners, ids = items(kind, n_segments)
    expected = by_sorting(weights.tolist(), segments.tolist(), ids[owners].tolist(), share)
    cut = MassCut.begin(*(t.to(device) for t in (weights, segments, owners, ids)), n_segments)
    cut.take_steps(share, 0, STEPS)
    assert cut.chosen.tolist() == expected
    assert not cut.sums.any()


def test_largest_weights(device):
    weights = torch.tensor([(1 << 61) - 1, 1 << 60, (1 << 60) - 1, 1, 0])
    ids = torch.tensor([4, 0, 3, 2, 1])
    for share in ((1, 2), (3, 4), (999_999_999, 1_000_000_000), (1, 1)):
        items = weights, torch.zeros(5, dtype=torch.int32), torch.arange(5, dtype=torch.int32), ids
        cut = MassCut.begin(*(t.to(device) for t in items), 1)
        cut.take_steps(share, 0, STEPS)
        assert cut.chosen.tolist() == by_sorting(weights.tolist(), [0] * 5, ids.tolist(), share)


@pytest.mark.parametrize("kind", ["many sizes", "ties", "zeros"])
def test_sums_of_parts_add_up(device, kind):
    """Three ranks, the last without items, add up their sums after every scan."""
    weights, segments, owners, ids = (t.to(device) for t in items(kind, 3))
    expected = by_sorting(weights.tolist(), segments.tolist(), ids[owners.long()].tolist(), SHARE)
    part = owners % 2
    cuts = [
        MassCut.begin(weights[part == p], segments[part == p], owners[part == p], ids, 3) for p in range(3)
    ]
    for step in range(0, CHOICE_STEP, 2):
        if step == TIES_STEP:
            assert [cut.has_ties() for cut in cuts] == [kind == "ties"] * 3
        for cut in cuts:
            cut.take_steps(SHARE, step, step + 1)
        total = sum(cut.sums for cut in cuts)
        for cut in cuts:
            cut.sums.copy_(total)
            cut.take_steps(SHARE, step + 1, step + 2)
    for cut in cuts:
        cut.take_steps(SHARE, CHOICE_STEP, STEPS)
    chosen = torch.zeros(len(weights), dtype=torch.bool, device=device)
    for p in range(2):
        chosen[part == p] = cuts[p].chosen
    assert chosen.tolist() == expected and ROUNDS == TIES_STEP // 2


def test_errors_name_the_value():
    def cut(**changes):
        items = {
            "weights": torch.ones(3, dtype=torch.int64),
            "segments": torch.zeros(3, dtype=torch.int32),
            "owners": torch.arange(3, dtype=torch.int32),
            "ids": torch.arange(3),
        }
        return MassCut.begin(*(items | changes).values(), 2)

    refused(RuntimeError, r"share .* at most 9 decimals, got 3 / 2", cut().take_steps, (3, 2), 0, STEPS)
    with pytest.raises(RuntimeError, match=rf"steps must be in \[0, {STEPS}\], got 0 to {STEPS + 1}"):
        cut().take_steps(SHARE, 0, STEPS + 1)
    with pytest.raises(RuntimeError, match=r"segments must have shape \[3\], got \[2\]"):
        cut(segments=torch.zeros(2, dtype=torch.int32)).take_steps(SHARE, 0, STEPS)
    refused(RuntimeError, "owners must .* got Long", cut(owners=torch.arange(3)).take_steps, SHARE, 0, STEPS)


def test_mass_cut_opcheck():
    cut = MassCut.begin(*items("ties", 2), 2)
    arguments = (*cut.items, cut.searches, cut.sums, cut.listed.zero_(), cut.chosen.zero_(), *SHARE, 0, STEPS)
    torch.library.opcheck(torch.ops.blitzgs.mass_cut_, arguments)


TIME, EXTENT = 700, 12.5


def candidates(count, device="cpu"):
    """A table, every third of its rows, and whether each is to be split."""
    g = torch.Generator().manual_seed(4)
    table = random_table(count)
    table["birth"].copy_(torch.randint(0, TIME, (count,), generator=g))
    table = GaussianTable({name: column.to(device) for name, column in table.columns.items()})
    rows = torch.arange(count - 1, -1, -3, device=device)
    return table, rows, torch.rand(len(rows), generator=g).to(device) < 0.5


def expected(table, rows, is_split):
    """The definition, column by column."""
    of = {name: column.cpu()[rows.cpu()].double() for name, column in table.columns.items()}
    views, level, scales = of["grad_count"], of["level"], of["scales"]
    columns = {
        "gradient": of["grad_sum"] / views.clamp(min=1),
        "parent_opacity": of["opacities"].sigmoid(),
        "parent_scale": scales.exp().mean(1) / EXTENT,
        "parent_age": TIME - of["birth"],
        "views": views,
        "level": torch.where(is_split.cpu(), (level + 1).clamp(max=LEVELS - 1), level),
        "time": torch.full_like(views, TIME),
        "is_split": is_split.cpu().double(),
        "parent_color_gradient": of["exp_avg_sq.sh"][:, 0].mean(1).sqrt(),
        "parent_flatness": scales.amin(1).exp() / scales.amax(1).exp(),
    }
    return torch.stack([columns[name] for name in FEATURES], 1)


@pytest.mark.parametrize("count", [1, 1000])
def test_spawn_features_match_the_formulas(device, count):
    table, rows, is_split = candidates(count, device)
    features = spawn_features(table, rows, is_split, TIME, EXTENT, LEVELS)
    assert features.dtype == torch.float32
    torch.testing.assert_close(features.cpu().double(), expected(table, rows, is_split), rtol=2e-7, atol=0)


def test_wrong_arguments():
    table = random_table(6)
    rows, is_split = torch.arange(6), torch.zeros(6, dtype=torch.bool)
    with pytest.raises(RuntimeError, match="rows must be Long, got Int"):
        spawn_features(table, rows.int(), is_split, TIME, EXTENT, LEVELS)
    with pytest.raises(RuntimeError, match=r"is_split must have shape \[6\], got \[5\]"):
        spawn_features(table, rows, is_split[:5], TIME, EXTENT, LEVELS)
    refused(RuntimeError, "extent must be positive", spawn_features, table, rows, is_split, TIME, 0.0, LEVELS)
    refused(RuntimeError, "level_.* positive", spawn_features, table, rows, is_split, TIME, EXTENT, 0)


def test_spawn_features_opcheck():
    table, rows, is_split = candidates(9)
    names = ("grad_sum", "grad_count", "opacities", "scales", "birth", "level", "exp_avg_sq.sh")
    torch.library.opcheck(
        torch.ops.blitzgs.spawn_features,
        ([table[name] for name in names], rows, is_split, TIME, EXTENT, LEVELS),
    )
