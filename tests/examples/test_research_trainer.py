# SPDX-License-Identifier: Apache-2.0
"""The research trainer learns a capture with each strategy, and its hooks learn what they are for."""

import importlib.util
from pathlib import Path

import pytest
import torch

from blitzgs.formats.ply import read_ply
from tests.examples.test_minimal_trainer import write_capture

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "research_trainer.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("research_trainer", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_it_learns_a_capture(example, strategy, tmp_path, capsys):
    write_capture(tmp_path)
    torch.manual_seed(0)
    out = tmp_path / "model.ply"
    trainer = example.main(
        ["--data", str(tmp_path), "--out", str(out), "--steps", "210", "--strategy", strategy, "--most", "31",
         "--device", "cpu"]
    )  # fmt: skip
    assert float(capsys.readouterr().out.split(" dB")[0].split()[-1]) > 15
    written = read_ply(out)
    assert len(written.means) == len(trainer.params["means"]) > 25
    if strategy == "mcmc":
        assert len(written.means) == 31
    assert trainer.motions.abs().max() > 0 and trainer.looks.abs().max() > 0.01


def test_the_pose_hook_is_a_rigid_motion(example):
    trainer = example.Trainer.__new__(example.Trainer)
    trainer.motions, trainer.extent = torch.tensor([[0, 0, 0.3, 0.1, 0.2, -0.1]]), 2.0
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([1.0, 2, 3])
    moved = trainer.pose(0, pose)
    turn = torch.tensor([[0.9553365, -0.2955202, 0], [0.2955202, 0.9553365, 0], [0, 0, 1]])
    assert torch.allclose(moved[:3, :3], turn, atol=1e-6)
    assert torch.allclose(moved[:3, 3], turn @ pose[:3, 3] + torch.tensor([0.2, 0.4, -0.2]), atol=1e-5)
    assert moved[3].tolist() == [0, 0, 0, 1]


def test_it_is_short():
    assert len(EXAMPLE.read_text().splitlines()) <= 150
