# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from blitzgs.ops.knn_distances import knn_distances
from tests.helpers import DEVICES


def cloud(kind, n=3000):
    generator = np.random.default_rng(0)
    if kind == "uniform":
        return generator.random((n, 3))
    if kind == "clusters and outliers":
        centres = generator.normal(size=(20, 3)) * 100
        points = centres[generator.integers(20, size=n)] + 1e-3 * generator.normal(size=(n, 3))
        points[:5] *= 1e4
        return points
    if kind == "plane":
        return np.c_[generator.random((n, 2)), np.zeros(n)]
    points = generator.random((n, 3)).round(1)  # many duplicates
    return points


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("k", [1, 3, 6, 32])
@pytest.mark.parametrize("kind", ["uniform", "clusters and outliers", "plane", "duplicates"])
def test_matches_a_kd_tree(device, k, kind):
    points = torch.from_numpy(cloud(kind)).float()
    expected = cKDTree(points.double().numpy()).query(points.double().numpy(), k + 1)[0][:, 1:]
    got = knn_distances(points.to(device), k).cpu().double()
    torch.testing.assert_close(got, torch.from_numpy(expected), rtol=1e-6, atol=1e-30)


def test_float64_is_exact():
    points = cloud("clusters and outliers", 500)
    expected = cKDTree(points).query(points, 4)[0][:, 1:]
    torch.testing.assert_close(
        knn_distances(torch.from_numpy(points), 3), torch.from_numpy(expected), rtol=1e-14, atol=0
    )


@pytest.mark.parametrize("device", DEVICES)
def test_rows_that_are_not_finite_are_left_out(device):
    points = torch.from_numpy(cloud("uniform", 200)).float()
    points[7, 1], points[50] = math.nan, math.inf
    good = torch.ones(200, dtype=torch.bool)
    good[[7, 50]] = False
    got = knn_distances(points.to(device), 3).cpu()
    assert got[~good].isinf().all()
    assert torch.equal(got[good], knn_distances(points[good].to(device), 3).cpu())
    assert knn_distances(torch.full((9, 3), math.nan, device=device), 2).isinf().all()


@pytest.mark.parametrize("device", DEVICES)
def test_small_clouds(device):
    points = torch.tensor([[0.0, 0, 0], [3, 4, 0], [0, 0, 1]], device=device)
    assert knn_distances(points, 4)[0].tolist() == [1.0, 5.0, math.inf, math.inf]
    assert knn_distances(points[:1], 2).tolist() == [[math.inf, math.inf]]
    assert knn_distances(points[:0], 2).shape == (0, 2)


@pytest.mark.parametrize("device", DEVICES)
def test_a_hundred_thousand_equal_points(device):
    """Linear time even when every point is the same."""
    got = knn_distances(torch.full((100_000, 3), 0.7, device=device), 3)
    assert (got == 0).all()


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match=r"k must be in \[1, 32\], got 33"):
        knn_distances(torch.zeros(4, 3), 33)
    with pytest.raises(RuntimeError, match=r"points must have shape \[\*, 3\], got \[4, 2\]"):
        knn_distances(torch.zeros(4, 2), 3)


@pytest.mark.parametrize("device", DEVICES)
def test_opcheck(device):
    torch.library.opcheck(torch.ops.blitzgs.knn_distances, (torch.randn(20, 3, device=device), 3))
