# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from blitzgs.ops.tile_costs import divide_tiles, tile_costs

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
    with pytest.raises(RuntimeError, match="13 costs are not those of the tiles of 2 views"):
        tile_costs(sums, 0, 2, 1)
    with pytest.raises(RuntimeError, match=r"first must be in \[0, 13\], got 14"):
        tile_costs(sums, 14, 1, 1)
    with pytest.raises(RuntimeError, match="grain must be at least 1, got 0"):
        tile_costs(sums, 1, 2, 0)
    with pytest.raises(RuntimeError, match="there must be views"):
        divide_tiles([], [half], 4, 1, 8, 2)
    with pytest.raises(RuntimeError, match=r"costs of a view must have shape \[5\], got \[4\]"):
        divide_tiles([half], [], 5, 1, 8, 2)
    with pytest.raises(RuntimeError, match=r"costs of a similar view must have shape \[4\], got \[0\]"):
        divide_tiles([half], [half[:0]], 4, 1, 8, 2)
    with pytest.raises(RuntimeError, match="must be Half, got Float"):
        divide_tiles([half.float()], [], 4, 1, 8, 2)
    with pytest.raises(RuntimeError, match="exact for a tile_cost from 8 on, got 7"):
        divide_tiles([half], [], 4, 1, 7, 2)
    for parts in (0, 2**63 - 1):
        with pytest.raises(RuntimeError, match=rf"parts must be 1 to 2\^20, got {parts}"):
            divide_tiles([half], [], 4, 1, 8, parts)
