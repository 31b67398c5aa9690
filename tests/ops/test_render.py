# SPDX-License-Identifier: Apache-2.0
"""Images of gathered rows, the splats of each pixel and the costs of tiles are those of their parts."""

import numpy as np
import pytest
import torch

from blitzgs.ops.exchange import divide_tiles, tile_costs
from blitzgs.ops.importance import pixel_splats
from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.project import project_splats, queue_projection
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions, Sizes, splats_of
from blitzgs.ops.rasterize import rasterize
from blitzgs.reference.render import composited_weights, median_splats, strongest_splats
from tests.helpers import random_scene, refused
from tests.ops.test_importance import crowded, lists_of


def tables_of(device="cpu", dtype=torch.float32, cameras=4, degree=3):
    """The inputs of a projection without SH, and the SH."""
    scene = random_scene(n=90, cameras=cameras, width=24, height=20, dtype=dtype, device=device)
    scene.opacities[::3] = 0  # seen by no view
    scene.colors[1::7] = torch.nan
    geometry = [scene.means, scene.quats, scene.scales, scene.opacities]
    options = ProjectionOptions(24, 20, sh_degree=degree or 0, raw=False)
    return ProjectionInputs(geometry, (scene.viewmats, scene.Ks), options), scene.colors


def with_sh(tables, sh):
    return tables._replace(gaussians=[*tables.gaussians, sh])


def render_rows(splats, tables, parts, totals=None, with_depth=False):
    """The outputs of the op `render` for splats without colours, whose rows are gathered from tables."""
    shown = (splats.radii, splats.tiles_touched)
    geometry = (splats.means2d, splats.conics, splats.opacities, splats.depths)
    ids = (splats.camera_ids, splats.visible_ids, splats.splat_offsets)
    channels = None if parts else splats.depths[:, None].contiguous()
    valid = slice(None) if totals is None else slice(int(totals[1]))  # the others are not initialised
    return torch.ops.blitzgs.render(
        *geometry, *ids, *shown, channels, with_depth, tables.gaussians, parts, *tables.cameras,
        *tables.options, None, int(splats.tiles_touched[valid].sum()), False, totals,
    )  # fmt: skip


def colored_rows(splats, tables, parts, totals=None):
    colors, numbers, indices, *rows = render_rows(splats, tables, parts, totals)[10:]
    return splats._replace(colors=colors), (rows, numbers, indices)


def require_equal(found, expected):
    for name, column in expected._asdict().items():
        if name != "counts":
            assert torch.equal(getattr(found, name), column), name


@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("lengths", [(16,), (1, 15)])
def test_splats_are_those_of_a_projection_with_sh(backend, cameras, degree, lengths):
    tables, sh = tables_of(*backend, cameras, degree)
    parts = () if degree is None else sh.split(lengths, dim=1)
    whole = with_sh(tables, sh) if parts else tables
    found, (rows, numbers, indices) = colored_rows(project_splats(tables), tables, parts)
    expected = project_splats(whole)
    assert 0 < len(expected.visible_ids) < 90 and (degree is None or not expected.opacities.all())
    require_equal(found, expected)
    assert torch.equal(indices, expected.visible_ids.long())
    assert torch.equal(numbers, torch.arange(len(expected.visible_ids), device=backend[0]))
    for own, table in zip(rows, whole.gaussians, strict=True):
        gathered = table[expected.visible_ids.long()]
        assert torch.equal(own.nan_to_num(), gathered.nan_to_num()) and own.is_contiguous()


@pytest.mark.parametrize("with_depth", [False, True])
def test_images_are_those_of_lists_and_compositing(backend, with_depth):
    tables, sh = tables_of(*backend)
    found = render_rows(project_splats(tables), tables, (sh,), with_depth=with_depth)
    splats = project_splats(with_sh(tables, sh))
    columns, grid = (splats.means2d, splats.conics, splats.opacities), TileGrid(4, 24, 20)
    lists = torch.ops.blitzgs.intersect(*columns, splats.depths, splats.camera_ids, None, *grid, -1)
    channels = torch.cat([splats.colors, splats.depths[:, None]], 1) if with_depth else splats.colors
    expected = torch.ops.blitzgs.rasterize_fwd(*columns, channels, None, *lists, *grid)
    for i, column in enumerate((*lists, *expected[:3])):
        assert torch.equal(found[i][: len(column)], column), i
    assert torch.equal(found[9], 1 - expected[1])


