# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import pytest

from blitzgs.capture.lens import Lens
from blitzgs.capture.undistort import rectify
from blitzgs.training.understood import large_images_hint, undistortion_note


def capture_of(*cameras):
    return SimpleNamespace(cameras=list(cameras), train=list(range(len(cameras))))


@pytest.mark.parametrize(
    ("size", "downscale", "device", "flag"),
    [
        ((1600, 1200), 1, "cpu", None),
        ((5472, 3648), 1, "cpu", "--data.downscale=5"),
        ((2736, 1824), 2, "cpu", "--data.downscale=6"),
        ((4000, 3000), 1, "cuda", None),
        ((5472, 3648), 1, "cuda", "--data.downscale=3"),
    ],
)
def test_large_photographs_get_the_flag(size, downscale, device, flag):
    capture = capture_of(SimpleNamespace(width=size[0], height=size[1]))
    hint = large_images_hint(capture, downscale, device)
    assert hint is None if flag is None else flag in hint and f"{size[0]} x {size[1]}" in hint


@pytest.mark.parametrize(
    ("k1", "policy", "says"),
    [(0.0, "crop", None), (-0.3, "crop", "(data.undistort=mask keeps all"), (-0.3, "mask", "lenses are und")],
)
def test_undistortion_says_the_sizes(k1, policy, says):
    lens = Lens("SIMPLE_RADIAL", 400, 300, (250.0, 200.0, 150.0, k1))
    form = rectify(lens, policy)
    note = undistortion_note(
        capture_of(SimpleNamespace(width=form.width, height=form.height, rectification=form))
    )
    if says is None:
        assert note is None
        return
    assert f"1 photographs from 400 x 300 to {form.width} x {form.height}" in note
    assert (says in note) or form.width * form.height >= 0.9 * 400 * 300
