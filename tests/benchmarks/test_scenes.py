# SPDX-License-Identifier: Apache-2.0
"""The benchmark inputs have the properties that their docstrings state."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch


@pytest.fixture(scope="module")
def scenes():
    path = Path(__file__).parents[2] / "benchmarks" / "scenes.py"
    spec = importlib.util.spec_from_file_location("benchmark_scenes", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["aerial", "garden_like"])
def test_seeded_shapes_and_ranges(scenes, name):
    make = getattr(scenes, name)
    first, again, other = make(5001, views=3), make(5001, views=3), make(5001, views=3, seed=1)
    for key in ("means", "quats", "scales", "opacities", "sh"):
        value = getattr(first, key)
        assert len(value) == 5001 and bool(value.isfinite().all())
        assert torch.equal(value, getattr(again, key))
        assert not torch.equal(value, getattr(other, key))
    assert first.sh.shape == (5001, 16, 3)
    assert first.viewmats.shape == (3, 4, 4) and first.first_views(1).Ks.shape == (1, 3, 3)
    torch.testing.assert_close(first.quats.norm(dim=1), torch.ones(5001))
    torch.testing.assert_close(first.raw()["scales"].exp(), first.scales)
    torch.testing.assert_close(first.raw()["opacities"].sigmoid(), first.opacities)
    assert len(make(0).means) == 0


def test_aerial_workload(scenes):
    scene = scenes.aerial(100_000, views=4)
    fractions = scene.centres_in_view()
    assert float(fractions.min()) > 0.08 and float(fractions.max()) < 0.13
    assert float(scene.means[:, :2].abs().max()) < 502
    flattest = scene.scales.argmin(1) == 2
    assert float(flattest.float().mean()) > 0.8


def test_aerial_gaussians_lie_in_their_surface(scenes):
    scene = scenes.aerial(50_000)
    on_ground = scene.means[:, 2] < 0.2
    w, x, y, z = scene.quats[on_ground].unbind(1)
    up = 1 - 2 * (x * x + y * y)  # z component of the turned z axis
    assert float(up.median()) > 0.95
