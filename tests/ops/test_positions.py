# SPDX-License-Identifier: Apache-2.0
"""What is computed of positions: neighbours, voxels, noise, and the random numbers of rows."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

import blitzgs
from blitzgs.ops.counter_random import hash_keys, normal, uniform
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.population import limit_scales_, position_noise_, voxel_keys
from blitzgs.population.density import rotations
from tests.helpers import refused


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


@pytest.mark.parametrize("k", [1, 3, 6, 32])
@pytest.mark.parametrize("kind", ["uniform", "clusters and outliers", "plane", "duplicates"])
def test_knn_distances_match_a_kd_tree(device, k, kind):
    points = torch.from_numpy(cloud(kind)).float()
    expected = cKDTree(points.double().numpy()).query(points.double().numpy(), k + 1)[0][:, 1:]
    got = knn_distances(points.to(device), k).cpu().double()
    torch.testing.assert_close(got, torch.from_numpy(expected), rtol=1e-6, atol=1e-30)


def test_knn_distances_in_float64_are_exact():
    points = cloud("clusters and outliers", 500)
    expected = cKDTree(points).query(points, 4)[0][:, 1:]
    for function in (knn_distances, blitzgs.knn):
        found = function(torch.from_numpy(points), 3)
        torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-14, atol=0)


def test_rows_that_are_not_finite_are_left_out(device):
    points = torch.from_numpy(cloud("uniform", 200)).float()
    points[7, 1], points[50] = math.nan, math.inf
    good = torch.ones(200, dtype=torch.bool)
    good[[7, 50]] = False
    got = knn_distances(points.to(device), 3).cpu()
    assert got[~good].isinf().all()
    assert torch.equal(got[good], knn_distances(points[good].to(device), 3).cpu())
    assert knn_distances(torch.full((9, 3), math.nan, device=device), 2).isinf().all()


def test_knn_distances_of_small_clouds(device):
    points = torch.tensor([[0.0, 0, 0], [3, 4, 0], [0, 0, 1]], device=device)
    assert knn_distances(points, 4)[0].tolist() == [1.0, 5.0, math.inf, math.inf]
    assert knn_distances(points[:1], 2).tolist() == [[math.inf, math.inf]]
    assert knn_distances(points[:0], 2).shape == (0, 2)


def test_a_hundred_thousand_equal_points(device):
    """Linear time even when every point is the same."""
    got = knn_distances(torch.full((100_000, 3), 0.7, device=device), 3)
    assert (got == 0).all()


def test_knn_distances_errors_name_the_value():
    refused(RuntimeError, r"^blitzgs::knn_.*: k must .* 32\], got 33", knn_distances, torch.zeros(4, 3), 33)
    refused(RuntimeError, r"points .* shape \[\*, 3\], got \[4, 2\]", knn_distances, torch.zeros(4, 2), 3)


def test_knn_distances_opcheck(device):
    torch.library.opcheck(torch.ops.blitzgs.knn_distances, (torch.randn(20, 3, device=device), 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_voxel_keys_matches_the_formula(device, dtype):
    points = torch.randn(1000, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    cells = np.floor((points.double().numpy() + 2.0) / 0.1).clip(0, 2**21 - 1).astype(np.int64)
    expected = cells[:, 0] | cells[:, 1] << 21 | cells[:, 2] << 42
    assert voxel_keys(points.to(device), [-2.0] * 3, 0.1).tolist() == expected.tolist()


def test_non_finite_points_and_empty_input():
    points = torch.tensor([[float("nan"), 0, 0], [0, float("inf"), 0], [0, 0, 0]])
    assert voxel_keys(points, [0, 0, 0], 1.0).tolist() == [-1, -1, 0]
    assert voxel_keys(torch.empty(0, 3), [0, 0, 0], 1.0).shape == (0,)


SEED, STEP, THRESHOLD, STRENGTH = 5, 77, 0.005, 30.0
DRAWS_OF_POSITION_NOISE = 1


def gaussians(count: int = 300, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    return {
        "means": torch.randn(count, 3, generator=g, dtype=torch.float64).to(dtype),
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64).to(dtype),
        "scales": (torch.rand(count, 3, generator=g, dtype=torch.float64) * 4 - 5).to(dtype),
        "opacities": (torch.rand(count, generator=g, dtype=torch.float64) * 12 - 8).to(dtype),
        "ids": torch.randint(0, 1 << 62, (count,), generator=g),
    }


def expected(rows: dict[str, torch.Tensor], visible: torch.Tensor) -> torch.Tensor:
    """The formula in float64."""
    rows = {name: column if name == "ids" else column.double() for name, column in rows.items()}
    axes = rotations(rows["quats"]) * rows["scales"].exp()[:, None]
    draws = normal(rows["ids"][:, None], SEED, DRAWS_OF_POSITION_NOISE, STEP, torch.arange(3))
    gate = torch.sigmoid(100 * (THRESHOLD - rows["opacities"].sigmoid()))
    moves = STRENGTH * gate[:, None] * (axes @ (axes.mT @ draws[..., None])).squeeze(-1)
    means = rows["means"].clone()
    means[visible.long()] += moves[visible.long()]
    return means


def test_position_noise_matches_the_formula(backend):
    device, dtype = backend
    rows = gaussians(dtype=dtype)
    visible = torch.arange(0, 300, 2, dtype=torch.int32)
    on_device = {name: column.clone().to(device) for name, column in rows.items()}
    position_noise_(
        *on_device.values(), visible.to(device), seed=SEED, step=STEP, threshold=THRESHOLD, strength=STRENGTH
    )
    wanted = expected(rows, visible)
    moved = (wanted - rows["means"].double()).norm(dim=1)
    assert 20 < int((moved > 1e-3).sum()) < 140
    # A gate below 2^-24 moves nothing.
    rtol, atol = (0, 1e-6) if dtype == torch.float64 else (2e-6, 2e-6)
    torch.testing.assert_close(on_device["means"].cpu().double(), wanted, rtol=rtol, atol=atol)
    assert torch.equal(on_device["means"].cpu()[1::2], rows["means"][1::2])


def test_position_noise_does_not_depend_on_the_order_of_the_rows():
    rows = gaussians()
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    shuffled = {name: column[order].contiguous() for name, column in rows.items()}
    visible = torch.arange(300, dtype=torch.int32)
    for table in (rows, shuffled):
        position_noise_(
            *table.values(), visible, seed=SEED, step=STEP, threshold=THRESHOLD, strength=STRENGTH
        )
    assert torch.equal(rows["means"][order], shuffled["means"])


def test_errors_name_the_value_of_noise_and_limits():
    rows, visible = gaussians(10), torch.arange(3, dtype=torch.int32)
    with pytest.raises(
        RuntimeError, match="^blitzgs::limit_scales_: share and extent must be positive, got 0"
    ):
        limit_scales_(rows["scales"], rows["means"], visible, share=0.0, extent=1.0)
    rows["scales"] = rows["scales"][:9]
    with pytest.raises(RuntimeError, match=r"^blitzgs::position_noise_: scales must have shape \[10, 3\]"):
        position_noise_(*rows.values(), visible, seed=0, step=0, threshold=0.1, strength=1.0)


def test_scales_are_limited_by_the_distance_from_the_middle(device):
    rows, share, extent = gaussians(), 0.05, 1.5
    visible = torch.arange(0, 300, 2, dtype=torch.int32)
    scales = rows["scales"].clone().to(device)
    limit_scales_(scales, rows["means"].to(device), visible.to(device), share=share, extent=extent)
    limits = (share * rows["means"].double().norm(dim=1).clamp(min=extent)).log()[:, None]
    wanted = torch.minimum(rows["scales"].double(), limits)
    wanted[1::2] = rows["scales"][1::2].double()
    assert 50 < int((wanted < rows["scales"].double() - 1e-4).any(dim=1).sum()) < 140
    torch.testing.assert_close(scales.cpu().double(), wanted, rtol=0, atol=1e-6)
    assert torch.equal(scales.cpu()[1::2], rows["scales"][1::2])


def splitmix(state: int) -> int:
    mask = 2**64 - 1
    state = ((state ^ state >> 30) * 0xBF58476D1CE4E5B9) & mask
    state = ((state ^ state >> 27) * 0x94D049BB133111EB) & mask
    return state ^ state >> 31


def test_hash_is_chained_splitmix64():
    keys = torch.tensor([0, 1, -5, 2**62])
    for key, got in zip(keys.tolist(), hash_keys(keys, 7).tolist(), strict=True):
        state = 0
        for value in (key, 7):
            state = splitmix(((state + 0x9E3779B97F4A7C15) ^ value) % 2**64)
        assert got % 2**64 == state


def test_draws_depend_on_the_key_alone():
    keys = torch.arange(1000)
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    assert torch.equal(uniform(keys, 3)[order], uniform(keys[order], 3))
    assert hash_keys(keys, 3, 4).unique().numel() == 1000
    assert not torch.equal(hash_keys(keys, 3, 4), hash_keys(keys, 4, 3))


def test_draws_have_their_distributions():
    keys = torch.arange(200_000)
    flat, bell = uniform(keys, 1), normal(keys, 1)
    assert flat.min() > 0 and flat.max() < 1
    histogram = torch.histc(flat, bins=20, min=0, max=1)
    assert (histogram - 10_000).abs().max() < 500
    assert abs(bell.mean()) < 0.01 and abs(bell.std() - 1) < 0.01
    assert abs((bell**4).mean() - 3) < 0.1
    assert abs((normal(keys, 2) * bell).mean()) < 0.01