@pytest.mark.cuda
@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("spare", [0, 1, 5000])
def test_spare_capacity_changes_nothing(cameras, spare):
    tables, sh = tables_of("cuda", cameras=cameras)
    expected = project_splats(with_sh(tables, sh))
    sizes = queue_projection(tables, None).totals.cpu()[:3]
    capacity = Sizes(*(int(n) + spare for n in sizes))
    projected = queue_projection(tables, capacity)
    found, (rows, *_) = colored_rows(projected.splats, tables, (sh,), projected.totals)
    require_equal(splats_of(found, Sizes(*sizes.tolist())), expected)
    visible = expected.visible_ids.long()
    assert torch.equal(rows[0][: len(visible)], tables.gaussians[0][visible])


@pytest.mark.cuda
@pytest.mark.parametrize("missing", [(1, 0), (0, 1), (10, 10)])
def test_too_little_capacity_writes_nothing_beyond_it(missing):
    tables, sh = tables_of("cuda")
    visible, splats, isects = queue_projection(tables, None).totals.cpu()[:3].tolist()
    projected = queue_projection(tables, Sizes(visible - missing[0], splats - missing[1], isects))
    colored_rows(projected.splats, tables, (sh,), projected.totals)
    torch.cuda.synchronize()
    assert projected.totals[:2].tolist() == [visible, splats]


def test_errors_name_the_argument():
    tables, sh = tables_of()
    splats = project_splats(tables)
    with pytest.raises(RuntimeError, match="render: camera_ids must be Int, got Long"):
        colored_rows(splats._replace(camera_ids=splats.camera_ids.long()), tables, (sh,))
    with pytest.raises(RuntimeError, match=r"render: radii must have shape"):
        colored_rows(splats._replace(radii=splats.radii[:-1]), tables, (sh,))
    with pytest.raises(RuntimeError, match="on the CPU splats have no spare capacity"):
        colored_rows(splats, tables, (sh,), torch.zeros(4, dtype=torch.int64))


def weights_of(splats, lists, grid):
    """Alpha T of each splat, [P, B, H, W], with the bits of the image: one channel per splat."""
    channels = torch.eye(len(splats[0])).to(splats[0])
    return rasterize(*splats, channels, *lists, **grid)[0].movedim(-1, 0)


@pytest.mark.parametrize("strongest", [0, 1, 3, 200])
def test_equal_the_image_bit_for_bit(backend, strongest):
    scene = crowded(*backend)
    splats, lists, grid = lists_of(scene)
    weights = weights_of(splats, lists, grid)
    _, alphas = rasterize(*splats, torch.ones_like(splats[0]), *lists, **grid)
    found = pixel_splats(*splats, *lists, **grid, strongest=strongest)
    counts = (weights > 0).sum(dim=0)
    assert torch.equal(found.counts.view(counts.shape), counts.int()) and counts.max() > 5
    assert torch.equal((1 - found.transmittances).view(alphas.shape), alphas)
    flat = weights.flatten(1)
    assert found.ids.shape == found.weights.shape == (flat.shape[1], strongest)
    # Each id has its own weight; they are different, and no other weight is larger.
    own = flat.T.gather(1, found.ids.clamp(min=0).long())
    assert torch.equal(found.weights, torch.where(found.ids < 0, 0, own))
    assert torch.equal((found.ids >= 0).sum(dim=1), counts.flatten().clamp(max=strongest))
    best = flat.T.sort(dim=1, descending=True).values
    best = torch.nn.functional.pad(best, (0, strongest))[:, :strongest]
    assert torch.equal(found.weights.sort(dim=1, descending=True).values, best)


