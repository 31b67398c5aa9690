# SPDX-License-Identifier: Apache-2.0
"""Intrinsics that a pinhole projection does not have are refused."""

import math

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.runs.cameras import checked_camera
from tests.helpers import DEVICES

GOOD = [[40.0, 0.0, 16.0], [0.0, 42.0, 12.0], [0.0, 0.0, 1.0]]
ENTRIES = [(0, 1, 4.0), (1, 0, 4.0), (2, 0, 0.1), (2, 1, 0.1), (2, 2, 2.0), (2, 2, 0.0)]


def wrong(row, column, value):
    matrix = np.array(GOOD)
    matrix[row, column] = value
    return matrix


# Calls that take each way through the renderer: queued, in several groups of views, and without a look at
# what each view sees.
CALLS = {
    "rasterization": {},
    "not packed": {"packed": False},
    "40 views": {"views": 40},
    "another tile size": {"tile_size": 8},
    "covars": {"covars": True},
    "no Gaussians": {"count": 0},
    "nothing in sight": {"depth": -3.0},
    "scenes": {"scenes": 2},
    "raw_rasterization": {},
    "raw, 40 views": {"views": 40},
    "contributions": {},
}


def render(name, matrices, device="cpu", count=5, depth=3.0, views=0, scenes=1, covars=False, **options):
    """Render Gaussians with the matrices, repeated until there are so many views."""
    torch.manual_seed(1)
    Ks = torch.from_numpy(np.stack(matrices)).float().to(device)  # noqa: N806
    Ks = Ks[torch.arange(max(views, len(Ks)), device=device).clamp(max=len(Ks) - 1)]  # noqa: N806
    means = torch.randn(count, 3, device=device) * 0.1
    quats, scales = torch.ones(count, 4, device=device), torch.full((count, 3), 0.1, device=device)
    opacities, colors = torch.full((count,), 0.5, device=device), torch.rand(count, 3, device=device)
    viewmats = torch.eye(4, device=device).repeat(len(Ks), 1, 1)
    viewmats[:, 2, 3] = depth
    if name == "contributions":
        return blitzgs.contributions(means, quats, scales, opacities, viewmats, Ks, 32, 24)[0]
    if name.startswith("raw"):
        raw = (means, quats, scales.log(), opacities.logit(), colors[:, None], None)
        return blitzgs.raw_rasterization(*raw, viewmats, Ks, 32, 24, **options)[0]
    given = [means, quats, scales, opacities, colors, viewmats, Ks]
    if scenes > 1:
        given = [tensor.expand(scenes, *tensor.shape).contiguous() for tensor in given]
    if covars:
        options["covars"] = torch.eye(3, device=device).repeat(count, 1, 1) * 0.01
    return blitzgs.rasterization(*given, 32, 24, **options)[0]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CALLS)
def test_a_renderer_refuses_them(name, device):
    good = np.array(GOOD)
    render(name, [good], device, **CALLS[name])
    for entry in ENTRIES:
        with pytest.raises(ValueError, match=r"Ks\[1\] must be \[\[fx, 0, cx\], .* got"):
            render(name, [good, wrong(*entry)], device, **CALLS[name])


@pytest.mark.parametrize("device", DEVICES)
def test_values_that_are_not_finite_and_rounding_are_no_error(device):
    rounded = np.array(GOOD)
    rounded[0, 1], rounded[2, 2] = 1e-6, 1 + 1e-7
    assert torch.equal(
        render("rasterization", [rounded], device), render("rasterization", [np.array(GOOD)], device)
    )
    for name in ("rasterization", "covars"):
        with pytest.warns(RuntimeWarning, match="NaN"):
            render(name, [np.full((3, 3), math.nan)], device, **CALLS[name])


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
