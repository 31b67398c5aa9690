# SPDX-License-Identifier: Apache-2.0
"""The examples build, learn, and compute what Python computes."""

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs._library import LIBRARY_DIR
from blitzgs.capture.pictures import save_image
from blitzgs.formats.ply import read_ply
from tests.helpers import orbit_camera, write_colmap

ROOT = Path(__file__).resolve().parents[2]
SCENE = (
    torch.tensor([[-0.5, 0, 3], [0.4, 0.1, 4], [0, -0.3, 5]]),
    torch.tensor([[1, 0, 0, 0], [0.9, 0.1, 0.3, 0.2], [1, 0, 0, 0.5]]),
    torch.tensor([[0.2, 0.3, 0.2], [0.5, 0.1, 0.3], [0.6, 0.6, 0.1]]),
    torch.tensor([0.9, 0.7, 0.8]),
    torch.tensor([[[1, -0.5, -1]], [[-1, 1, 0]], [[0.2, 0, 1.5]]]),
)
CAMERA = (torch.eye(4)[None], torch.tensor([[[100.0, 0, 64], [0, 100, 48], [0, 0, 1]]]), 128, 96)


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    if shutil.which("cmake") is None:
        pytest.skip("needs cmake")
    build = tmp_path_factory.mktemp("cpp") / "build"
    options = [f"-DBLITZGS_TORCH_DIR={Path(torch.__file__).parent}", f"-DBLITZGS_LIBRARY_DIR={LIBRARY_DIR}"]
    subprocess.run(["cmake", "-S", str(ROOT / "examples" / "cpp"), "-B", str(build), *options], check=True)
    done = subprocess.run(["cmake", "--build", str(build), "-j2"], capture_output=True, text=True)
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    return build


def test_the_ops_are_called_from_cpp(build, tmp_path):
    image = tmp_path / "image.f32"
    done = subprocess.run([str(build / "render"), str(image)], check=True, capture_output=True, text=True)
    assert done.stdout == "3 of 3 Gaussians visible\n"
    failed = subprocess.run(
        [str(build / "render"), str(tmp_path / "no" / "image")], capture_output=True, text=True
    )
    assert failed.returncode == 1 and "image cannot be written" in failed.stderr and not failed.stdout
    found = torch.from_numpy(np.fromfile(image, dtype=np.float32)).view(1, 96, 128, 3)
    expected, _, _ = blitzgs.rasterization(*SCENE, *CAMERA, sh_degree=0)
    assert expected.max() > 0.5
    assert torch.equal(found, expected)


def test_gradients_are_computed_from_cpp(build, tmp_path):
    file = tmp_path / "gradient.f32"
    done = subprocess.run([str(build / "fit"), str(file)], check=True, capture_output=True, text=True)
    before, after = re.fullmatch(r"loss (\S+) before and (\S+) after 200 steps\n", done.stdout).groups()
    assert float(after) < 0.1 * float(before)
    target, _, _ = blitzgs.rasterization(*SCENE, *CAMERA, sh_degree=0)
    means = (SCENE[0] + 0.05).requires_grad_()
    image, _, _ = blitzgs.rasterization(means, *SCENE[1:4], 0.7 * SCENE[4], *CAMERA, sh_degree=0)
    loss = (image - target).square().mean()
    assert float(before) == pytest.approx(loss.item(), rel=1e-2)
    loss.backward()
    found = torch.from_numpy(np.fromfile(file, dtype=np.float32)).view(3, 3)
    assert (found - means.grad).abs().max() < 1e-5 * means.grad.abs().max()


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
    names = [f"{view:02}.png" for view in range(VIEWS)]
    for name, image in zip(names, images, strict=True):
        save_image(root / "images" / name, image)
    points = means[::2].double().numpy(), (colors[::2] * 255).byte().numpy()
    camera = (WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0)
    write_colmap(root / "sparse/0", camera, names, poses.double().numpy(), *points)


def example(name):
    """Import an example."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_minimal_trainer_it_learns_a_capture(device, tmp_path, capsys):
    write_capture(tmp_path)
    out = tmp_path / "model.ply"
    torch.manual_seed(0)
    arguments = ["--data", str(tmp_path), "--out", str(out), "--steps", "700", "--device", device]
    model = example("minimal_trainer").main(arguments)
    printed = capsys.readouterr().out
    assert float(printed.split(" dB")[0].split()[-1]) > 18
    written = read_ply(out)
    assert len(written.means) == len(model.params["means"]) > 20
    assert torch.equal(written.scales, model.params["scales"].detach().cpu())
    assert written.sh.shape[1:] == (16, 3)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_research_trainer_it_learns_a_capture(strategy, tmp_path, capsys):
    write_capture(tmp_path)
    torch.manual_seed(0)
    out = tmp_path / "model.ply"
    trainer = example("research_trainer").main(
        ["--data", str(tmp_path), "--out", str(out), "--steps", "210", "--strategy", strategy, "--most", "31",
         "--device", "cpu"]
    )  # fmt: skip
    assert float(capsys.readouterr().out.split(" dB")[0].split()[-1]) > 15
    written = read_ply(out)
    assert len(written.means) == len(trainer.params["means"]) > 25
    if strategy == "mcmc":
        assert len(written.means) == 31
    assert trainer.motions.abs().max() > 0 and trainer.looks.abs().max() > 0.01


def test_the_pose_hook_is_a_rigid_motion():
    kind = example("research_trainer").Trainer
    trainer = kind.__new__(kind)
    trainer.motions, trainer.extent = torch.tensor([[0, 0, 0.3, 0.1, 0.2, -0.1]]), 2.0
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([1.0, 2, 3])
    moved = trainer.pose(0, pose)
    turn = torch.tensor([[0.9553365, -0.2955202, 0], [0.2955202, 0.9553365, 0], [0, 0, 1]])
    assert torch.allclose(moved[:3, :3], turn, atol=1e-6)
    assert torch.allclose(moved[:3, 3], turn @ pose[:3, 3] + torch.tensor([0.2, 0.4, -0.2]), atol=1e-5)
    assert moved[3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("name", ["minimal_trainer", "research_trainer"])
def test_an_example_is_short_and_needs_no_trainer(name):
    text = (ROOT / "examples" / f"{name}.py").read_text()
    assert len(text.splitlines()) <= 150
    assert "blitzgs.training" not in text and "blitzgs.frame.render" not in text
