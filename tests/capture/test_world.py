# SPDX-License-Identifier: Apache-2.0
"""Similarities to the world, their file, and reference systems, against pyproj and exact values."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blitzgs.capture.world import (
    WorldFrame,
    enu_frame,
    fit_similarity,
    frame_beside,
    frame_in,
    geodetic,
    read_frame,
)

TURN = Rotation.from_euler("xyz", [10, -70, 130], degrees=True).as_matrix()
PLACE = np.array([412_345.0, 5_654_321.0, 120.0])


def test_a_similarity_is_recovered_to_the_last_digits():
    capture = np.random.default_rng(0).uniform(-3, 3, (12, 3))
    world = 2.75 * capture @ TURN.T + PLACE
    frame = fit_similarity(capture, world)
    assert frame.scale == pytest.approx(2.75, abs=1e-9)
    np.testing.assert_allclose(frame.rotation, TURN, atol=1e-9)
    np.testing.assert_allclose(frame.to_world(capture), world, atol=2e-9)  # float64 has 1e-9 there
    np.testing.assert_allclose(frame.from_world(world), capture, atol=1e-9)
    flat = capture * [1, 1, 0]
    np.testing.assert_allclose(fit_similarity(flat, 0.5 * flat @ TURN.T).rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(fit_similarity(capture[:3], world[:3]).rotation, TURN, atol=1e-8)


def test_a_mirrored_world_gives_the_nearest_rotation():
    capture = np.random.default_rng(1).uniform(-1, 1, (9, 3)) * [1, 1, 0.01]
    frame = fit_similarity(capture, capture * [1, 1, -1])
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    np.testing.assert_allclose(frame.rotation, np.eye(3), atol=0.02)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.eye(3)[:2], "needs at least 3 points, got 2"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "the 5 points lie on a line in the capture"),
        (np.outer(np.arange(5.0), [1, 2, 3]) + 1e-4 * np.eye(5, 3), "the 5 points lie on a line"),
        (np.zeros((4, 3)), "the 4 points lie on a line"),
    ],
)
def test_degenerate_points_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        fit_similarity(points, points)


def test_the_file_keeps_every_digit(tmp_path):
    frame = WorldFrame("EPSG:32633", 1 / 3, TURN, PLACE + 1 / 3, "here")
    (tmp_path / "geo.json").write_text(json.dumps(frame.as_json()))
    found = frame_beside(tmp_path)
    assert found.crs == "EPSG:32633" and found.scale == 1 / 3
    np.testing.assert_array_equal(found.translation, frame.translation)
    np.testing.assert_array_equal(found.rotation, TURN)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": -1}, "scale must be positive"),
        ({"scale": "1"}, "scale a number"),
        ({"rotation": [[1, 0], [0, 1]]}, "3 x 3"),
        ({"rotation": (2 * np.eye(3)).tolist()}, "must be a rotation"),
        ({"rotation": np.diag([1, 1, -1]).tolist()}, "must be a rotation"),
        ({"translation": [0, float("nan"), 0]}, "translation finite"),
        ({"crs": 32633}, "crs must be text"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, change, message):
    path = tmp_path / "geo.json"
    path.write_text(json.dumps(WorldFrame().as_json() | change))
    with pytest.raises(ValueError, match=f"geo.json is damaged .*{message}"):
        read_frame(path)
    path.write_text("x" * ((1 << 20) + 1))
    with pytest.raises(ValueError, match="larger than 1,048,576 bytes"):
        read_frame(path)


@pytest.mark.parametrize("place", [(47.5, 8.25, 432.0), (-33.9, 151.2, -12.0), (0.0, -179.9, 9000.0)])
def test_east_north_up_and_geodetic_agree_with_pyproj(place):
    pyproj = pytest.importorskip("pyproj")
    frame = enu_frame(*place, "here")
    exact = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(*place)
    np.testing.assert_allclose(frame.to_world(np.zeros(3)), exact, atol=1e-8)
    np.testing.assert_allclose(geodetic(np.array(exact)), place, atol=1e-8)
    topocentric = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +step +proj=topocentric +lat_0={place[0]} +lon_0={place[1]} "
        f"+h_0={place[2]}"
    )
    local = topocentric.transform(place[1] + 0.001, place[0] - 0.002, place[2] + 50)
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(
        place[0] - 0.002, place[1] + 0.001, place[2] + 50
    )
    np.testing.assert_allclose(frame.from_world(np.array(there)), local, atol=1e-6)
    assert frame.label(np.zeros(3)).endswith(f"{place[2]:.2f} m (WGS 84)")


def test_a_frame_in_utm_is_right_within_its_stated_error():
    pyproj = pytest.importorskip("pyproj")
    frame = enu_frame(47.5, 8.25, 432.0, "here")
    places = np.random.default_rng(2).uniform(-150, 150, (60, 3)) * [1, 1, 0.1]
    utm, error = frame_in(frame, "EPSG:32632", places)
    exact = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS("EPSG:32632").to_3d()).transform(
        *frame.to_world(places).T
    )
    apart = np.linalg.norm(utm.to_world(places) - np.stack(exact, axis=1), axis=1)
    assert (
        apart.max() == pytest.approx(error) and error < 0.03
    )  # the curvature over 200 m is 3 mm, the scale's
    assert utm.scale == pytest.approx(0.9996, abs=2e-4)
    assert utm.label(np.zeros(3)).startswith("E 443") and utm.label(np.zeros(3)).endswith("(EPSG:32632)")
    with pytest.raises(ValueError, match="EPSG:4326 .* has angles"):
        frame_in(frame, "EPSG:4326", places)
    with pytest.raises(ValueError, match="'EPSG:0' is no reference system"):
        frame_in(frame, "EPSG:0", places)
