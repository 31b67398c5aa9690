# SPDX-License-Identifier: Apache-2.0
"""Lengths of a capture, whatever its cameras are; lenses without their distortion."""

import time
import warnings

import cv2
import numpy as np
import pytest

from blitzgs.capture.cameras import rectify
from blitzgs.capture.capture import load_capture
from blitzgs.capture.lengths import NEAR_OF_EXTENT
from blitzgs.capture.lens import Lens
from blitzgs.capture.projects import rotation_of
from tests.capture.helpers import as_text, at, frame, smooth_image, write_image, write_ply, write_transforms
from tests.helpers import look_at_origin, refused, write_colmap

COUNT, W, H = 12, 64, 48
NAMES = [f"{i:02d}.png" for i in range(COUNT)]
STRAY = 5
UTM = np.array([5e5, 5.2e6, 300.0])


def ring(shift, radius=4.0):
    """Poses of a ring of cameras around points at `shift`, and the points."""
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    centres = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(COUNT, 0.5)], axis=1)
    rotations = np.stack([look_at_origin(centre)[:3, :3] for centre in centres])
    return rotations, centres + shift, np.random.default_rng(2).uniform(-1, 1, (300, 3)) + shift


def write(root, form, rotations, centres, points):
    for seed, name in enumerate(NAMES):
        write_image(root / "images" / name, smooth_image(H, W, seed))
    colors = np.full((len(points), 3), 120, dtype=np.uint8)
    if form == "transforms":
        write_ply(root / "p.ply", points, colors)
        frames = []
        for name, rotation, centre in zip(NAMES, rotations, centres, strict=True):
            pose = at(*centre)
            pose[:3, :3] = rotation.T @ np.diag([1.0, -1, -1])
            frames.append(frame(f"images/{name}", pose))
        write_transforms(root, frames, fl_x=50.0, w=W, h=H, ply_file_path="p.ply")
        return
    poses = np.concatenate([rotations, -rotations @ centres[..., None]], axis=2)
    write_colmap(root / "sparse/0", (W, H, 50.0, 50.0, W / 2, H / 2), NAMES, poses, points, colors)
    if form == "text":
        as_text(root / "sparse" / "0")


