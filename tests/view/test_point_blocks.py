# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from blitzgs.population.initialisation import _seen_by_more
from blitzgs.view import point_blocks
from blitzgs.view.levels import measure_levels
from blitzgs.view.point_blocks import BLOCK_POINTS, PointBlocks


def flat_scene(points, cameras, seed=0):
    """Points of a wide, flat scene, a third of them at one place, and cameras above it."""
    g = torch.Generator().manual_seed(seed)
    cloud = (
        torch.randn(points, 3, generator=g, dtype=torch.float64) * torch.tensor([50.0, 80.0, 3.0]).double()
    )
    cloud[: points // 3] = cloud[:1]
    centres = torch.randn(cameras, 3, generator=g, dtype=torch.float64) * 60
    centres[:, 2] = 40.0
    return cloud, centres


@pytest.mark.parametrize("count", [1, 2, BLOCK_POINTS, BLOCK_POINTS + 1, 3000])
def test_every_point_is_between_the_bounds_of_its_block(count):
    points, centres = flat_scene(count, 9)
    blocks = PointBlocks.of(points)
    assert sorted(blocks.order.tolist()) == list(range(count))
    distances = (points[blocks.order] - centres[:, None]).norm(dim=2)
    parts = list(blocks.distances(centres))
    assert torch.equal(torch.cat([some for some, _, _ in parts]), centres)
    for bounds, tightest in ((1, torch.amin), (2, torch.amax)):
        bound = torch.cat([part[bounds] for part in parts])
        for block, own in enumerate(distances.split(BLOCK_POINTS, dim=1)):
            edge = tightest(own, dim=1)
            assert (bound[:, block] <= edge).all() if bounds == 1 else (bound[:, block] >= edge).all()
    chosen = torch.arange(len(blocks)) % 2 == 0
    expected = [points[rows] for rows in blocks.order.split(BLOCK_POINTS)[::2]]
    assert torch.equal(blocks.points_of(chosen), torch.cat(expected))


@pytest.mark.parametrize("pairs", [1, 200, 1 << 20])
@pytest.mark.parametrize(("count", "cameras"), [(700, 1), (6000, 150), (40, 300)])
def test_levels_and_visible_voxels_are_those_of_all_distances(monkeypatch, pairs, count, cameras):
    monkeypatch.setattr(point_blocks, "_PAIRS", pairs)
    points, centres = flat_scene(count, cameras, seed=count)
    distances = np.linalg.norm(points.numpy()[None] - centres.numpy()[:, None], axis=2)
    levels = measure_levels(points, centres, 2.0, 0.001)
    d_max = np.quantile(np.quantile(distances, 0.999, axis=1), 0.999)
    assert levels.reference_distance == pytest.approx(d_max, rel=1e-12)
    d_min = np.quantile(np.quantile(distances, 0.001, axis=1), 0.001)
    assert levels.count == round(np.log2(d_max / d_min)) + 1
    for share in (0.0, 0.3, 0.9, 1.0):
        for farthest in (5.0, 45.0, 90.0, 300.0):
            seen = (distances <= farthest).sum(axis=0) / cameras > share
            assert _seen_by_more(points, centres, farthest, share).tolist() == seen.tolist()
