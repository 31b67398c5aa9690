# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of one figure: host time of a call, gsplat's loop, tiles of a flight, popping of levels."""

import json
import sys

import bm_host
import bm_popping
import bm_tiles
import cv2
import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.formats.tiles import write_tiles
from blitzgs.runs import files as run_files
from blitzgs.training.trainer import Trainer
from tests.formats.test_tiles import SCENE, city
from tests.helpers import DEVICES
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
    *parts, count = steps
    assert parts == ["render", "loss", "backward", "optimisers", "all"] and all(
        steps[name] > 0 for name in parts
    )
    assert count.startswith("torch's operations") and steps[count] > 20
    assert all(row["one optimiser, host us"] > 0 for row in written["steps"])


@pytest.mark.parametrize("in_one", [False, True])
def test_the_trainer_whose_steps_are_measured_learns(in_one):
    trainer = bm_host.Trainer("cpu", in_one)
    before = {name: value.detach().clone() for name, value in trainer.params.items()}
    for _ in range(3):
        trainer.step()
    assert all(not value.equal(before[name]) for name, value in trainer.params.items())


def test_the_loop_learns_with_each_arm(tmp_path, capsys):
    pytest.importorskip("gsplat", reason="needs gsplat's strategies")
    import bm_drop_in

    write_tiny_capture(tmp_path / "tiny")
    arguments = [str(tmp_path / "tiny"), "--steps", "60", "--arms", "import", "four", "--device", "cpu"]
    arguments += ["--one-thread"]
    one, four = bm_drop_in.main([*arguments, "--profile", "--json", str(tmp_path / "found.json")])
    assert one["Gaussians"] == four["Gaussians"]
    assert abs(one["PSNR, dB"] - four["PSNR, dB"]) < 0.5
    printed = capsys.readouterr().out
    assert (
        "gsplat's loop, 60 steps of tiny, autograd in one thread" in printed
        and "four: work of a step" in printed
    )
    assert all(part in printed for part in ("render", "backward", "optimisers", "strategy, after"))
    assert (tmp_path / "found.json").exists()


def test_nearer_frames_load_more_and_small_errors_show_everything(tmp_path, capsys):
    write_tiles(tmp_path / "city", city(3000), np.eye(4), SCENE, "city", most=200)
    arguments = [str(tmp_path / "city"), "--frames", "3", "--width", "96", "--errors", "1e-9", "8", "32"]
    bm_tiles.main([*arguments, "--device", "cpu", "--json", str(tmp_path / "found.json")])
    assert "3,000 Gaussians" in capsys.readouterr().out
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    assert len(rows) == 9
    exact, coarse, coarser = ([row for row in rows if row["pixel_error"] == e] for e in (1e-9, 8, 32))
    # Everything that the camera can see is everything that the picture shows.
    assert all(row["psnr"] is None or row["psnr"] > 80 for row in exact)
    for fine, less, least in zip(exact, coarse, coarser, strict=True):
        assert fine["gaussians"] >= less["gaussians"] >= least["gaussians"] > 0
        assert fine["bytes"] >= less["bytes"] and less["loaded_bytes"] >= less["bytes"]
    assert coarse[0]["gaussians"] < exact[0]["gaussians"] == 3000
    assert coarse[0]["psnr"] == pytest.approx(coarse[0]["psnr"]) and 5 < coarse[0]["psnr"] < 80
    assert coarse[-1]["distance"] < coarse[0]["distance"]


FLAGS = (
    "schedule.iterations=60",
    "view.lod=true",
    "schedule.densify_until=40",
    "lod.fork=1.3",
    "log.pictures=0",
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("popping") / "run"
    Trainer(tiny_config(*FLAGS), *tiny_scene(), folder, Ranks()).train()
    return folder


@pytest.mark.parametrize("device", DEVICES)
def test_smooth_levels_pop_less(trained, tmp_path, device, capsys):
    arguments = [str(trained), "--frames", "200", "--device", device, "--out", str(tmp_path / "shown")]
    bm_popping.main([*arguments, "--json", str(tmp_path / "found.json")])
    assert "Popping of run over 200 frames" in capsys.readouterr().out
    found = bm_popping.popping(trained, None, device, frames=200)
    gated, smooth = found["gated"], found["smooth"]
    assert found["levels"] > 2 and gated["kept"] < 1 and smooth["kept"] < 1
    assert 0 < smooth["largest"] < 0.7 * gated["largest"]
    assert smooth["pixel"] < 0.7 * gated["pixel"]
    assert gated["largest_change"] > smooth["largest_change"]
    assert 0 < gated["mean"] < gated["largest"] < 255
    assert "<svg" in (tmp_path / "shown" / "popping.svg").read_text()
    clip = cv2.VideoCapture(str(tmp_path / "shown" / "popping.mp4"))
    assert clip.get(cv2.CAP_PROP_FRAME_COUNT) == 200
    assert clip.get(cv2.CAP_PROP_FRAME_WIDTH) == 3 * 48


def test_a_model_of_one_level_does_not_pop(trained, monkeypatch):
    opened = run_files.open_model

    def flat(*arguments):
        model = opened(*arguments)
        model.table["level"].zero_()
        return model

    monkeypatch.setattr(run_files, "open_model", flat)
    found = bm_popping.popping(trained, None, frames=4)
    assert found["gated"]["largest"] == 0 < found["full"]["mean_change"]
    assert found["smooth"]["largest"] < 1e-3  # opacities that went through a logit and back
    assert torch.tensor([found["gated"]["kept"], found["smooth"]["kept"]]).eq(1).all()


def test_errors_name_the_remedy(trained):
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        bm_popping.popping(trained, frames=1)
    with pytest.raises(ValueError, match="no view 'x.jpg'; it has for example 00.png"):
        bm_popping.popping(trained, camera="x.jpg")
