# SPDX-License-Identifier: Apache-2.0
"""The accuracy benchmark measures an error that a test puts into it, and scenes are as stated."""

import json
import sys
from dataclasses import asdict, replace

import bm_accuracy
import pytest
import scenes
import torch
from scenes import aerial

from tests.helpers import needs_cuda


@pytest.fixture(scope="module")
def scene():
    return aerial(600, width=24, height=16)


def errors(scene, name, **changes):
    option = next(option for option in bm_accuracy.options_for("cpu") if option.name == name)
    return bm_accuracy.errors(scene, bm_accuracy.Renderer(scene, replace(option, **changes)))


def test_the_default_is_exact_to_float_rounding(scene):
    image_error, gradient_error, cut = errors(scene, "default")
    assert 0 < image_error < 1e-5 and 0 < gradient_error < 1e-4 and cut < 0.05
    assert errors(scene, "exchange")[0] == image_error


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("option", bm_accuracy.options_for("cuda"), ids=lambda option: option.name)
def test_every_option_keeps_the_bounds_on_cuda(option):
    scene = aerial(300_000, "cuda", views=option.views, width=1200, height=800)
    image_error, gradient_error, _ = bm_accuracy.errors(scene, bm_accuracy.Renderer(scene, option))
    assert image_error <= bm_accuracy.IMAGE_BOUND and gradient_error <= bm_accuracy.GRADIENT_BOUND


@pytest.mark.parametrize("antialiased", [False, True])
def test_windows_of_a_large_image_are_the_image(antialiased):
    scene = aerial(5_000, views=2, width=150, height=100)
    windows = bm_accuracy.exact_windows(scene, antialiased)
    assert 0 < len(windows.ids) < 5_000 and len(windows.places) == 14
    image_error, gradient_error, _ = errors(scene, "float64", antialiased=antialiased)
    assert image_error < 1e-12 and gradient_error < 1e-12


def test_the_accuracy_report_is_written_and_bounds_are_required(scene, tmp_path):
    exact = bm_accuracy.Option("float64", dtype=torch.float64)
    figures = bm_accuracy.measure(exact, {1: scene}, repeats=1)
    assert figures.image_error < 1e-12 and figures.milliseconds > 0
    bm_accuracy.write([figures], tmp_path)
    assert (tmp_path / "accuracy.md").read_text().splitlines()[-1].startswith("| float64 |")
    assert json.loads((tmp_path / "accuracy.json").read_text()) == [asdict(figures)]
    bm_accuracy.require_bounds(figures)
    figures.gradient_error = 2e-4
    with pytest.raises(SystemExit, match="gradients 2.0e-04 of 1e-04"):
        bm_accuracy.require_bounds(figures)


def test_an_interrupted_run_keeps_its_measurements(scene, tmp_path, monkeypatch, capsys):
    def measure(option, *_):
        if option.name == "batch of 4 views":
            raise KeyboardInterrupt
        return bm_accuracy.Figures(option.name, 1.0, 1e-6, 1e-5, 0.01)

    monkeypatch.setattr(bm_accuracy, "measure", measure)
    monkeypatch.setattr(bm_accuracy, "aerial", lambda *_, **__: scene)
    monkeypatch.setattr(sys, "argv", ["bm_accuracy.py", "--device", "cpu", "--out", str(tmp_path)])
    with pytest.raises(KeyboardInterrupt):
        bm_accuracy.main()
    names = [row["name"] for row in json.loads((tmp_path / "accuracy.json").read_text())]
    assert names == ["default", "antialiased"]
    for text in ((tmp_path / "accuracy.md").read_text(), capsys.readouterr().out):
        assert text.splitlines()[-1].startswith("| antialiased |")


@pytest.mark.parametrize("name", ["aerial", "garden_like"])
def test_seeded_shapes_and_ranges(name):
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


def test_aerial_workload():
    scene = aerial(100_000, views=4)
    fractions = scene.centres_in_view()
    assert float(fractions.min()) > 0.08 and float(fractions.max()) < 0.13
    assert float(scene.means[:, :2].abs().max()) < 502
    flattest = scene.scales.argmin(1) == 2
    assert float(flattest.float().mean()) > 0.8


def test_aerial_gaussians_lie_in_their_surface():
    scene = aerial(50_000)
    on_ground = scene.means[:, 2] < 0.2
    w, x, y, z = scene.quats[on_ground].unbind(1)
    up = 1 - 2 * (x * x + y * y)  # z component of the turned z axis
    assert float(up.median()) > 0.95