def quiet_load(root, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = load_capture(root, **options)
    return capture, [str(w.message) for w in caught]


def misplaced(kind, rotations, centres, shift):
    rotations, centres = rotations.copy(), centres.copy()
    if kind == "origin":  # a pose that was never found
        rotations[STRAY], centres[STRAY] = np.eye(3), 0
    elif kind == "far":  # of the same direction
        centres[STRAY] = shift + [240.0, 0, 0]
    elif kind == "far and looking back":
        at = np.array([0.1, -600.0, 2.0])
        rotations[STRAY], centres[STRAY] = look_at_origin(at)[:3, :3], shift + at
    elif kind == "near infinity":
        centres[STRAY] = shift + [1e12, 0, 0]
    return rotations, centres


@pytest.mark.parametrize("form", ["binary", "text", "transforms"])
@pytest.mark.parametrize(
    ("kind", "shift"),
    [
        ("origin", UTM),
        ("far", 0 * UTM),
        ("far", UTM),
        ("far and looking back", 0 * UTM),
        ("near infinity", UTM),
    ],
)
def test_one_camera_that_was_not_aligned_costs_one_view(tmp_path, form, kind, shift):
    rotations, centres, points = ring(shift)
    write(tmp_path / "right", form, rotations, centres, points)
    right, said = quiet_load(tmp_path / "right")
    assert not said and not right.about.strays and not right.apart
    write(tmp_path / "wrong", form, *misplaced(kind, rotations, centres, shift), points)
    wrong, said = quiet_load(tmp_path / "wrong")
    name = right.cameras[STRAY].name
    assert any(name in text and "left out; --data.stray_cameras=keep" in text for text in said)
    assert [stray.name for stray in wrong.about.strays] == [name]
    assert [c.name for c in wrong.cameras] == [c.name for i, c in enumerate(right.cameras) if i != STRAY]
    # The other views keep their part, and the lengths are those of a capture without the view.
    part = {c.name: i in right.test for i, c in enumerate(right.cameras)}
    assert all(part[c.name] == (i in wrong.test) for i, c in enumerate(wrong.cameras))
    assert wrong.extent == pytest.approx(right.extent, rel=0.2)
    assert wrong.near == pytest.approx(right.near, rel=0.2)
    assert np.abs(wrong.offset - right.offset).max() < 1
    kept, said = quiet_load(tmp_path / "wrong", stray_cameras="keep")
    assert len(kept.cameras) == COUNT and kept.apart == [STRAY] and any("(kept)" in text for text in said)
    assert (kept.extent, kept.near) == (wrong.extent, wrong.near) and (kept.offset == wrong.offset).all()


def test_an_overview_that_shows_the_scene_is_kept_but_decides_on_no_length(tmp_path):
    rotations, centres, points = ring(0)
    at = np.array([0.1, -30.0, 2.0])
    rotations[STRAY], centres[STRAY] = look_at_origin(at)[:3, :3], at
    write(tmp_path, "binary", rotations, centres, points)
    capture, said = quiet_load(tmp_path)
    assert len(capture.cameras) == COUNT and capture.apart == [STRAY] and capture.extent < 6
    assert not capture.about.strays and not said


def test_rotations_of_few_digits_keep_lengths_far_from_the_origin(tmp_path):
    """At 5,200 km, the fifth digit of a rotation is 50 m of a camera centre."""
    rotations, centres, points = ring(UTM)
    write(tmp_path / "exact", "transforms", rotations, centres, points)
    write(tmp_path / "rounded", "transforms", np.round(rotations, 5), centres, points)
    exact, rounded = (quiet_load(tmp_path / name)[0] for name in ("exact", "rounded"))
    assert rounded.extent == pytest.approx(exact.extent, rel=1e-4)
    np.testing.assert_allclose(rounded.offset, exact.offset, atol=1e-4)
    np.testing.assert_allclose(rotation_of(np.round(rotations[1], 5)), rotations[1], atol=1e-5)
    turn = rotation_of(np.round(rotations[1], 5))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)


def test_two_groups_of_cameras_are_no_strays(tmp_path):
    rotations, centres, points = ring(0)
    rotations[7:], centres[7:] = rotations[:5], centres[:5] + [500.0, 0, 0]
    write(tmp_path, "binary", rotations, centres, np.concatenate([points, points + [500.0, 0, 0]]))
    capture, _ = quiet_load(tmp_path)
    assert len(capture.cameras) == COUNT and not capture.apart and not capture.about.strays
    assert capture.extent > 250


@pytest.mark.parametrize("form", ["binary", "transforms"])
def test_several_strays_are_named(tmp_path, form):
    rotations, centres, points = ring(UTM)
    rotations[[2, 5, 9]], centres[[2, 5, 9]] = np.eye(3), 0
    write(tmp_path, form, rotations, centres, points)
    capture, said = quiet_load(tmp_path)
    assert len(capture.cameras) == COUNT - 3 and len(capture.about.strays) == 3
    assert any(text.startswith("3 of 12 cameras lie far from the others") for text in said)


