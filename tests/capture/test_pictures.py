# SPDX-License-Identifier: Apache-2.0
"""Pictures that are written, and the former name of the folder."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from blitzgs.capture.pictures import comparison, error_map, save_image, strip, to_uint8


def test_saved_pictures_are_rgb_rounded_and_clamped(tmp_path):
    image = torch.tensor([[[1.5, 0.5, -1.0], [float("inf"), 0.0, 1.0]]])
    assert to_uint8(image).tolist() == [[[255, 128, 0], [255, 0, 255]]]
    save_image(tmp_path / "new" / "a.png", image)
    found = cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1]
    np.testing.assert_array_equal(found, to_uint8(image))
    whole = torch.randint(0, 256, (4, 5, 3), dtype=torch.uint8)
    save_image(tmp_path / "b.png", whole)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b.png"))[..., ::-1], whole)


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (torch.full((2, 2, 3), float("nan")), ValueError, "image has NaN in 12 of 12 values"),
        (np.zeros((2, 2, 3)), TypeError, "image must be a torch.Tensor, got ndarray: convert it with"),
        ("a.jpg", TypeError, "image must be a torch.Tensor, got str"),
        (None, TypeError, "image must be a torch.Tensor, got NoneType"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path, image, error, message):
    with pytest.raises(error, match=message):
        save_image(tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()


def test_unwritable_pictures_are_named(tmp_path):
    with pytest.raises(ValueError, match="cannot write a picture as '.unknown'"):
        save_image(tmp_path / "a.unknown", torch.zeros(2, 2, 3))
    (tmp_path / "target.png").write_bytes(b"precious")
    (tmp_path / "link.png").symlink_to(tmp_path / "target.png")
    with pytest.raises(OSError, match="link.png is a symbolic link, which is not overwritten"):
        save_image(tmp_path / "link.png", torch.zeros(2, 2, 3))
    assert (tmp_path / "target.png").read_bytes() == b"precious"


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 1), (4, 5, 4), (1, 4, 5, 3)], ids=str)
def test_pictures_of_other_shapes_are_refused(tmp_path, shape):
    with pytest.raises(ValueError, match=r"an image must be \[H, W, 3\], got"):
        save_image(tmp_path / "a.png", torch.zeros(shape))


def test_error_map_runs_from_blue_to_red_and_masked_pixels_are_grey():
    target = torch.full((1, 4, 3), 100, dtype=torch.uint8)
    render = target.float() / 255 + torch.tensor([0.0, 0.1, 0.25, 0.6])[None, :, None]
    colors = error_map(render, target, torch.tensor([[1, 1, 1, 0]])).int()[0]
    assert colors[3].tolist() == [128, 128, 128]
    assert colors[2][0] > 100 > colors[2][2] and colors[0][0] < 100
    everywhere = error_map(render, target).int()[0]
    assert torch.equal(everywhere[2], everywhere[3])


def test_comparison_strip_holds_all_three(tmp_path):
    render, target = torch.rand(20, 30, 3), torch.randint(0, 256, (20, 30, 3), dtype=torch.uint8)
    save_image(tmp_path / "c.png", comparison(render, target))
    found = torch.from_numpy(cv2.imread(str(tmp_path / "c.png"))[..., ::-1].copy())
    assert found.shape == (44, 98, 3)
    np.testing.assert_array_equal(found[24:, :30], to_uint8(render))
    np.testing.assert_array_equal(found[24:, 34:64], target)
    np.testing.assert_array_equal(found[24:, 68:], error_map(render, target))
    assert (found[:24, :30] < 128).any(), "the label is drawn"
    assert all((found[:24, right - 4 : right] > 200).all() for right in (30, 64, 98)), "no label is cut off"
    with pytest.raises(ValueError, match="images of one height"):
        strip([render, render[:5]], ["a", "b"])


def test_code_that_imports_the_former_name_gets_the_same_modules():
    program = (
        "from blitzgs.scene.pictures import save_image as former\n"
        "from blitzgs.capture.pictures import save_image\n"
        "assert former is save_image\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