def test_agree_with_the_definition(backend):
    scene = crowded(*backend)
    splats, lists, grid = lists_of(scene)
    found = pixel_splats(*splats, *lists, **grid, strongest=4)
    pixels, shape = scene.width * scene.height, (scene.height, scene.width)
    options = ProjectionOptions(scene.width, scene.height, 16, raw=False)
    given = (scene.means, scene.quats, scene.scales, scene.opacities)
    projected = project_splats(ProjectionInputs(given, (scene.viewmats, scene.Ks), options))
    for view in range(len(scene.Ks)):
        own = (projected.camera_ids == view).nonzero()[:, 0]
        own = own[projected.depths[own].argsort(stable=True)]
        exact = [t[own].double().cpu() for t in (*splats, projected.depths)]
        weights, cut = composited_weights(*exact, scene.width, scene.height)
        before = 1 - (weights.cumsum(0) - weights)
        ids, shares = strongest_splats(weights, 4)
        # Where two weights are close, rounding decides.
        best = weights.sort(dim=0, descending=True).values[:5]
        close = ((best[:-1] - best[1:] < 1e-5) & (best[:-1] > 0)).any(dim=0)
        sure = ~(cut | ((before - 0.5).abs() < 1e-4).any(dim=0))
        assert sure.double().mean() > 0.8
        rows = slice(view * pixels, (view + 1) * pixels)
        own = torch.cat([own.cpu(), torch.tensor([-1])])  # number -1 is none
        assert torch.equal(found.counts[rows].cpu().view(shape)[sure], (weights > 0).sum(0).int()[sure])
        medians = own[median_splats(weights)]
        assert torch.equal(found.medians[rows].cpu().view(shape)[sure].long(), medians[sure])
        sure &= ~close
        assert sure.double().mean() > 0.3
        assert torch.equal(found.ids[rows].cpu().view(*shape, 4)[sure].long(), own[ids][sure])
        error = found.weights[rows].cpu().view(*shape, 4).double() - shares
        assert error[sure].abs().max() < (1e-9 if backend[1] == torch.float64 else 1e-4)


def test_of_equal_weights_the_front_ones_stay_in_their_order(device):
    """Ten splats whose opacities give all the same weight, but for one."""
    opacities = [1 / (20 - i) for i in range(10)]
    opacities[6] *= 1.5
    splats = [torch.tensor(v, device=device) for v in ([[2.5, 2.5]] * 10, [[1e-9, 0, 1e-9]] * 10, opacities)]
    lists = torch.arange(10, dtype=torch.int32, device=device), torch.tensor([0, 10], device=device)
    found = pixel_splats(*splats, *lists, n_cameras=1, width=5, height=5, strongest=10)
    weights = found.weights[0]
    order = weights.cpu().argsort(descending=True, stable=True)
    for k in range(1, 10):
        some = pixel_splats(*splats, *lists, n_cameras=1, width=5, height=5, strongest=k)
        expected = order[:k].sort().values
        assert some.ids.cpu().tolist() == [expected.tolist()] * 25
        assert torch.equal(some.weights[3], weights[expected.to(device)])


def test_a_list_of_pixels_has_their_rows_in_its_order(device):
    splats, lists, grid = lists_of(crowded(device))
    whole = pixel_splats(*splats, *lists, **grid, strongest=5)
    chosen = torch.randint(len(whole.counts), (70,), generator=torch.Generator().manual_seed(1)).to(device)
    chosen[9] = chosen[3]
    some = pixel_splats(*splats, *lists, **grid, strongest=5, pixels=chosen)
    assert all(torch.equal(a, b[chosen]) for a, b in zip(some, whole, strict=True))
    none = pixel_splats(*splats, *lists, **grid, strongest=5, pixels=chosen[:0])
    assert [len(column) for column in none] == [0] * 5


