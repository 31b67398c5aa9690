# SPDX-License-Identifier: Apache-2.0
"""The minimal trainer learns a capture that our own kernels rendered, on each device."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import blitzgs
from blitzgs.capture.colmap import ColmapCamera, ColmapImages, ColmapModel, ColmapPoints, write_model
from blitzgs.capture.pictures import save_image
from blitzgs.formats.ply import read_ply
from tests.helpers import DEVICES, orbit_camera

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "minimal_trainer.py"
WIDTH, HEIGHT, VIEWS = 64, 48, 12


def write_capture(root):
    """Twelve views of coloured blobs, and a point for every other of them."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(60, 3, generator=generator) * 2 - 1
    colors = torch.rand(60, 3, generator=generator)
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    poses = torch.stack([orbit_camera(2 * np.pi * view / VIEWS) for view in range(VIEWS)]).float()
    images, _, _ = blitzgs.rasterization(
        means, torch.tensor([[1.0, 0, 0, 0]]).expand(60, 4), torch.full((60, 3), 0.15),
        torch.full((60,), 0.9), colors, poses, K.expand(VIEWS, 3, 3), WIDTH, HEIGHT,
    )  # fmt: skip
    quats = Rotation.from_matrix(poses[:, :3, :3].double().numpy()).as_quat()[:, [3, 0, 1, 2]]
    names = [f"{view:02}.png" for view in range(VIEWS)]
    for name, image in zip(names, images, strict=True):
        save_image(root / "images" / name, image)
    ids = np.arange(1, VIEWS + 1, dtype="u4")
    points = ColmapPoints(
        ids=np.arange(1, 31), positions=means[::2].double().numpy(),
        colors=(colors[::2] * 255).byte().numpy(), errors=np.zeros(30), track_offsets=np.zeros(31, "u8"),
    )  # fmt: skip
    model = ColmapModel(
        [ColmapCamera(1, "PINHOLE", WIDTH, HEIGHT, np.array([60.0, 60, 32, 24]))],
        ColmapImages(
            ids=ids, camera_ids=np.ones(VIEWS, "u4"), quats=quats,
            translations=poses[:, :3, 3].double().numpy(), names=names,
            point2d_offsets=np.zeros(VIEWS + 1, "u8"),
        ),
        points,
    )  # fmt: skip
    (root / "sparse" / "0").mkdir(parents=True)
    write_model(root / "sparse" / "0", model)


@pytest.mark.parametrize("device", DEVICES)
def test_it_learns_a_capture(device, tmp_path, capsys):
    write_capture(tmp_path)
    spec = importlib.util.spec_from_file_location("minimal_trainer", EXAMPLE)
    trainer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(trainer)
    out = tmp_path / "model.ply"
    torch.manual_seed(0)
    model = trainer.main(["--data", str(tmp_path), "--out", str(out), "--steps", "700", "--device", device])
    printed = capsys.readouterr().out
    assert float(printed.split(" dB")[0].split()[-1]) > 18
    written = read_ply(out)
    assert len(written.means) == len(model.params["means"]) > 20
    assert torch.equal(written.scales, model.params["scales"].detach().cpu())
    assert written.sh.shape[1:] == (16, 3)


def test_it_is_short_and_needs_no_trainer():
    text = EXAMPLE.read_text()
    assert len(text.splitlines()) <= 150
    assert "blitzgs.training" not in text and "blitzgs.frame.frame" not in text
