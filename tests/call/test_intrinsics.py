# SPDX-License-Identifier: Apache-2.0
"""Intrinsics that a pinhole projection does not have are refused where the call can see them."""

import math

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.runs.cameras import checked_camera

GOOD = [[40.0, 0.0, 16.0], [0.0, 42.0, 12.0], [0.0, 0.0, 1.0]]
ENTRIES = [(0, 1, 4.0), (1, 0, 4.0), (2, 0, 0.1), (2, 1, 0.1), (2, 2, 2.0), (2, 2, 0.0)]


def wrong(row, column, value):
    matrix = np.array(GOOD)
    matrix[row, column] = value
    return matrix


def call(name, Ks, dtype=torch.float32):  # noqa: N803
    count = 5
    means = torch.randn(count, 3, dtype=dtype) * 0.1
    quats, scales = torch.ones(count, 4, dtype=dtype), torch.full((count, 3), 0.1, dtype=dtype)
    opacities, viewmats = torch.full((count,), 0.5, dtype=dtype), torch.eye(4, dtype=dtype)[None]
    viewmats = viewmats.clone()
    viewmats[:, 2, 3] = 3
    viewmats = viewmats.expand(len(Ks), 4, 4).contiguous()
    if name == "rasterization":
        colors = torch.rand(count, 3, dtype=dtype)
        return blitzgs.rasterization(means, quats, scales, opacities, colors, viewmats, Ks, 32, 24)[0]
    return blitzgs.contributions(means, quats, scales, opacities, viewmats, Ks, 32, 24)[0]


@pytest.mark.parametrize("name", ["rasterization", "contributions"])
@pytest.mark.parametrize(("row", "column", "value"), ENTRIES)
def test_a_renderer_refuses_them(name, row, column, value):
    Ks = torch.from_numpy(np.stack([np.array(GOOD), wrong(row, column, value)])).float()  # noqa: N806
    call(name, Ks[:1])
    with pytest.raises(ValueError, match=r"Ks\[1\] must be \[\[fx, 0, cx\], .* got"):
        call(name, Ks)


def test_values_that_are_not_finite_and_rounding_are_no_error():
    Ks = torch.tensor([GOOD])  # noqa: N806
    Ks[0, 0, 1], Ks[0, 2, 2] = 1e-6, 1 + 1e-7
    call("rasterization", Ks)
    with pytest.warns(RuntimeWarning, match="NaN"):
        call("rasterization", torch.full((1, 3, 3), math.nan))


@pytest.mark.parametrize(("row", "column", "value"), ENTRIES)
def test_a_camera_refuses_them(row, column, value):
    pose = np.eye(4)
    assert checked_camera("a", 32, 24, GOOD, pose).width == 32
    with pytest.raises(ValueError, match=r"K must be \[\[fx, 0, cx\]"):
        checked_camera("a", 32, 24, wrong(row, column, value), pose)


def test_a_pose_has_a_last_row():
    pose = np.eye(4)
    pose[3] = 1, 2, 3, 4
    with pytest.raises(ValueError, match="the last row of world_to_camera must be 0, 0, 0, 1"):
        checked_camera("a", 32, 24, GOOD, pose)
