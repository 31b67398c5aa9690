# SPDX-License-Identifier: Apache-2.0
"""The C++ example builds against the installed torch, and makes the image that Python makes."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs._library import LIBRARY_DIR

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_the_ops_are_called_from_cpp(tmp_path):
    build, image = tmp_path / "build", tmp_path / "image.f32"
    options = [
        f"-DBLITZGS_TORCH_DIR={Path(torch.__file__).parent}",
        f"-DBLITZGS_LIBRARY_DIR={LIBRARY_DIR}",
    ]
    subprocess.run(["cmake", "-S", str(ROOT / "examples" / "cpp"), "-B", str(build), *options], check=True)
    subprocess.run(["cmake", "--build", str(build)], check=True)
    done = subprocess.run([str(build / "render"), str(image)], check=True, capture_output=True, text=True)
    assert done.stdout == "3 of 3 Gaussians visible\n"
    failed = subprocess.run(
        [str(build / "render"), str(tmp_path / "no" / "image")], capture_output=True, text=True
    )
    assert failed.returncode == 1 and "image cannot be written" in failed.stderr and not failed.stdout
    found = torch.from_numpy(np.fromfile(image, dtype=np.float32)).view(1, 96, 128, 3)
    expected, _, _ = blitzgs.rasterization(
        torch.tensor([[-0.5, 0, 3], [0.4, 0.1, 4], [0, -0.3, 5]]),
        torch.tensor([[1, 0, 0, 0], [0.9, 0.1, 0.3, 0.2], [1, 0, 0, 0.5]]),
        torch.tensor([[0.2, 0.3, 0.2], [0.5, 0.1, 0.3], [0.6, 0.6, 0.1]]),
        torch.tensor([0.9, 0.7, 0.8]),
        torch.tensor([[[1, -0.5, -1]], [[-1, 1, 0]], [[0.2, 0, 1.5]]]),
        torch.eye(4)[None],
        torch.tensor([[[100.0, 0, 64], [0, 100, 48], [0, 0, 1]]]),
        128,
        96,
        sh_degree=0,
    )
    assert expected.max() > 0.5
    assert torch.equal(found, expected)
