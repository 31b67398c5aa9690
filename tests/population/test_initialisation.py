# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch

from blitzgs.population.initialisation import octree_gaussians
from blitzgs.view.levels import Levels, measure_levels


def scene(scale=1.0):
    g = torch.Generator().manual_seed(1)
    points = torch.rand(3000, 3, generator=g, dtype=torch.float64) * torch.tensor([4.0, 4.0, 0.2]).double()
    colors = torch.randint(0, 256, (3000, 3), generator=g, dtype=torch.uint8)
    centres = torch.rand(20, 3, generator=g, dtype=torch.float64) * 3 + torch.tensor([0.0, 0.0, 0.5]).double()
    return points * scale, colors, centres * scale


def make(points, colors, centres, threshold=0.5):
    levels = measure_levels(points, centres, 2.0, 0.01)
    return levels, octree_gaussians(points, colors, centres, levels, threshold).table(2, 0.1)


def brute_force(points, colors, centres, levels: Levels, threshold):
    """Return [(level, mean, colour)] one voxel at a time."""
    origin = points.min(axis=0)
    kept = []
    for level in range(levels.count):
        size = levels.voxel_size / 2.0**level
        cells = np.floor((points - origin) / size).astype(int)
        for cell in {tuple(c) for c in cells}:
            inside = (cells == cell).all(axis=1)
            mean = origin + (np.array(cell) + 0.5) * size
            distances = np.linalg.norm(centres - mean, axis=1)
            finest = np.clip(np.round(np.log2(levels.reference_distance / distances)), 0, levels.count - 1)
            if (finest >= level).mean() > threshold:
                kept.append((level, mean, colors[inside].mean(axis=0)))
    return kept


@pytest.mark.parametrize("threshold", [0.9, 0.3])
def test_voxels_match_brute_force(threshold):
    points, colors, centres = scene()
    levels, table = make(points, colors, centres, threshold)
    expected = brute_force(points.numpy(), colors.double().numpy(), centres.numpy(), levels, threshold)
    assert levels.count > 2 and len(table) == len(expected)
    colour = table["sh"][:, 0] * 0.28209479 + 0.5
    got = torch.cat((table["level"][:, None], table["means"], colour * 255), dim=1).double().numpy()
    want = np.array([[level, *mean, *colour] for level, mean, colour in expected])
    order = [np.lexsort(np.round(rows[:, :4], 4).T) for rows in (got, want)]
    np.testing.assert_allclose(got[order[0]], want[order[1]], atol=2e-3)
    assert table["id"].tolist() == list(range(len(table)))
    assert not table["sh"][:, 1:].any()


def test_shape_and_opacity_of_the_first_gaussians():
    levels, table = make(*scene())
    distances = torch.cdist(table["means"].double(), table["means"].double()).fill_diagonal_(math.inf)
    spacing = distances.topk(3, largest=False).values.mean(dim=1)
    smallest = 1e-4 * levels.voxel_size
    torch.testing.assert_close(
        table["scales"].double().exp(),
        spacing.clamp(min=smallest)[:, None].expand(-1, 3),
        rtol=1e-4,
        atol=1e-6,
    )
    torch.testing.assert_close(table["opacities"].sigmoid(), torch.full((len(table),), 0.1))
    assert torch.equal(table["quats"], torch.tensor([1.0, 0, 0, 0]).expand(len(table), 4))


def test_scales_with_the_world():
    points, colors, centres = scene()
    _, table = make(points, colors, centres)
    _, scaled = make(points * 32, colors, centres * 32)
    assert torch.equal(scaled["means"], table["means"] * 32)
    assert torch.equal(scaled["level"], table["level"]) and torch.equal(scaled["sh"], table["sh"])


def test_a_stray_point_does_not_spoil_the_grid():
    points, colors, centres = scene()
    _, table = make(points, colors, centres)
    stray = torch.cat((points, torch.full((1, 3), -1e9, dtype=torch.float64)))
    levels = measure_levels(points, centres, 2.0, 0.01)
    spoilt = octree_gaussians(stray, torch.cat((colors, colors[:1])), centres, levels, 0.5).table(2, 0.1)
    assert abs(len(spoilt) - len(table)) < 0.1 * len(table)
    assert spoilt["means"].abs().max() < 10


def test_one_point():
    levels = Levels(1, 2.0, 1.0, 0.1)
    one = octree_gaussians(
        torch.zeros(1, 3, dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.uint8),
        torch.ones(2, 3, dtype=torch.float64),
        levels,
        0.9,
    ).table(sh_degree=0, opacity=0.1)
    assert len(one) == 1 and bool(one["scales"].isfinite().all())


def test_parts_of_the_first_gaussians_are_rows_of_the_whole_table():
    points, colors, centres = scene()
    first = octree_gaussians(points, colors, centres, measure_levels(points, centres, 2.0, 0.01), 0.5)
    whole, parts = first.table(1, 0.1), [first.table(1, 0.1, part=slice(rank, None, 3)) for rank in range(3)]
    for rank, part in enumerate(parts):
        for name in whole:
            assert torch.equal(part[name], whole[name][rank::3]), name
    assert sum(len(part) for part in parts) == len(whole) == len(first)


@pytest.mark.parametrize("most", [0, 1, 2, 40, 333, 10**6])
def test_a_limit_keeps_the_coarsest_levels_and_a_random_part_of_the_next(most):
    points, colors, centres = scene()
    levels = measure_levels(points, centres, 2.0)
    whole = octree_gaussians(points, colors, centres, levels, 0.5)
    some = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=3)
    assert len(some) == (min(most, len(whole)) or len(whole)) and some.found == len(whole)
    counts = [(whole.levels == level).sum().item() for level in range(levels.count)]
    for level, count in enumerate(counts):
        left = max(0, len(some) - sum(counts[:level]))
        assert (some.levels == level).sum() == min(count, left)
    # All of them are first Gaussians, with sizes that fit their own neighbours.
    rows = {tuple(row) for row in whole.means.tolist()}
    assert all(tuple(row) in rows for row in some.means.tolist())
    if 1 < len(some) < len(whole):
        assert some.log_scales.mean() > whole.log_scales.mean()
        again = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=3)
        other = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=4)
        assert torch.equal(again.means, some.means) and not torch.equal(other.means, some.means)
