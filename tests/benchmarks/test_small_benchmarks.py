# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of one figure: accuracy, host time of a call, gsplat's loop, tiles, popping."""

import json
import re
import sys
from dataclasses import replace

import bm_accuracy
import bm_host
import bm_popping
import bm_tiles
import cv2
import numpy as np
import pytest
import scenes
import surface_city
import torch
from scenes import aerial

from blitzgs import rasterization
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import read_ply
from blitzgs.formats.tiles import write_tiles
from blitzgs.runs import trained_model
from blitzgs.training import setup
from blitzgs.training.trainer import Trainer
from blitzgs.view import levels
from blitzgs_synth.flight import plan_flight
from blitzgs_synth.plan import PRESETS, Plan
from blitzgs_synth.render import City
from tests.formats.test_tiles import SCENE, city
from tests.helpers import refused
from tests.training.tiny import tiny_config, tiny_scene, write_tiny_capture


def test_every_call_is_measured(tmp_path, monkeypatch, capsys):
    arguments = ["--device", "cpu", "--repeats", "3", "--json", str(tmp_path / "host.json")]
    monkeypatch.setattr(sys, "argv", ["bm_host.py", *arguments])
    bm_host.main()
    written = json.loads((tmp_path / "host.json").read_text())
    rows, steps = written["rows"], {row["part"]: row["host us"] for row in written["steps"]}
    assert [row["call"] for row in rows] == list(bm_host.CALLS)
    assert all(row["forward us"] > 0 and row["backward us"] > 0 for row in rows)
    assert "sparse, meta" in capsys.readouterr().out
    assert list(steps) == ["render", "loss", "backward", "optimisers", "all"] and min(steps.values()) > 0
    assert all(row["one optimiser, host us"] > 0 for row in written["steps"])


def test_the_loop_learns_with_each_arm(tmp_path, capsys):
    pytest.importorskip("gsplat", reason="needs gsplat's strategies")
    import bm_drop_in

    write_tiny_capture(tmp_path / "tiny")
    arguments = [str(tmp_path / "tiny"), "--steps", "60", "--arms", "import", "four", "--device", "cpu"]
    arguments += ["--one-thread"]
    one, four = bm_drop_in.main([*arguments, "--json", str(tmp_path / "found.json")])
    assert one["Gaussians"] == four["Gaussians"]
    assert abs(one["PSNR, dB"] - four["PSNR, dB"]) < 0.5
    assert "gsplat's loop, 60 steps of tiny, autograd in one thread" in capsys.readouterr().out
    assert (tmp_path / "found.json").exists()


def test_a_city_of_surfaces_looks_like_its_photographs(tmp_path):
    surface_city.main([str(tmp_path / "city.ply"), "--preset=demo", "--millions=0.1", "--processes=1"])
    model = read_ply(tmp_path / "city.ply")
    assert 90_000 < len(model.means) <= 100_020 and model.means[:, :2].abs().max() < 0.75 * 150
    options = PRESETS["demo"]
    view = plan_flight(options)[7]
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = torch.from_numpy(view.rotation), torch.from_numpy(view.translation)
    K = torch.tensor([[view.focal, 0, view.width / 2], [0, view.focal, view.height / 2], [0, 0, 1]])
    colors, alphas, _ = rasterization(
        model.means, model.quats, model.scales.exp(), model.opacities.sigmoid(), model.sh,
        viewmat[None], K[None].float(), view.width, view.height, sh_degree=3,
    )  # fmt: skip
    photograph = torch.from_numpy(City(Plan(options)).render(view)) / 255
    both = torch.stack((colors[0].mean(-1), photograph.mean(-1)))[:, alphas[0, ..., 0] > 0.5]
    assert alphas.mean() > 0.9 and torch.corrcoef(both)[0, 1] > 0.6


def test_nearer_frames_load_more_and_small_errors_show_everything(tmp_path, capsys):
    write_tiles(tmp_path / "city", city(3000), np.eye(4), SCENE, "city", most=200)
    arguments = [str(tmp_path / "city"), "--frames", "3", "--width", "96", "--errors", "1e-9", "48", "192"]
    bm_tiles.main([*arguments, "--device", "cpu", "--json", str(tmp_path / "found.json")])
    assert "3,000 Gaussians" in capsys.readouterr().out
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    assert len(rows) == 9
    exact, coarse, coarser = ([row for row in rows if row["pixel_error"] == e] for e in (1e-9, 48, 192))
    # Everything that the camera can see is everything that the picture shows.
    assert all(row["psnr"] is None or row["psnr"] > 80 for row in exact)
    for fine, less, least in zip(exact, coarse, coarser, strict=True):
        assert fine["gaussians"] >= less["gaussians"] >= least["gaussians"] > 0
        assert fine["bytes"] >= less["bytes"] and less["loaded_bytes"] >= less["bytes"]
    assert coarse[0]["gaussians"] < exact[0]["gaussians"] == 3000
    assert coarse[0]["psnr"] == pytest.approx(coarse[0]["psnr"]) and 5 < coarse[0]["psnr"] < 80
    assert coarse[-1]["distance"] < coarse[0]["distance"]


