# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import torch

from blitzgs.view.gate import LodGate
from blitzgs.view.levels import FOOTPRINT_LEVELS, Levels, footprint_levels, footprint_sizes, measure_levels


def cloud(count=5000, seed=0):
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=g, dtype=torch.float64) * torch.tensor([4.0, 6.0, 1.0]).double()
    centres = torch.rand(30, 3, generator=g, dtype=torch.float64) * 4 + torch.tensor([0.0, 0.0, 1.5]).double()
    return points, centres


@pytest.mark.parametrize("fork", [2.0, 1.5])
def test_matches_numpy_quantiles(fork):
    points, centres = (tensor.numpy() for tensor in cloud())
    distances = np.linalg.norm(points[None] - centres[:, None], axis=2)
    d_max = np.quantile(np.quantile(distances, 0.999, axis=1), 0.999)
    d_min = np.quantile(np.quantile(distances, 0.001, axis=1), 0.001)
    box = 1.1 * (np.quantile(points, 0.99, axis=0) - np.quantile(points, 0.01, axis=0)).max()
    count = max(1, round(math.log(d_max / d_min) / math.log(fork)) + 1)
    levels = measure_levels(*cloud(), fork, 0.001)
    assert levels.count == count
    assert levels.reference_distance == pytest.approx(d_max, rel=1e-12)
    assert levels.voxel_size == pytest.approx(box / fork ** (10 - count // 2 + 1), rel=1e-12)


def test_scales_with_the_world_exactly():
    points, centres = cloud()
    levels, scaled = (
        measure_levels(points, centres, 2.0, 0.001),
        measure_levels(points * 64, centres * 64, 2.0, 0.001),
    )
    assert scaled == Levels(levels.count, 2.0, levels.reference_distance * 64, levels.voxel_size * 64)


def test_a_few_points_at_a_horizon_do_not_make_the_voxels_of_the_others_larger():
    points, centres = cloud()
    near = measure_levels(points, centres, 2.0)
    for factor in (1e3, 1e6, 1e30):
        levels = measure_levels(torch.cat([points[:-150], points[-150:] * factor]), centres, 2.0)
        assert levels.voxel_size_of(levels.count - 1) < 2 * near.voxel_size_of(near.count - 1)


def test_farthest_is_where_eq_1_still_rounds_up_to_the_level():
    levels = Levels(count=6, fork=2.0, reference_distance=10.0, voxel_size=1.0)
    for level in range(1, 6):
        d = levels.farthest(level)
        resolved = [round(math.log2(10.0 / (d * factor))) for factor in (0.999, 1.001)]
        assert resolved == [level, level - 1]
    assert levels.farthest(0) == math.inf
    assert levels.voxel_size_of(3) == 0.125


def test_degenerate_input_is_refused():
    points, centres = cloud(10)
    with pytest.raises(ValueError, match="got 0 points and 30 cameras"):
        measure_levels(points[:0], centres, 2.0, 0.001)
    with pytest.raises(ValueError, match="spread out, .* measures 0, .* Check the points of the capture"):
        measure_levels(points[:1].repeat(5, 1), centres, 2.0, 0.001)


def test_levels_of_footprints_leave_out_only_what_is_too_small_and_most_of_that():
    generator = torch.Generator().manual_seed(3)
    scales = torch.rand(4000, 3, generator=generator, dtype=torch.float64) * 6 - 7
    opacities = torch.randn(4000, generator=generator, dtype=torch.float64) * 3
    focal, pixels, distance, fork = 900.0, 0.5, 300.0, 2**0.25
    levels = footprint_levels(footprint_sizes(scales, opacities), focal / pixels, distance, fork)
    reach = torch.tensor(LodGate(distance, fork, FOOTPRINT_LEVELS, FOOTPRINT_LEVELS - 1).reach())
    reach = reach.double()[levels.long()]
    _, middle, largest = scales.exp().sort(1).values.unbind(1)
    size = opacities.sigmoid() * (middle * largest).sqrt()
    kept_to = size * focal / pixels  # the footprint is `pixels` there
    assert (reach >= kept_to * (1 - 1e-9)).all()
    inside = (levels > 0) & (levels < FOOTPRINT_LEVELS - 1)
    assert inside.double().mean() > 0.5 and (reach < kept_to * fork * (1 + 1e-9))[inside].all()
    assert reach[levels == 0].isinf().all()
