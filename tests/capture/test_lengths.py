# SPDX-License-Identifier: Apache-2.0
"""One wrong camera costs one view, whatever the format; lengths follow what the views see."""

import json
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blitzgs.capture import colmap
from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.capture import load_capture
from blitzgs.capture.lengths import NEAR_OF_EXTENT
from tests.capture.helpers import as_text, look_at, smooth_image, write_image

COUNT, W, H = 12, 64, 48
NAMES = [f"{i:02d}.png" for i in range(COUNT)]
STRAY = 5
UTM = np.array([5e5, 5.2e6, 300.0])


def ring(shift, radius=4.0):
    """Poses of a ring of cameras around points at `shift`, and the points."""
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    centres = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(COUNT, 0.5)], axis=1)
    rotations = np.stack([look_at(centre) for centre in centres])
    return rotations, centres + shift, np.random.default_rng(2).uniform(-1, 1, (300, 3)) + shift


def write(root, form, rotations, centres, points):
    for seed, name in enumerate(NAMES):
        write_image(root / "images" / name, smooth_image(H, W, seed))
    colors = np.full((len(points), 3), 120, dtype=np.uint8)
    if form == "transforms":
        rows = "".join(f"{x!r} {y!r} {z!r} 120 120 120\n" for x, y, z in points.tolist())
        kinds = [f"property double {axis}\n" for axis in "xyz"] + [
            f"property uchar {channel}\n" for channel in ("red", "green", "blue")
        ]
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{''.join(kinds)}end_header\n"
        (root / "p.ply").write_text(head + rows)
        frames = []
        for name, rotation, centre in zip(NAMES, rotations, centres, strict=True):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation.T @ np.diag([1.0, -1, -1]), centre
            frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
        content = {"fl_x": 50.0, "w": W, "h": H, "ply_file_path": "p.ply", "frames": frames}
        (root / "transforms.json").write_text(json.dumps(content))
        return
    model = colmap.ColmapModel(
        [colmap.ColmapCamera(1, "PINHOLE", W, H, np.array([50.0, 50.0, W / 2, H / 2]))],
        colmap.ColmapImages(
            ids=np.arange(1, COUNT + 1, dtype=np.uint32),
            camera_ids=np.ones(COUNT, dtype=np.uint32),
            quats=Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]],
            translations=-np.einsum("nij,nj->ni", rotations, centres),
            names=NAMES,
            point2d_offsets=np.zeros(COUNT + 1, dtype=np.uint64),
        ),
        colmap.ColmapPoints(
            ids=np.arange(1, len(points) + 1, dtype=np.int64),
            positions=points,
            colors=colors,
            errors=np.zeros(len(points)),
            track_offsets=np.zeros(len(points) + 1, dtype=np.uint64),
        ),
    )
    colmap.write_model(root / "sparse" / "0", model)
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
        rotations[STRAY], centres[STRAY] = look_at(at), shift + at
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
    (tmp_path / "right").mkdir()
    write(tmp_path / "right", form, rotations, centres, points)
    right, said = quiet_load(tmp_path / "right")
    assert not said and not right.about.strays and not right.apart
    (tmp_path / "wrong").mkdir()
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
    rotations[STRAY], centres[STRAY] = look_at(at), at
    write(tmp_path, "binary", rotations, centres, points)
    capture, said = quiet_load(tmp_path)
    assert (
        len(capture.cameras) == COUNT and capture.apart == [STRAY] and not capture.about.strays and not said
    )
    assert capture.extent < 6


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
        root.mkdir()
        placed, at = misplaced(kind, rotations, centres, np.zeros(3))
        write(root, "binary", placed, at * factor, points * factor)
        captures.append((factor, quiet_load(root)[0]))
    _, first = captures[0]
    for factor, capture in captures:
        assert (capture.extent, capture.near) == (factor * first.extent, factor * first.near)
        assert (capture.offset == factor * first.offset).all()
        assert [stray.name for stray in capture.about.strays] == [stray.name for stray in first.about.strays]


def test_a_usual_capture_keeps_its_lengths(tmp_path):
    rotations, centres, points = ring(UTM)
    write(tmp_path, "binary", rotations, centres, points)
    capture, _ = quiet_load(tmp_path)
    own = camera_centres(np.stack([camera.world_to_camera for camera in capture.cameras]))
    train = own[capture.train]
    assert capture.extent == pytest.approx(1.1 * np.linalg.norm(train - train.mean(axis=0), axis=1).max())
    assert capture.near == NEAR_OF_EXTENT * capture.extent
    assert capture.offset == pytest.approx(UTM + [0, 0, 0.5])
