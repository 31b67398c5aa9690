# SPDX-License-Identifier: Apache-2.0
"""The cameras of films: paths of files, and paths made from a scene."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from blitzgs.view.views import Space
from blitzgs.viewer import paths
from blitzgs.viewer.film import read_film
from blitzgs.viewer.world import looking

SPACE = Space((500.0, -200.0, 30.0), 4.0, 1.5)
BOX = np.array([[-1.0, -1.0, -0.2], [1.0, 1.0, 0.2]])


def pose(position, target, up=(0.0, 0.0, 1.0)):
    stance = looking(np.array(position, float), np.array(target, float), np.array(up, float), 1.0)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = stance.rotation, stance.position
    return found


def aerial():
    """A strip of cameras, in the re-centred world: 6 units high, looking down and ahead along x."""
    cameras = []
    for x in np.linspace(-8, 8, 9):
        for y in (-2.0, 2.0):
            world_to_camera = np.linalg.inv(pose((x, y, 6), (x + 1, y, 0)))
            K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
            cameras.append(
                SimpleNamespace(name="a", width=64, height=48, K=K, world_to_camera=world_to_camera)
            )
    return cameras


def opengl(matrix):
    return (matrix @ np.diag([1.0, -1, -1, 1])).ravel().tolist()


def test_a_path_of_nerfstudio_gives_its_cameras(tmp_path):
    """By hand: nerfstudio's world is that of the capture, turned about z, moved and scaled."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift, scale = np.array([3.0, -4.0, 0.5]), 0.25
    wanted = [pose((510, -190, 40), (500, -200, 30)), pose((505, -210, 35), (500, -200, 30))]
    frames = []
    for matrix in wanted:
        there = np.eye(4)
        there[:3, :3] = turn @ matrix[:3, :3]
        there[:3, 3] = scale * (turn @ matrix[:3, 3] + shift)
        frames.append({"camera_to_world": opengl(there), "fov": 60, "aspect": 1.5})
    file = tmp_path / "camera_path.json"
    content = {"camera_type": "perspective", "render_width": 90, "render_height": 60, "fps": 12}
    file.write_text(json.dumps(content | {"seconds": 1, "camera_path": frames, "keyframes": []}))
    transforms = tmp_path / "dataparser_transforms.json"
    matrix = np.concatenate([turn, shift[:, None]], axis=1).tolist()
    transforms.write_text(json.dumps({"transform": matrix, "scale": scale}))
    film = read_film(str(file), None, None, None, transforms)
    cameras = film.cameras(SPACE, (), BOX)
    assert (film.fps, len(cameras), cameras[0].width, cameras[0].height) == (12, 2, 90, 60)
    assert cameras[0].K[1, 1] == pytest.approx(30 / math.tan(math.radians(30)))
    for camera, matrix in zip(cameras, wanted, strict=True):
        found = np.linalg.inv(camera.world_to_camera)
        np.testing.assert_allclose(found[:3, 3] + SPACE.offset, matrix[:3, 3], atol=1e-9)
        np.testing.assert_allclose(found[:3, :3], matrix[:3, :3], atol=1e-9)


def test_a_path_of_the_viewer_is_played_as_it_was_or_with_another_pace(tmp_path):
    keys = [
        paths.Keyframe(pose((3 * math.cos(a), 3 * math.sin(a), 2), (0, 0, 0)), 50.0, 1.5) for a in (0, 1, 2)
    ]
    path = paths.CameraPath(keys, width=64, height=48, fps=10, seconds=0.5)
    file = tmp_path / "p.json"
    file.write_text(paths.to_json(path))
    nowhere = Space((0.0, 0.0, 0.0), 1.0, 1.0)
    film = read_film(str(file), None, None, None, None)
    assert (film.width, film.height, film.fps) == (64, 48, 10)
    frames = film.cameras(nowhere, (), BOX)
    assert len(frames) == 5
    for place, key in ((0, 0), (2, 1), (4, 2)):
        found = np.linalg.inv(frames[place].world_to_camera)
        np.testing.assert_allclose(found, keys[key].camera_to_world, atol=1e-9)
    other = read_film(str(file), (32, 16), 30, 2, None)
    assert len(other.cameras(nowhere, (), BOX)) == 60 and (other.width, other.fps) == (32, 30)