def street(length, wall, count=COUNT):
    xs = np.linspace(0, length, count)
    rotation = np.stack([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y
    random = np.random.default_rng(3)
    points = np.stack([np.repeat(xs, 30), np.full(30 * count, wall), np.zeros(30 * count)], axis=1)
    points += random.uniform(-0.2, 0.2, points.shape)
    return np.tile(rotation, (count, 1, 1)), np.stack([xs, 0 * xs, 0 * xs], axis=1), points


@pytest.mark.parametrize("form", ["binary", "transforms"])
@pytest.mark.parametrize("wall", [0.5, 2.0, 20.0])
def test_the_near_plane_is_before_what_views_see(tmp_path, form, wall):
    rotations, centres, points = street(450.0, wall)
    write(tmp_path, form, rotations, centres, points)
    capture, said = quiet_load(tmp_path)
    most = NEAR_OF_EXTENT * capture.extent
    assert capture.near == pytest.approx(min(most, 0.25 * wall), rel=0.5) and capture.near < wall - 0.2
    assert any("model.near" in text for text in said) == (wall < most)


def test_wrong_points_do_not_decide_on_the_near_plane(tmp_path):
    rotations, centres, points = street(450.0, 2.0)
    near_cameras = centres + [0.0, 1e-3, 0.0]
    write(tmp_path, "binary", rotations, centres, np.concatenate([points, near_cameras]))
    assert quiet_load(tmp_path)[0].near == pytest.approx(0.5, rel=0.3)


@pytest.mark.parametrize("kind", ["none", "far"])
def test_lengths_scale_exactly_with_the_world(tmp_path, kind):
    rotations, centres, points = ring(0)
    captures = []
    for factor in (1.0, 1024.0, 2.0**-7):
        root = tmp_path / str(factor)
        placed, at = misplaced(kind, rotations, centres, np.zeros(3))
        write(root, "binary", placed, at * factor, points * factor)
        captures.append((factor, quiet_load(root)[0]))
    _, first = captures[0]
    for factor, capture in captures:
        assert (capture.extent, capture.near) == (factor * first.extent, factor * first.near)
        assert (capture.offset == factor * first.offset).all()
        np.testing.assert_array_equal(capture.points, factor * first.points)
        for camera, own in zip(capture.cameras, first.cameras, strict=True):
            pose, expected = camera.world_to_camera, own.world_to_camera.copy()
            expected[:3, 3] *= factor
            np.testing.assert_array_equal(pose, expected)
        assert [stray.name for stray in capture.about.strays] == [stray.name for stray in first.about.strays]


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
    np.testing.assert_allclose(np.stack([x, y], axis=1), expected, atol=1e-9)


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
        lines = (np.exp(-((np.arange(n) + 0.5 - at) ** 2) / 4.5) for n, at in ((480, y), (640, x)))
        flat = cv2.remap(np.outer(*lines).astype(np.float32), columns, rows, cv2.INTER_LINEAR)
        sums = flat.sum(0), flat.sum(1)
        center = [line @ (np.arange(len(line)) + 0.5) / flat.sum() for line in sums]
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


@pytest.mark.parametrize("policy", ["crop", "mask"])
@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "EUCM"])
def test_a_part_of_a_picture_beside_the_axis_is_undistorted_as_the_whole(model, policy):
    lens, left, top = make_lens(model), 400, 290
    *_, cx, cy = lens.intrinsics
    shifted, at = list(lens.params), lens.params.index(cx)
    shifted[at : at + 2] = cx - left, cy - top
    whole, part = rectify(lens, "mask"), rectify(Lens(model, 180, 140, tuple(shifted)), policy)
    assert part.K[0, 2] < 0 and part.K[1, 2] < 0  # the axis is outside
    image = np.add.outer(np.sin(np.arange(480) / 9), np.cos(np.arange(640) / 7)).astype(np.float32)
    expected = cv2.remap(image, *whole.maps()[:2], cv2.INTER_LINEAR)
    columns, rows, seen = part.maps()
    found = cv2.remap(image[top:430, left:580], columns, rows, cv2.INTER_LINEAR)
    x, y = np.round(whole.K[:2, 2] - part.K[:2, 2]).astype(int)
    expected = expected[y : y + part.height, x : x + part.width]
    found, seen = (a[: expected.shape[0], : expected.shape[1]] for a in (found, seen))
    assert seen.sum() > 0.7 * 180 * 140 and (seen.all() or policy == "mask")
    inner = cv2.erode(np.pad(seen[2:-2, 2:-2].astype(np.uint8), 2), np.ones((5, 5))) > 0
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-2)


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
    refused(ValueError, "cut them into perspective views", Lens, "EQUIRECTANGULAR", 640, 320, (640.0, 320.0))
    refused(ValueError, "finite parameters", Lens, "SIMPLE_PINHOLE", 640, 480, (float("nan"), 320.0, 240.0))
    refused(ValueError, "unknown camera model", Lens, "NOVEL", 640, 480, (1.0,))
    with pytest.raises(ValueError, match="leaves .* pixel|along its own axis"):
        rectify(Lens("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -4e3)))
