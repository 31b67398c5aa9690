# SPDX-License-Identifier: Apache-2.0
"""The C++ examples build against the installed torch, and compute what Python computes."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs._library import LIBRARY_DIR

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
    options = [
        f"-DBLITZGS_TORCH_DIR={Path(torch.__file__).parent}",
        f"-DBLITZGS_LIBRARY_DIR={LIBRARY_DIR}",
    ]
    subprocess.run(["cmake", "-S", str(ROOT / "examples" / "cpp"), "-B", str(build), *options], check=True)
    subprocess.run(["cmake", "--build", str(build), "-j2"], check=True)
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
