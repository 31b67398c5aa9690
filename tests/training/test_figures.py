# SPDX-License-Identifier: Apache-2.0
"""Figures of masked views, of training views and of models without Gaussians."""

import json

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.runs.guard import ModelLostError
from blitzgs.training.trainer import Trainer
from tests.training.tiny import tiny_config, tiny_scene


def test_a_fully_masked_view_counts_for_nothing(tmp_path, capsys):
    capture, images = tiny_scene()
    capture.train, capture.test = [1, 2, 4, 5, 6, 7], [0, 3]
    images.masks = [None] * 8
    config = tiny_config("schedule.iterations=20")
    plain = Trainer(config, capture, images, tmp_path / "plain", Ranks()).train()
    images.masks[3] = torch.zeros(32, 48, dtype=torch.uint8)
    with pytest.warns(UserWarning, match="1 of 2 views cannot be measured, as they are masked: 03.png"):
        summary = Trainer(config, capture, images, tmp_path / "masked", Ranks()).train()
    views = [
        json.loads((tmp_path / name / "evaluation" / "000020" / "metrics.json").read_text())["views"]
        for name in ("plain", "masked")
    ]
    assert list(views[0]) == ["00.png", "03.png"] and list(views[1]) == ["00.png"]
    assert summary["psnr"] == views[0]["00.png"]["psnr"] != plain["psnr"]
    images.masks[0] = images.masks[3]
    with pytest.warns(
        UserWarning, match="2 of 2 views cannot be measured, as they are masked: 00.png, 03.png"
    ):
        summary = Trainer(config, capture, images, tmp_path / "nothing", Ranks()).train()
    assert "psnr" not in summary and "evaluation: all pixels are masked" in capsys.readouterr().out


def test_figures_of_training_views_are_called_so(tmp_path, capsys):
    capture, images = tiny_scene()
    capture.train, capture.test = list(range(8)), []
    summary = Trainer(tiny_config("schedule.iterations=2"), capture, images, tmp_path, Ranks()).train()
    assert summary["split"] == "train"
    assert "evaluation of TRAINING views (none is held out)" in capsys.readouterr().out


def test_a_model_without_gaussians_is_no_result(tmp_path):
    config = tiny_config("population.min_opacity=0.98", "population.reset_opacity=0.99")
    running = Trainer(config, *tiny_scene(), tmp_path / "a", Ranks())
    with pytest.raises(ModelLostError, match="the density event after 20 images pruned the last Gaussian"):
        running.train()
    running = Trainer(tiny_config("schedule.iterations=2"), *tiny_scene(), tmp_path / "b", Ranks())
    running.state.table.keep(torch.zeros(len(running.state.table), dtype=torch.bool))
    running.state.stepper.reindex()
    with pytest.raises(ModelLostError, match="no Gaussian is left"):
        running.train()
    assert not list(tmp_path.glob("*/checkpoints/*"))