def test_an_orbit_goes_around_the_middle():
    cameras = read_film("orbit", (64, 48), 4, 9, None).cameras(SPACE, aerial(), BOX)
    places = np.array([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    centres = places[:, :3, 3]
    assert len(cameras) == 36
    np.testing.assert_allclose(centres[:, 2], 6, atol=1e-6)
    radii = np.linalg.norm(centres[:, :2], axis=1)
    assert radii.std() < 1e-3 * radii.mean()
    angles = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
    np.testing.assert_allclose(np.diff(angles), 2 * math.pi / 36, rtol=0.02)
    for centre, place in zip(centres, places, strict=True):
        np.testing.assert_allclose(place[:3, 2], -centre / np.linalg.norm(centre), atol=2e-3)


def test_a_flight_goes_straight_across():
    cameras = read_film("flight", None, 1, 5, None).cameras(SPACE, aerial(), BOX)
    places = np.array([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    np.testing.assert_allclose(places[:, 1:3, 3], [[0, 6]] * 5, atol=1e-9)
    assert abs(places[-1, 0, 3] - places[0, 0, 3]) == pytest.approx(16, rel=0.05)
    slope = math.degrees(math.asin(-places[0, 2, 2]))
    assert slope == pytest.approx(35)  # the cameras look down more steeply
    assert places[0, 0, 2] * (places[-1, 0, 3] - places[0, 0, 3]) > 0  # forwards
    assert cameras[0].width == 1920 and cameras[0].K[1, 1] == pytest.approx(540 / 24 * 50)


def test_a_spline_passes_through_cameras():
    known = aerial()
    cameras = read_film("spline", None, 17, 1, None).cameras(SPACE, known, BOX)
    for camera, own in zip((cameras[0], cameras[-1]), (known[0], known[-1]), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, own.world_to_camera, atol=1e-9)
    with pytest.raises(ValueError, match="needs the cameras of a capture"):
        read_film("spline", None, None, None, None).cameras(SPACE, (), BOX)


KEY = {"matrix": opengl(np.eye(4)), "fov": 50, "aspect": 1.5}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{", "no JSON: .* line 1 column"),
        ("[]", "its content is no object"),
        ("{}", "neither keyframes nor camera_path"),
        ({"keyframes": [KEY, KEY | {"matrix": [1, 2]}]}, r"keyframes\[1\]: matrix must be 16 finite numbers"),
        ({"keyframes": [KEY | {"matrix": [2.0] * 16}]}, r"keyframes\[0\]: matrix is no rotation"),
        ({"keyframes": [KEY | {"fov": "wide"}]}, r"keyframes\[0\]: fov must be a number"),
        ({"keyframes": [KEY | {"fov": 200}]}, r"keyframes\[0\]: fov must be below 179"),
        ({"keyframes": [KEY], "camera_path": [KEY, 3]}, r"camera_path\[1\]"),
        ({"keyframes": [KEY], "fps": -1}, "fps must be a number of at least 0.01, got -1"),
        ({"keyframes": [KEY], "render_width": 0}, "render_width must be a number of at least 1"),
        ({"keyframes": [KEY], "render_width": 1e6}, "render_width and render_height must be at most 8192"),
        ({"keyframes": [KEY], "camera_type": "fisheye"}, "camera_type is 'fisheye'"),
    ],
)
def test_damaged_paths_name_file_and_place(tmp_path, content, reason):
    file = tmp_path / "p.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=reason) as raised:
        read_film(str(file), None, None, None, None)
    assert str(file) in str(raised.value)


def test_damaged_transforms_of_nerfstudio_are_named(tmp_path):
    path, file = tmp_path / "p.json", tmp_path / "t.json"
    path.write_text(json.dumps({"keyframes": [KEY]}))
    for content, reason in (("{}", "'transform' is missing"), ('{"transform": [[1]], "scale": 1}', "3 x 4")):
        file.write_text(content)
        with pytest.raises(ValueError, match=f"{file}.*{reason}"):
            read_film(str(path), None, None, None, file)
    with pytest.raises(FileNotFoundError, match="orbit, flight, spline need none"):
        read_film("Orbit", None, None, None, None)
