# SPDX-License-Identifier: Apache-2.0
"""The viewer's parts without a browser: coordinates, films, comparisons, the door, the pace."""

import contextlib
import json
import math
import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from blitzgs.runs.cameras import RunCamera
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import Picture
from blitzgs.view.views import Space, up_direction
from blitzgs.viewer import compare, paths
from blitzgs.viewer.compare import shaded
from blitzgs.viewer.door import Door, is_loopback
from blitzgs.viewer.film import read_film
from blitzgs.viewer.frustums import MAX_FRUSTUMS, shown_cameras
from blitzgs.viewer.live import Curves
from blitzgs.viewer.panel import round_length
from blitzgs.viewer.settings import Pace
from blitzgs.viewer.world import World, looking
from tests.helpers import refused


def camera_at(position, target, up=(0.0, 0.0, 1.0)):
    """The matrix from the world to a camera that looks at a target."""
    stance = looking(np.array(position, float), np.array(target, float), np.array(up), 1.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = stance.rotation.T, -stance.rotation.T @ stance.position
    return pose


def pose(position, target):
    return np.linalg.inv(camera_at(position, target))


def test_up_is_found_for_ground_and_aerial_captures():
    ring = [camera_at((3 * math.sin(a), -1.0, 3 * math.cos(a)), (0, 0, 0), (0, -1, 0)) for a in range(8)]
    np.testing.assert_allclose(up_direction(ring), [0, -1, 0], atol=0.2)
    nadir = [camera_at((x, y, 10.0), (x, y, 0.0), (0, (-1) ** x, 0)) for x in range(4) for y in range(3)]
    np.testing.assert_allclose(up_direction(nadir), [0, 0, 1])
    # Five of six lines fly one way, and z is down, as in the world of COLMAP's first camera.
    survey = [
        camera_at((x, y, -9), (x + y / 9, y, 0), (0, -1 if x else 1, 0)) for x in range(6) for y in range(3)
    ]
    np.testing.assert_allclose(up_direction(survey), [0, 0, -1], atol=0.2)
    np.testing.assert_allclose(up_direction([]), [0, 0, 1])


def test_coordinates_go_there_and_back():
    world = World(Space((500_000.0, 4e6, 30.0), 64.0, 1.5), [], BOX)
    viewmat = camera_at((0.1, 0.2, 0.3), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(world.viewmat(world.stance(viewmat, 1.0)), viewmat, atol=1e-12)
    place = np.array([500_010.0, 4_000_001.0, 33.0])
    np.testing.assert_allclose(world.capture_position(world.page_position(place)), place)


def key(angle, fov=50.0):
    return paths.Keyframe(pose((math.sin(angle), math.cos(angle), 1), (0, 0, 0)), fov, 1.5)


def test_a_path_survives_its_file():
    path = paths.CameraPath([key(0.0), key(0.5, 60.0), key(1.0)], fps=10, seconds=2)
    text = paths.to_json(path)
    content = json.loads(text)
    assert len(content["camera_path"]) == 20
    assert {"camera_to_world", "fov", "aspect"} <= content["camera_path"][0].keys()
    # A camera of OpenGL looks along -z.
    first = np.array(content["keyframes"][0]["matrix"]).reshape(4, 4)
    np.testing.assert_allclose(-first[:3, 2], path.keyframes[0].camera_to_world[:3, 2])
    again = paths.from_json(text)
    for a, b in zip(path.keyframes, again.keyframes, strict=True):
        np.testing.assert_allclose(a.camera_to_world, b.camera_to_world, atol=1e-12)
        assert (a.fov, a.aspect) == (b.fov, b.aspect)


def test_an_old_path_of_nerfstudio_is_read():
    matrix = np.linalg.inv(camera_at((0, 0, 5), (1, 0, 0))) @ np.diag([1, -1, -1, 1])
    text = json.dumps(
        {"keyframes": [{"matrix": json.dumps(matrix.T.ravel().tolist()), "fov": 40, "aspect": 1}]}
    )
    found = paths.from_json(text).keyframes[0]
    np.testing.assert_allclose(found.camera_to_world[:3, 3], [0, 0, 5], atol=1e-9)


def test_a_photograph_lies_where_the_render_shows_its_pixels():
    camera = RunCamera("a.png", 40, 30, np.array([[35.0, 0, 20], [0, 35, 15], [0, 0, 1]]), np.eye(4))
    photograph = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    same = compare.compare("wipe", photograph, photograph, camera, camera.K, 1.0)
    np.testing.assert_array_equal(same.image[:, :-2], photograph[:, :-2])
    assert same.psnr > 100
    K = intrinsics(120, 120, compare.fitting_fov(camera, 1.0))  # noqa: N806
    shown = compare.compare("error", np.zeros((120, 120, 3), np.uint8), photograph, camera, K)
    assert (shown.image[:14] == 0).all() and (shown.image[16:104] > 0).any()
    grid = compare.compare("side by side", photograph, photograph, camera, camera.K, columns=2)
    assert grid.image.shape == (60, 80, 3)


@pytest.mark.parametrize(("size", "columns"), [((900, 200), 3), ((400, 300), 2), ((200, 900), 1)])
def test_images_side_by_side_are_as_large_as_they_can_be(size, columns):
    assert compare.grid_columns(RunCamera("a.png", 40, 30, np.eye(3), np.eye(4)), *size) == columns


def test_numbers_become_colours():
    depth = np.linspace(1, 9, 64, dtype=np.float32).reshape(8, 8)
    depth[0, 0] = 0
    found = shaded(Picture(depth, 1, 1.0), "depth")
    assert found.image.shape == (8, 8, 3) and (found.image[0, 0] == 0).all()
    assert 1 <= found.low < found.high <= 9
    empty = shaded(Picture(np.zeros((2, 2), np.float32), 0, 1.0), "count")
    assert (empty.image == 0).all()


def test_pictures_are_coarse_while_the_camera_moves():
    pace = Pace()
    pace.measured(1.0, 500.0)
    coarse = pace.next_scale(None, moving=True)
    assert coarse < 0.3
    assert pace.next_scale(coarse, moving=True) is None
    finer = pace.next_scale(coarse, moving=False)
    assert coarse < finer < 1.0
    assert pace.next_scale(finer, moving=False) == 1.0
    assert pace.next_scale(1.0, moving=False) is None
    quick = Pace()
    quick.measured(1.0, 5.0)
    assert quick.next_scale(None, moving=True) == 1.0


def test_scale_bars_are_round():
    assert [round_length(x) for x in (0.9, 1.0, 3.0, 7.0, 99.0)] == pytest.approx([0.5, 1, 2, 5, 50])


def test_curves_take_steps_and_evaluations():
    curves = Curves(10)
    assert "no figures" in curves.status()
    curves.add(5, {"loss": 0.5, "psnr": 20.0, "gaussians": 7, "images_per_second": 3.0})
    curves.add(5, {"event": "evaluation", "psnr": 21.0})
    curves.add(6, {"event": "densify", "gaussians": 9})
    assert curves.version == 2
    assert "held out: 21.00 dB" in curves.status() and "of 10 images" in curves.status()
    curves.add(8, {"event": "pace", "images": 9, "scale": 0.9})
    assert "of 9 images" in curves.status()


# -- the door ----------------------------------------------------------------------------------------------


@pytest.fixture
def behind():
    """A server that answers each request with its first line."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                head = connection.recv(65536)
                line = head.split(b"\r\n")[0]
                connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(line), line))

    threading.Thread(target=serve, daemon=True).start()
    yield server.getsockname()[1]
    server.close()


def ask(port, path="/", host="localhost", extra="", method="GET"):
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(f"{method} {path} HTTP/1.1\r\nHost: {host}\r\n{extra}\r\n".encode())
        return connection.makefile().read()


def test_the_door_without_a_token_is_for_this_machine(behind, caplog):
    with contextlib.closing(Door("127.0.0.1", 0, behind, "")) as door:
        assert "GET / HTTP/1.1" in ask(door.port, host=f"localhost:{door.port}")
        assert "GET /a?b" in ask(door.port, "/a?b", host="127.0.0.1:1")
        assert " 403 " in ask(door.port, host="evil.example")  # a name that was made to lead here
        upgrade = "Upgrade: websocket\r\nOrigin: http://evil.example\r\n"
        assert " 403 " in ask(door.port, extra=upgrade)
        assert "200 OK" in ask(door.port, extra="Upgrade: websocket\r\nOrigin: http://localhost\r\n")
        assert " 405 " in ask(door.port, method="POST")
        assert ask(door.port, host="[") == ask(door.port, extra=upgrade.replace("evil", "[")) == ""
    assert caplog.text == ""  # no error that nobody has caught


def test_the_door_with_a_token(behind):
    with contextlib.closing(Door("127.0.0.1", 0, behind, "secret")) as door:
        assert " 403 " in ask(door.port, host="machine")
        assert " 403 " in ask(door.port, "/secrets/", host="machine")
        assert " 403 " in ask(door.port, extra="Upgrade: websocket\r\n")
        assert "Location: /secret/" in ask(door.port, "/secret", host="machine")
        assert "GET /x HTTP/1.1" in ask(door.port, "/secret/x", host="machine")
        assert "GET / HTTP/1.1" in ask(door.port, "/secret", extra="Upgrade: websocket\r\n")


def test_a_port_in_use_is_an_error(behind):
    taken = rf"cannot listen on 127.0.0.1:{behind} \(Address already in use\): choose another port"
    unknown = r"nosuch.invalid:0 \(no such host\)"
    refused(OSError, taken, Door, "127.0.0.1", behind, behind, "")
    refused(OSError, unknown, Door, "nosuch.invalid", 0, behind, "")


def test_addresses_of_this_machine():
    assert is_loopback("localhost") and is_loopback("127.0.0.1") and is_loopback("::1")
    assert not is_loopback("0.0.0.0") and not is_loopback("machine.example")


def test_frustums_are_thinned_evenly_and_held_out_ones_keep_their_share():
    assert shown_cameras(5, {0}) == [0, 1, 2, 3, 4]
    assert shown_cameras(0, set()) == []
    test = set(range(0, 3200, 8))  # of which steps of 8 would show all, or none
    shown = shown_cameras(3200, test)
    assert len(shown) == MAX_FRUSTUMS == 400 and len(set(shown) & test) == 50
    assert max(np.diff(sorted(set(shown) & test))) == 64
    assert max(np.diff(shown)) <= 16


SPACE = Space((500.0, -200.0, 30.0), 4.0, 1.5)
BOX = np.array([[-1.0, -1.0, -0.2], [1.0, 1.0, 0.2]])


def aerial():
    """A strip of cameras, in the re-centred world: 6 units high, looking down and ahead along x."""
    cameras = []
    for x in np.linspace(-8, 8, 9):
        for y in (-2.0, 2.0):
            world_to_camera = camera_at((x, y, 6), (x + 1, y, 0))
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
    film = read_film(str(file), moved=transforms)
    cameras = film.cameras(SPACE, (), BOX)
    assert (film.fps, len(cameras), cameras[0].width, cameras[0].height) == (12, 2, 90, 60)
    assert cameras[0].K[1, 1] == pytest.approx(30 / math.tan(math.radians(30)))
    for camera, matrix in zip(cameras, wanted, strict=True):
        found = np.linalg.inv(camera.world_to_camera)
        np.testing.assert_allclose(found[:3, 3] + SPACE.offset, matrix[:3, 3], atol=1e-9)
        np.testing.assert_allclose(found[:3, :3], matrix[:3, :3], atol=1e-9)


def test_a_path_of_the_viewer_is_played_as_it_was_or_with_another_pace(tmp_path):
    keys = [key(angle) for angle in (0, 1, 2)]
    path = paths.CameraPath(keys, width=64, height=48, fps=10, seconds=0.5)
    file = tmp_path / "p.json"
    file.write_text(paths.to_json(path))
    nowhere = Space((0.0, 0.0, 0.0), 1.0, 1.0)
    film = read_film(str(file))
    assert (film.width, film.height, film.fps) == (64, 48, 10)
    frames = film.cameras(nowhere, (), BOX)
    assert len(frames) == 5
    for frame, wanted in zip(frames[::2], keys, strict=True):
        np.testing.assert_allclose(np.linalg.inv(frame.world_to_camera), wanted.camera_to_world, atol=1e-9)
    for frame in path.frames():
        rotation = frame.camera_to_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    other = read_film(str(file), (32, 16), 30, 2)
    assert len(other.cameras(nowhere, (), BOX)) == 60 and (other.width, other.fps) == (32, 30)


def test_an_orbit_goes_around_the_middle():
    endless = read_film("orbit", None, 1e4, 1e4)
    refused(ValueError, "at most 1,000,000 frames, got 100,000,000", endless.cameras, SPACE, aerial(), BOX)
    cameras = read_film("orbit", (64, 48), 4, 9).cameras(SPACE, aerial(), BOX)
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
    cameras = read_film("flight", None, 1, 5).cameras(SPACE, aerial(), BOX)
    places = np.array([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    np.testing.assert_allclose(places[:, 1:3, 3], [[0, 6]] * 5, atol=1e-9)
    slope = math.degrees(math.asin(-places[0, 2, 2]))
    assert slope == pytest.approx(35)  # the cameras look down more steeply
    grounds = places[:, 0, 3] + places[:, 0, 2] / -places[:, 2, 2] * 6  # what the middle of each frame shows
    assert sorted((grounds[0], grounds[-1])) == pytest.approx([-6.6, 6.6], abs=0.7)
    assert places[0, 0, 2] * (places[-1, 0, 3] - places[0, 0, 3]) > 0  # forwards
    assert cameras[0].width == 1920 and cameras[0].K[1, 1] == pytest.approx(540 / 24 * 50)


def test_a_spline_passes_through_cameras():
    known = aerial()
    cameras = read_film("spline", None, 17, 1).cameras(SPACE, known, BOX)
    for camera, own in zip((cameras[0], cameras[-1]), (known[0], known[-1]), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, own.world_to_camera, atol=1e-9)
    spline = read_film("spline")
    refused(ValueError, "needs the cameras of a capture", spline.cameras, SPACE, (), BOX)


KEY = {"matrix": opengl(np.eye(4)), "fov": 50, "aspect": 1.5}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no JSON: .* line 1 column"),
        (b"{", "no JSON: .* line 1 column"),
        (b"\xa9", "no JSON: .* line 1 column"),
        ([], "its content is no object"),
        ({}, "neither keyframes nor camera_path"),
        ({"keyframes": [KEY, KEY | {"matrix": [1, 2]}]}, r"keyframes\[1\]: matrix must be 16 finite numbers"),
        ({"keyframes": [KEY | {"matrix": [2.0] * 16}]}, r"keyframes\[0\]: matrix is no rotation"),
        ({"keyframes": [KEY | {"fov": "wide"}]}, r"keyframes\[0\]: fov must be a number"),
        (
            {"keyframes": [KEY | {"fov": 200}]},
            r"keyframes\[0\]: fov must be .* from 0.1 to 179, got 200",
        ),
        ({"keyframes": [KEY], "camera_path": [KEY, 3]}, r"camera_path\[1\]"),
        ({"camera_path": 3}, "camera_path is no list"),
        ({"keyframes": [KEY], "fps": -1}, "fps must be a number from 0.01 to 240, got -1"),
        ({"keyframes": [KEY], "render_width": 0}, "render_width must be a number from 1 to"),
        ({"keyframes": [KEY], "fps": 100, "seconds": 1e5}, "seconds must be a number from 0 to 10000, got"),
        ({"keyframes": [KEY | {"matrix": [10**400] * 16}]}, r"keyframes\[0\]: int too large"),
        ({"keyframes": [KEY], "render_width": 1e6}, "render_width and render_height must be at most 8192"),
        ({"keyframes": [KEY], "camera_type": "fisheye"}, "camera_type is 'fisheye'"),
    ],
)
def test_damaged_paths_name_file_and_place(tmp_path, content, reason):
    file = tmp_path / "p.json"
    file.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    refused(ValueError, f"{file}: .*{reason}", read_film, str(file))


def test_damaged_transforms_of_nerfstudio_are_named(tmp_path):
    path, file = tmp_path / "p.json", tmp_path / "t.json"
    path.write_text(json.dumps({"keyframes": [KEY]}))
    for content, reason in (("{}", "'transform' is missing"), ('{"transform": [[1]], "scale": 1}', "3 x 4")):
        file.write_text(content)
        refused(ValueError, f"{file}.*{reason}", read_film, str(path), moved=file)
    refused(FileNotFoundError, "orbit, flight, spline need none", read_film, "Orbit")
