# SPDX-License-Identifier: Apache-2.0
import time

import cv2
import numpy as np
import pytest

from blitzgs.capture.cameras import scaled_matrix
from blitzgs.capture.lens import Lens
from blitzgs.capture.undistort import rectify

pycolmap = pytest.importorskip("pycolmap")

DISTORTED = {
    "SIMPLE_RADIAL": [500, 320, 240, -0.12],
    "RADIAL": [500, 320, 240, -0.12, 0.03],
    "OPENCV": [500, 505, 322, 238, -0.12, 0.03, 1e-3, -2e-3],
    "FULL_OPENCV": [500, 505, 322, 238, -0.12, 0.03, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003],
    "FOV": [500, 505, 322, 238, 0.7],
    "OPENCV_FISHEYE": [400, 405, 322, 238, 0.02, -0.01, 0.003, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [400, 320, 240, 0.02],
    "RADIAL_FISHEYE": [400, 320, 240, 0.02, -0.01],
    "SIMPLE_FISHEYE": [400, 320, 240],
    "FISHEYE": [400, 405, 322, 238],
    "THIN_PRISM_FISHEYE": [400, 405, 322, 238, 0.02, -0.01, 1e-3, -2e-3, 3e-3, -1e-3, 1e-3, 2e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(400, 405, 322, 238, 0.02, -0.01, 3e-3, -1e-3, 1e-4, 2e-4),
        *(1e-3, -2e-3, 1e-3, 2e-3, -1e-3, 5e-4),
    ],
    "SIMPLE_DIVISION": [500, 320, 240, -0.12],
    "DIVISION": [500, 505, 322, 238, -0.12],
    "EUCM": [400, 405, 322, 238, 0.6, 1.1],
}


def make_lens(model: str) -> Lens:
    return Lens(model, 640, 480, tuple(map(float, DISTORTED[model])))


def test_every_perspective_model_is_covered():
    others = {"INVALID", "SIMPLE_PINHOLE", "PINHOLE", "EQUIRECTANGULAR"}
    assert set(DISTORTED) == set(pycolmap.CameraModelId.__members__) - others


@pytest.mark.parametrize("model", [*DISTORTED, "SIMPLE_PINHOLE", "PINHOLE"])
def test_projection_matches_colmap(model):
    camera = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    if model in DISTORTED:
        camera.params = DISTORTED[model]
    lens = Lens(model, 640, 480, tuple(camera.params.tolist()))
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3))
    points[:, 2] = 1
    points[0, :2] = 0
    expected = camera.img_from_cam(points)
    x, y = lens.project(points[:, 0], points[:, 1])
    np.testing.assert_allclose(np.stack([x, y], axis=1), expected, atol=1e-6)


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV"])
def test_projection_matches_opencv(model):
    lens = make_lens(model)
    uv = np.random.default_rng(1).uniform(-0.6, 0.6, (200, 2))
    rays = np.hstack([uv, np.ones((200, 1))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))
    np.testing.assert_allclose(np.stack(lens.project(*uv.T), axis=1), expected[:, 0], atol=1e-9)


def test_fisheye_projection_matches_opencv():
    lens = make_lens("OPENCV_FISHEYE")
    uv = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 2))
    expected = cv2.fisheye.distortPoints(uv[:, None], lens.matrix, np.array(lens.distortion))
    pixels = np.stack(lens.project(*uv.T), axis=1)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-6)


@pytest.mark.parametrize("model", DISTORTED)
def test_scaling_a_lens_scales_its_pixels(model):
    lens = make_lens(model)
    small = lens.scaled(213, 159)  # ratios that are no whole numbers and differ by axis
    uv = np.random.default_rng(2).uniform(-0.5, 0.5, (2, 100))
    x, y = lens.project(*uv)
    np.testing.assert_allclose(small.project(*uv), (x * 213 / 640, y * 159 / 480), atol=1e-9)