def test_nothing_to_composite(device):
    empty = [torch.zeros(0, *shape, device=device) for shape in ((2,), (3,), ())]
    lists = torch.zeros(0, dtype=torch.int32, device=device), torch.zeros(5, dtype=torch.int64, device=device)
    found = pixel_splats(*empty, *lists, n_cameras=1, width=20, height=20, strongest=2)
    assert found.transmittances.eq(1).all() and not found.counts.any() and found.medians.eq(-1).all()
    assert found.ids.eq(-1).all() and not found.weights.any()
    no_views = pixel_splats(*empty, lists[0], lists[1][:1], n_cameras=0, width=20, height=20, strongest=2)
    assert no_views.ids.shape == (0, 2)


def test_opcheck():
    splats, lists, grid = lists_of(crowded())
    slots = torch.full((3, 37, 45), -1, dtype=torch.int32)
    slots[1, 5, :40] = torch.arange(40)
    torch.library.opcheck(torch.ops.blitzgs.pixel_splats, (*splats, *lists, slots, 40, *grid.values(), 3))


@pytest.mark.parametrize(
    "change,message",
    [
        ({"strongest": -1}, "strongest must be 0"),
        ({"slots": torch.zeros(3, 37, 44, dtype=torch.int32)}, "slots"),
        ({"n_rows": 7}, "n_rows must be"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    splats, lists, grid = lists_of(crowded())
    options = {"slots": None, "n_rows": 3 * 37 * 45, **grid, "strongest": 1, **change}
    refused(RuntimeError, message, torch.ops.blitzgs.pixel_splats, *splats, *lists, **options)


TILE_COST = 8


def stored(sums, first, views, grain):
    """`tile_costs` by NumPy and torch's conversion."""
    means = sums.numpy()[first:].reshape(views, -1)
    begins = np.arange(0, means.shape[1], grain)
    totals = np.add.reduceat(means, begins, axis=1, dtype=np.float64)
    means = (totals / np.minimum(grain, means.shape[1] - begins)).astype(np.float32)
    return torch.from_numpy(means).clamp(max=65504.0).half()


def expected(costs, similar, tiles, grain):
    """The costs of all tiles in float32, [B T]."""

    def spread(pieces):
        return pieces.float().numpy().repeat(grain)[:tiles]

    mean = np.mean([spread(view) for view in similar], 0) if len(similar) else np.zeros(tiles, np.float32)
    rows = [spread(view) if len(view) else mean for view in costs]
    return np.concatenate(rows) + np.float32(TILE_COST)


def nearest(cost, parts):
    """The division of costs by their running sum in float64; of two bounds as near, the later one."""
    ends = np.concatenate(([0.0], np.cumsum(cost, dtype=np.float64)))
    distances = (abs(ends - ends[-1] * part / parts) for part in range(parts + 1))
    return tuple(len(cost) - int(distance[::-1].argmin()) for distance in distances)


def random_costs(rng, count):
    """Costs as they are measured: integers, many zeros, some very large."""
    large = np.where(rng.random(count) < 0.01, 1000, 1)
    return rng.integers(0, 900, count) * (rng.random(count) < 0.7) * large


@pytest.mark.parametrize("grain", [1, 2, 3, 4, 16])
@pytest.mark.parametrize("tiles", [1, 7, 2752, 8193])
def test_stored_costs_are_rounded_means(tiles, grain):
    rng, views, first = np.random.default_rng(tiles), 3, 5
    sums = torch.from_numpy(np.r_[np.full(first, 1e9), random_costs(rng, views * tiles)].astype(np.float32))
    costs = tile_costs(sums, first, views, grain)
    assert torch.equal(torch.stack(costs), stored(sums, first, views, grain))
    # A view's memory does not depend on that of views with which it was visited.
    assert {cost.untyped_storage().nbytes() for cost in costs} == {2 * -(-tiles // grain)}


def test_floats_are_stored_as_torch_rounds_them():
    """Both neighbours of each float16 and of each halfway point, and values at regular distances."""
    halves = torch.arange(0x7C00, dtype=torch.int16).view(torch.float16).float()
    halfway = (halves[1:] + halves[:-1]) / 2
    points = torch.cat([halves, halfway, torch.tensor([65519.0, 65520.0, 1e9, 3e38])])
    near = [points.nextafter(torch.tensor(end)) for end in (0.0, torch.inf)]
    regular = torch.arange(0, 0x7F800000, 10007, dtype=torch.int32).view(torch.float32)
    values = torch.cat([points, *near, regular])
    (got,) = tile_costs(values, 0, 1, 1)
    assert torch.equal(got.view(torch.int16), values.clamp(max=65504.0).half().view(torch.int16))


@pytest.mark.parametrize("parts", [1, 2, 3, 4, 8, 16, 63])
@pytest.mark.parametrize(("tiles", "grain"), [(1, 1), (3, 2), (127, 1), (128, 1), (2752, 1), (32400, 4)])
def test_bounds_are_those_of_a_running_sum(tiles, grain, parts):
    rng, unknown = np.random.default_rng(tiles + parts), torch.empty(0, dtype=torch.float16)
    for known in range(5):
        sums = torch.from_numpy(random_costs(rng, 20 * tiles).astype(np.float32))
        views = tile_costs(sums, 0, 20, grain)
        costs = views[:known] + [unknown] * (4 - known)
        order = rng.permutation(4)
        costs = [costs[i] for i in order]
        for similar in ([], views[:1], views[4:20]):
            cost = expected(costs, similar, tiles, grain)
            got = divide_tiles(costs, similar, tiles, grain, TILE_COST, parts)
            assert got == nearest(cost, parts)


@pytest.mark.parametrize("parts", range(1, 9))
def test_the_later_of_two_bounds_as_near(parts):
    """Equal costs, where shares often end in the middle of a tile."""
    for tiles in (1, 2, 3, 5, 12, 127, 129, 999):
        cost = torch.zeros(tiles, dtype=torch.float16)
        bounds = divide_tiles([cost], [], tiles, 1, TILE_COST, parts)
        assert bounds == tuple((2 * tiles * part + parts) // (2 * parts) for part in range(parts + 1))


def test_the_largest_costs_are_added_up_exactly():
    """Sums up to 2^33 of the smallest fractions that costs can have."""
    tiles, rng = 65_000, np.random.default_rng(0)
    pieces = torch.from_numpy(rng.random(tiles) * 2.0 ** rng.integers(-24, 16, tiles)).half()
    for views in ([pieces], [pieces, torch.full((tiles,), 65504.0, dtype=torch.float16)]):
        cost = np.concatenate([view.float().numpy() for view in views]) + np.float32(TILE_COST)
        units = [int(value * 2**20) for value in cost.tolist()]
        assert [unit / 2**20 for unit in units] == cost.tolist()
        assert sum(units) == int(cost.sum(dtype=np.float64) * 2**20)
        assert divide_tiles(views, [], tiles, 1, TILE_COST, 7) == nearest(cost, 7)


def test_errors_name_the_value():
    sums, half = torch.zeros(13), torch.zeros(4, dtype=torch.float16)
    refused(RuntimeError, "13 costs are not those of the tiles of 2 views", tile_costs, sums, 0, 2, 1)
    refused(RuntimeError, r"first must be in \[0, 13\], got 14", tile_costs, sums, 14, 1, 1)
    refused(RuntimeError, "grain must be at least 1, got 0", tile_costs, sums, 1, 2, 0)
    refused(RuntimeError, "there must be views", divide_tiles, [], [half], 4, 1, 8, 2)
    refused(RuntimeError, r"of a view must .* \[5\], got \[4\]", divide_tiles, [half], [], 5, 1, 8, 2)
    with pytest.raises(RuntimeError, match=r"costs of a similar view must have shape \[4\], got \[0\]"):
        divide_tiles([half], [half[:0]], 4, 1, 8, 2)
    refused(RuntimeError, "must be Half, got Float", divide_tiles, [half.float()], [], 4, 1, 8, 2)
    refused(RuntimeError, "exact for a tile_cost from 8 on, got 7", divide_tiles, [half], [], 4, 1, 7, 2)
    for parts in (0, 2**63 - 1):
        with pytest.raises(RuntimeError, match=rf"parts must be 1 to 2\^20, got {parts}"):
            divide_tiles([half], [], 4, 1, 8, parts)