FLAGS = ("schedule.iterations=60", "view.lod=true", "schedule.densify_until=40")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("popping") / "run"
    with pytest.MonkeyPatch.context() as patch:
        for module in (setup, levels):  # levels so near that the tiny scene has several
            patch.setattr(module, "FORK", 1.3)
        Trainer(tiny_config(*FLAGS), *tiny_scene(), folder, Ranks()).train()
        yield folder


def test_smooth_levels_pop_less(trained, tmp_path, device, capsys):
    pytest.importorskip("av", reason="the extra film is not installed")
    arguments = [str(trained), "--frames", "200", "--device", device, "--out", str(tmp_path / "shown")]
    bm_popping.main([*arguments, "--json", str(tmp_path / "found.json")])
    assert re.search(r"Popping of run over 200 frames, ([3-9]|\d\d) levels", capsys.readouterr().out)
    full, gated, smooth = json.loads((tmp_path / "found.json").read_text())["rows"]
    assert gated["kept"] < 1 and smooth["kept"] < 1 == full["kept"] and full["largest"] == 0
    assert 0 < smooth["largest"] < 0.7 * gated["largest"]
    assert smooth["pixel"] < 0.7 * gated["pixel"]
    assert gated["largest_change"] > smooth["largest_change"]
    assert 0 < gated["mean"] < gated["largest"] < 255
    assert "<svg" in (tmp_path / "shown" / "popping.svg").read_text()
    clip = cv2.VideoCapture(str(tmp_path / "shown" / "popping.mp4"))
    assert clip.get(cv2.CAP_PROP_FRAME_COUNT) == 200
    assert clip.get(cv2.CAP_PROP_FRAME_WIDTH) == 3 * 48


def test_a_model_of_one_level_does_not_pop(trained, monkeypatch):
    opened = trained_model.open_model

    def flat(*arguments):
        model = opened(*arguments)
        model.table["level"].zero_()
        return model

    monkeypatch.setattr(trained_model, "open_model", flat)
    found = bm_popping.popping(trained, None, frames=4)
    assert found["gated"]["largest"] == 0 < found["full"]["mean_change"]
    assert found["smooth"]["largest"] < 1e-3  # opacities that went through a logit and back
    assert torch.tensor([found["gated"]["kept"], found["smooth"]["kept"]]).eq(1).all()


def test_errors_name_the_remedy(trained):
    refused(ValueError, "at least 2 frames, got 1", bm_popping.popping, trained, frames=1)
    refused(ValueError, "no view 'x.jpg'; .* example 00.png", bm_popping.popping, trained, camera="x.jpg")


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


def test_bounds_are_required(scene):
    exact = bm_accuracy.Option("float64", dtype=torch.float64)
    figures = bm_accuracy.measure(exact, {1: scene}, repeats=1)
    assert figures.image_error < 1e-12 and figures.milliseconds > 0
    bm_accuracy.require_bounds(figures)
    figures.gradient_error = 2e-4
    refused(SystemExit, "gradients 2.0e-04 of 1e-04", bm_accuracy.require_bounds, figures)


def test_an_interrupted_run_keeps_its_measurements(scene, tmp_path, monkeypatch, capsys):
    def measure(option, *_):
        if option.name == "batch of 4 views":
            raise KeyboardInterrupt
        return bm_accuracy.Figures(option.name, 1.0, 1e-6, 1e-5, 0.01)

    monkeypatch.setattr(bm_accuracy, "measure", measure)
    monkeypatch.setattr(bm_accuracy, "aerial", lambda *_, **__: scene)
    path = tmp_path / "accuracy.json"
    monkeypatch.setattr(sys, "argv", ["bm_accuracy.py", "--device", "cpu", "--json", str(path)])
    with pytest.raises(KeyboardInterrupt):
        bm_accuracy.main()
    assert [row["name"] for row in json.loads(path.read_text())["rows"]] == ["default", "antialiased"]
    assert capsys.readouterr().out.splitlines()[-1].startswith("| antialiased |")


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
    points = scene.means @ scene.viewmats[:, :3, :3].mT + scene.viewmats[:, None, :3, 3]
    *pixels, depths = (points @ scene.Ks.mT).unbind(2)
    x, y = (
        (p > 0) & (p < size * depths) for p, size in zip(pixels, (scene.width, scene.height), strict=True)
    )
    fractions = (x & y).float().mean(1)
    assert float(fractions.min()) > 0.08 and float(fractions.max()) < 0.13
    assert float(scene.means[:, :2].abs().max()) < 502
    flattest = scene.scales.argmin(1) == 2
    assert float(flattest.float().mean()) > 0.8
    w, x, y, z = scene.quats[scene.means[:, 2] < 0.2].unbind(1)
    assert float((1 - 2 * (x * x + y * y)).median()) > 0.95  # on the ground, their z axis points up
