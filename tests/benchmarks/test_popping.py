# SPDX-License-Identifier: Apache-2.0
"""The measure of popping: levels that are cut off pop, levels that fade pop less, a single level does not."""

import json
import sys
from pathlib import Path

import cv2
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.runs import files as run_files
from blitzgs.training.trainer import Trainer
from tests.helpers import DEVICES
from tests.training.tiny import tiny_config, tiny_scene

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_popping  # noqa: E402

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


def test_the_curve_has_more_loss_for_more_splats_and_least_for_what_contributes_least(trained, tmp_path):
    path = tmp_path / "curve.json"
    bm_popping.main([str(trained), "--curve", "--device", "cpu", "--json", str(path)])
    lines = json.loads(path.read_text())["rows"]
    rules = {rule: [line for line in lines if line["rule"] == rule] for rule in bm_popping.RULES}
    for some in rules.values():
        shares, light, psnr = (
            [line[key] for line in some] for key in ("left out", "light", "PSNR against all")
        )
        assert shares == pytest.approx(bm_popping.SHARES[: len(some)], abs=0.05)
        assert len(shares) > 3
        assert light == sorted(light) and psnr == sorted(psnr, reverse=True)
    for rule in bm_popping.RULES[:-1]:
        assert all(a["light"] < b["light"] for a, b in zip(rules["contribution"], rules[rule], strict=False))


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