@pytest.mark.parametrize("policy", ["crop", "mask"])
@pytest.mark.parametrize("model", DISTORTED)
def test_a_point_seen_in_the_distorted_image_is_where_the_new_camera_sees_it(model, policy):
    """Dots drawn at the distorted projections of directions must appear at their pinhole projections."""
    lens = make_lens(model)
    plan = rectify(lens, policy)
    inside = np.random.default_rng(3).uniform([30, 30], [plan.width - 30, plan.height - 30], (10, 2))
    directions = np.linalg.solve(plan.K, np.vstack([inside.T, np.ones(10)]))
    columns, rows, seen = plan.maps()
    checked = 0
    for target, (u, v, _) in zip(inside, directions.T, strict=True):
        x, y = lens.project(u, v)
        if not (8 < x < 632 and 8 < y < 472):  # the dot would be cut off
            continue
        assert seen[int(target[1]), int(target[0])]
        yy, xx = np.mgrid[0:480, 0:640] + 0.5
        image = np.exp(-((xx - x) ** 2 + (yy - y) ** 2) / 4.5).astype(np.float32)
        flat = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
        yy, xx = np.mgrid[0 : plan.height, 0 : plan.width] + 0.5
        center = [(xx * flat).sum() / flat.sum(), (yy * flat).sum() / flat.sum()]
        np.testing.assert_allclose(center, target, atol=0.3)
        checked += 1
    assert checked >= (7 if policy == "crop" else 2)


@pytest.mark.parametrize("model", DISTORTED)
def test_cropping_leaves_only_pixels_that_were_seen_and_most_of_them(model):
    lens = make_lens(model)
    crop, mask = rectify(lens, "crop"), rectify(lens, "mask")
    assert crop.maps()[2].all() and not crop.has_invalid
    assert 0 <= crop.K[0, 2] <= crop.width and 0 <= crop.K[1, 2] <= crop.height
    seen = mask.maps()[2].sum()
    assert crop.width * crop.height <= seen + 2 * (mask.width + mask.height)
    assert crop.width * crop.height > 0.6 * seen


def test_strong_distortion_that_folds_back_is_cut_off():
    lens = Lens("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.35))
    u = np.linspace(0, 3, 300)
    assert (np.diff(lens.distort(u, np.zeros_like(u))[0]) < 0).any(), "the test needs a lens that folds"
    plan = rectify(lens, "mask")
    limit = 1 / np.sqrt(3 * 0.35)  # where the derivative of u - 0.35 u^3 vanishes
    assert (plan.width - plan.K[0, 2]) / plan.K[0, 0] <= limit + 1e-2
    columns, rows, seen = plan.maps()
    v, u = np.mgrid[0 : plan.height, 0 : plan.width]
    r = np.hypot((u + 0.5 - plan.K[0, 2]) / 500, (v + 0.5 - plan.K[1, 2]) / 500)
    folded = (r > limit) & (np.abs(columns - 320) < 319) & (np.abs(rows - 240) < 239)
    assert not seen[r > limit + 2e-3].any() and seen[r < 0.3].all()
    assert folded.any(), "the test needs directions that are folded into the image"


def test_planning_a_large_image_does_not_take_its_pixels():
    begin = time.process_time()
    plan = rectify(Lens("OPENCV", 9000, 6000, (8000.0, 8000.0, 4500.0, 3000.0, -0.1, 0.02, 1e-4, 1e-4)))
    assert time.process_time() - begin < 3
    ring = np.arange(plan.width), np.zeros(plan.width)
    x, y = plan.source(*ring)
    assert ((x >= 0) & (x <= 9000) & (y >= 0) & (y <= 6000)).all()


def test_pinholes_and_zero_distortion_stay_as_they_are():
    for model, params in (("PINHOLE", (500, 501, 320, 240)), ("OPENCV", (500, 501, 320, 240, 0, 0, 0, 0))):
        plan = rectify(Lens(model, 640, 480, tuple(map(float, params))))
        assert plan.is_identity and (plan.width, plan.height) == (640, 480)
        np.testing.assert_array_equal(plan.K, plan.lens.matrix)
    assert not rectify(Lens("SIMPLE_FISHEYE", 640, 480, (500.0, 320.0, 240.0))).is_identity


def test_impossible_lenses_are_refused():
    with pytest.raises(ValueError, match="cut them into perspective views"):
        Lens("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))
    with pytest.raises(ValueError, match="finite parameters"):
        Lens("SIMPLE_PINHOLE", 640, 480, (float("nan"), 320.0, 240.0))
    with pytest.raises(ValueError, match="unknown camera model"):
        Lens("NOVEL", 640, 480, (1.0,))
    with pytest.raises(ValueError, match="leaves .* pixel|along its own axis"):
        rectify(Lens("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -4e3)))


def test_scaled_matrix_uses_each_axis_own_ratio():
    K = np.array([[500.0, 0, 320], [0, 505, 240], [0, 0, 1]])
    new = scaled_matrix(K, (641, 481), (160, 120))
    np.testing.assert_allclose(new[0], K[0] * 160 / 641)
    np.testing.assert_allclose(new[1], K[1] * 120 / 481)
    np.testing.assert_array_equal(new[2], [0, 0, 1])
