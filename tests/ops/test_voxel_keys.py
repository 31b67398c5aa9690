# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.voxel_keys import voxel_keys
from tests.helpers import needs_cuda

CUDA = pytest.param("cuda", torch.float32, marks=[pytest.mark.cuda, needs_cuda])


@pytest.mark.parametrize(("device", "dtype"), [("cpu", torch.float32), ("cpu", torch.float64), CUDA])
def test_matches_the_formula(device, dtype):
    points = torch.randn(1000, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))
    cells = ((points.double() + 2.0) / 0.1).floor().clamp(0, 2**21 - 1).long()
    expected = cells[:, 0] | cells[:, 1] << 21 | cells[:, 2] << 42
    assert torch.equal(voxel_keys(points.to(device), [-2.0] * 3, 0.1).cpu(), expected)


def test_non_finite_points_and_empty_input():
    points = torch.tensor([[float("nan"), 0, 0], [0, float("inf"), 0], [0, 0, 0]])
    assert voxel_keys(points, [0, 0, 0], 1.0).tolist() == [-1, -1, 0]
    assert voxel_keys(torch.empty(0, 3), [0, 0, 0], 1.0).shape == (0,)


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match=r"points must have shape \[\*, 3\], got \[4, 2\]"):
        voxel_keys(torch.zeros(4, 2), [0, 0, 0], 1.0)
    with pytest.raises(RuntimeError, match="voxel_size must be positive, got 0"):
        voxel_keys(torch.zeros(4, 3), [0, 0, 0], 0.0)


def test_opcheck():
    torch.library.opcheck(torch.ops.blitzgs.voxel_keys, (torch.randn(5, 3), [0.0, 0.0, 0.0], 0.5))
