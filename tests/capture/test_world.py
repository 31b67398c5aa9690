# SPDX-License-Identifier: Apache-2.0
"""Similarities to the world from reference systems and ground control points."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blitzgs.capture.capture import load_capture
from blitzgs.capture.control_points import ControlPoint, align, normalised, place, read_control_points
from blitzgs.capture.lens import Lens
from blitzgs.capture.world import (
    WorldFrame,
    converted,
    enu_frame,
    fit_similarity,
    frame_beside,
    frame_in,
    geodetic,
    read_world_frame,
    system_of_lengths,
)
from tests.capture import helpers as files
from tests.capture.helpers import warned
from tests.helpers import refused

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
    refused(ValueError, message, fit_similarity, points, points)


def test_the_file_keeps_every_digit(tmp_path):
    frame = WorldFrame("EPSG:32633", 1 / 3, TURN, PLACE + 1 / 3, "here")
    (tmp_path / "geo.json").write_text(json.dumps(frame.as_json()))
    found = frame_beside(tmp_path)
    assert found.crs == "EPSG:32633" and found.scale == 1 / 3
    np.testing.assert_array_equal(found.translation, frame.translation)
    np.testing.assert_array_equal(found.rotation, TURN)


def test_an_offset_has_the_reference_system_of_its_name(tmp_path):
    """Shapefiles of a site have a .prj of their own."""
    (tmp_path / "site_offset.xyz").write_text("412345 5654321 100\n")
    (tmp_path / "site_wkt.prj").write_text("EPSG:32633")
    (tmp_path / "border.prj").write_text("EPSG:4326")
    assert frame_beside(tmp_path).crs == "EPSG:32633"
    (tmp_path / "site.prj").write_text("EPSG:32634")
    assert frame_beside(tmp_path).crs == "EPSG:32634"
    (tmp_path / "site.prj").unlink()
    (tmp_path / "site_offset.xyz").rename(tmp_path / "offset.txt")
    message = "border.prj, site_wkt.prj differ, .* copy that one to offset.prj"
    refused(ValueError, message, frame_beside, tmp_path)
    (tmp_path / "offset.prj").write_text("EPSG:32633")
    assert frame_beside(tmp_path).crs == "EPSG:32633"
    (tmp_path / "offset.prj").unlink()
    (tmp_path / "border.prj").unlink()
    assert frame_beside(tmp_path).crs == "EPSG:32633"
    (tmp_path / "other_offset.xyz").write_text("1 2 3")
    refused(ValueError, "offset.txt, other_offset.xyz differ", frame_beside, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": -1}, "scale must be positive"),
        ({"scale": "1"}, "scale a number"),
        ({"rotation": [[1, 0], [0, 1]]}, "3 x 3"),
        ({"rotation": (2 * np.eye(3)).tolist()}, "must be a rotation"),
        ({"rotation": np.diag([1, 1, -1]).tolist()}, "must be a rotation"),
        ({"translation": [0, float("nan"), 0]}, "translation finite"),
        ({"translation": [10**400, 0, 0]}, "int too large"),
        ({"crs": 32633}, "crs must be text"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, change, message):
    path = tmp_path / "geo.json"
    path.write_text(json.dumps(WorldFrame().as_json() | change))
    refused(ValueError, f"geo.json is damaged .*{message}", read_world_frame, path)
    path.write_text("x" * ((1 << 20) + 1))
    refused(ValueError, "larger than 1,048,576 bytes", read_world_frame, path)


@pytest.mark.parametrize("place", [(47.5, 8.25, 432.0), (-33.9, 151.2, -12.0), (0.0, -179.9, 9000.0)])
def test_east_north_up_and_geodetic_agree_with_pyproj(place):
    pyproj = pytest.importorskip("pyproj")
    frame = enu_frame(*place, "here")
    geocentric = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    exact = geocentric.transform(*place)
    np.testing.assert_allclose(frame.to_world(np.zeros(3)), exact, atol=1e-8)
    np.testing.assert_allclose(geodetic(np.array(exact)), place, atol=1e-8)
    topocentric = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +step +proj=topocentric +lat_0={place[0]} +lon_0={place[1]} "
        f"+h_0={place[2]}"
    )
    local = topocentric.transform(place[1] + 0.001, place[0] - 0.002, place[2] + 50)
    there = geocentric.transform(place[0] - 0.002, place[1] + 0.001, place[2] + 50)
    np.testing.assert_allclose(frame.from_world(np.array(there)), local, atol=1e-6)
    assert frame.label(np.zeros(3)).endswith(f"{place[2]:.2f} m (WGS 84)")


def test_a_frame_in_utm_is_right_within_its_stated_error():
    pyproj = pytest.importorskip("pyproj")
    frame = enu_frame(47.5, 8.25, 432.0, "here")
    places = np.random.default_rng(2).uniform(-150, 150, (60, 3)) * [1, 1, 0.1]
    utm, error = frame_in(frame, "EPSG:32632", places)
    projection = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS("EPSG:32632").to_3d())
    exact = projection.transform(*frame.to_world(places).T)
    apart = np.linalg.norm(utm.to_world(places) - np.stack(exact, axis=1), axis=1)
    assert apart.max() == pytest.approx(error) and error < 0.03  # of the curvature over 200 m and the scale
    assert utm.scale == pytest.approx(0.9996, abs=2e-4)
    assert utm.label(np.zeros(3)).startswith("E 443") and utm.label(np.zeros(3)).endswith("(EPSG:32632)")
    refused(ValueError, "EPSG:4326 .* has angles", frame_in, frame, "EPSG:4326", places)
    refused(ValueError, "'EPSG:0' is no reference system", frame_in, frame, "EPSG:0", places)


def test_heights_are_in_the_unit_of_lengths(tmp_path):
    """Of systems in feet, pyproj has heights in metres, with which a model would be flat."""
    pytest.importorskip("pyproj")
    frame = enu_frame(37.5, -122.0, 300.0, "here")
    places = np.random.default_rng(2).uniform(-150, 150, (60, 3))
    feet, error = frame_in(frame, "EPSG:2227", places)
    metres, _ = frame_in(frame, "EPSG:32610", places)
    assert feet.scale == pytest.approx(metres.scale * 3937 / 1200, rel=1e-3) and error < 0.1
    assert feet.to_world(np.zeros(3))[2] == pytest.approx(300 * 3937 / 1200, abs=0.1)
    assert metres.to_world(np.zeros(3))[2] == pytest.approx(300, abs=0.1)
    back, error = frame_in(feet, "EPSG:4978", places)
    np.testing.assert_allclose(back.to_world(places), frame.to_world(places), atol=0.1)
    refused(ValueError, "heights in another unit", frame_in, frame, "EPSG:2227+5703", places)
    assert system_of_lengths("EPSG:2227+8228").axis_info[2].unit_name == "foot"  # beside US survey feet
    # A system with TOWGS84 is bound to its parameters.
    system = "+proj=utm +zone=10 +ellps=WGS84 +towgs84=0,0,0 +units=us-ft +type=crs"
    bound, _ = frame_in(frame, system, places)
    assert bound.to_world(np.zeros(3))[2] == pytest.approx(300 * 3937 / 1200, abs=0.1)
    engineering = 'LOCAL_CS["site",UNIT["metre",1]]'
    refused(ValueError, "to EPSG:4978: Error creating", converted, places, engineering, "EPSG:4978")


def test_a_projection_of_another_place_and_missing_grids_are_named():
    pyproj = pytest.importorskip("pyproj")
    frame = enu_frame(48.0, 11.5, 500.0, "here")
    places = np.random.default_rng(2).uniform(-150, 150, (60, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for near in ("EPSG:25832", "EPSG:25833", "EPSG:4978"):
            frame_in(frame, near, places)
    warned(
        r"lengths in EPSG:3857 .* are 1.[0-9]+ times those on the ground",
        frame_in,
        frame,
        "EPSG:3857",
        places,
    )
    warned("lengths in EPSG:32610 .* times those", frame_in, frame, "EPSG:32610", places)
    if not pyproj.transformer.TransformerGroup("EPSG:4979", "EPSG:25832+7837").best_available:
        message = r"to ETRS89 / UTM zone 32N \+ DHHN2016 height, places may be .* \(de_bkg_gcg2016.tif\)"
        warned(message, frame_in, frame, "EPSG:25832+7837", places)


TILT = Rotation.from_euler("xyz", [3, -8, 100], degrees=True).as_matrix()
SHIFT = np.array([512_345.0, 5_012_345.0, 250.0])


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    """A capture with distorted lenses, and its points as they would be surveyed and marked."""
    posed = files.Posed(origin=np.array([100.0, -50.0, 20.0]))
    root = posed.write_images(tmp_path_factory.mktemp("capture"))
    files.opensfm(posed, root / "reconstruction.json")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        capture = load_capture(root)
    world = 1.7 * posed.points @ TILT.T + SHIFT
    marks = [
        [(name, *posed.pixels(i)[k].tolist()) for i, name in enumerate(posed.names)]
        for k in range(len(posed.points))
    ]
    return posed, capture, [ControlPoint(f"P{k}", world[k], marks[k]) for k in range(len(world))]


def test_the_similarity_is_recovered_from_marks_in_distorted_photographs(setting):
    posed, capture, points = setting
    placed = place(points[:8], capture.cameras, capture.offset)
    np.testing.assert_allclose([p.position for p in placed], posed.points[:8], atol=1e-9)
    frame = align(placed, capture.offset, "EPSG:32633", "test")
    assert frame.scale == pytest.approx(1.7, abs=1e-9)
    np.testing.assert_allclose(frame.rotation, TILT, atol=1e-9)
    np.testing.assert_allclose(frame.to_world(posed.points), [p.world for p in points], atol=5e-9)
    assert all(np.linalg.norm(p.offset) < 5e-9 and p.reprojection < 1e-6 and not p.problem for p in placed)


def test_a_wrong_survey_and_unusable_points_are_named_and_left_out(setting):
    posed, capture, points = setting
    wrong = ControlPoint("wrong", points[8].world + [0.4, 0, 0.3], points[8].marks)
    single = ControlPoint("single", points[9].world, points[9].marks[:1] + [("nowhere.jpg", 1.0, 2.0)])
    narrow = ControlPoint("narrow", points[10].world, [points[10].marks[0]] * 2)
    placed = place([*points[:7], wrong, single, narrow], capture.cameras, capture.offset)
    frame = align(placed, capture.offset, "", "test")
    np.testing.assert_allclose(frame.rotation, TILT, atol=1e-9)
    problems = {p.name: p.problem for p in placed if p.problem}
    assert problems["wrong"] == "contradicts the others and is left out"
    assert problems["single"].startswith("marked in fewer than 2 views (nowhere.jpg is none, or")
    assert problems["narrow"].startswith("marked in fewer than 2 views")
    np.testing.assert_allclose(placed[7].offset, [-0.4, 0, -0.3], atol=1e-7)
    assert 1 < placed[7].reprojection < 20
    # Marks of half a pixel of noise give residuals of that size.
    noise = np.random.default_rng(3)
    noisy = [
        ControlPoint(p.name, p.world, [(n, *noise.normal([x, y], 0.3).tolist()) for n, x, y in p.marks])
        for p in points[:20]
    ]
    placed = place(noisy, capture.cameras, capture.offset)
    align(placed, capture.offset, "", "test")
    assert 0.2 < np.sqrt(np.mean([p.reprojection**2 for p in placed if not p.problem])) < 0.6


def test_folders_tell_photographs_of_one_name_apart(setting):
    """Drones count from 1 again on each flight."""
    _, capture, points = setting
    names = [f"Flug {1 + i % 2}/DJI_{i // 2:04d}.JPG" for i in range(len(capture.cameras))]
    cameras = [replace(c, name=f"images/{name}") for c, name in zip(capture.cameras, names, strict=True)]
    by_old = dict(zip((c.name for c in capture.cameras), names, strict=True))
    exact = place(points[:1], capture.cameras, capture.offset)[0]

    def placed(change, some):
        marks = [(change(by_old[name]), x, y) for name, x, y in points[0].marks]
        return place([ControlPoint("P", points[0].world, marks)], some, capture.offset)[0]

    for change in (str, "images/{}".format, r"C:\site\{}".format, lambda name: name.upper()):
        np.testing.assert_array_equal(placed(change, cameras).position, exact.position)
    assert "is none, or several" in placed(lambda name: name.rpartition("/")[2], cameras).problem
    # A mark in a photograph without a pose is not one in that of another flight.
    first = [camera for camera in cameras if "Flug 1" in camera.name]
    assert len(placed(str, first).seen) == len(first) < len(cameras)
    loose = [replace(camera, name=camera.name.rpartition("/")[2]) for camera in first]
    marks = [mark for mark in points[0].marks if "Flug 1" in by_old[mark[0]]]
    moved = [(f"D:/{by_old[name]}", x, y) for name, x, y in marks]
    point = ControlPoint("P", points[0].world, moved)
    assert len(place([point], loose, capture.offset)[0].seen) == len(first)
    # Which of two flights the photographs without folders are of is unknown.
    other = [(name.replace("Flug 1", "Flug 2"), x, y) for name, x, y in moved]
    assert not place([replace(point, marks=moved + other)], loose, capture.offset)[0].seen


def test_points_on_a_line_and_too_few_are_refused(setting):
    posed, capture, points = setting
    placed = place(points[:2], capture.cameras, capture.offset)
    with pytest.raises(ValueError, match="2 of 2 control points can be used, and 3 are needed"):
        align(placed, capture.offset, "", "")
    placed = place(points[:5], capture.cameras, capture.offset)
    for k, point in enumerate(placed):
        point.position = posed.points[0] + k * np.array([1.0, 0.5, 0.0])
    refused(ValueError, "the 5 points lie on a line in the capture", align, placed, capture.offset, "", "")


def test_rays_that_hardly_differ_and_marks_outside_the_lens_are_refused(setting):
    posed, capture, points = setting
    far = [ControlPoint("far", points[0].world, [(n, 48.0, 36.0) for n, _, _ in points[0].marks[:2]])]
    shared = capture.cameras[0]
    twin = type(shared)(**{**shared.__dict__, "name": capture.cameras[1].name})
    assert "its rays differ by 0 degrees only" in place(far, [shared, twin], capture.offset)[0].problem
    off = [ControlPoint("off", points[0].world, [(n, 4000.0, 36.0) for n, _, _ in points[0].marks[:2]])]
    problem = place(off, capture.cameras, capture.offset)[0].problem
    assert problem == "the mark 4000, 36 is outside a photograph of 96 x 72"
    lens = Lens("BROWN", 96, 72, (80, 80, 48, 36, -0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))  # maps up to 32 pixels
    refused(ValueError, "the mark 94, 36 is outside what its lens of 96 x 72 maps", normalised, lens, 94, 36)


def test_both_files_of_points_are_read(setting, tmp_path):
    _, _, points = setting
    rows = [(p.name, *p.world, *mark) for p in points[:3] for mark in p.marks]
    text = "name;Easting;Northing;Height;image;x;y\n"
    text += "".join(";".join(map(str, row)) + "\n" for row in rows)
    (tmp_path / "points.csv").write_text(text, encoding="utf-8-sig")
    found, crs = read_control_points(tmp_path / "points.csv")
    assert crs == "" and [p.name for p in found] == ["P0", "P1", "P2"]
    np.testing.assert_array_equal([p.world for p in found], [p.world for p in points[:3]])
    assert found[1].marks == points[1].marks
    (tmp_path / "comma.csv").write_text(text.replace(".", ",").replace(",JPG", ".JPG"))
    assert [p.marks for p in read_control_points(tmp_path / "comma.csv")[0]] == [p.marks for p in found]
    text = "WGS84 UTM 32N\n" + "".join(
        f"{e} {n} {h} {x} {y} {image} {name}\n" for name, e, n, h, image, x, y in rows
    )
    (tmp_path / "gcp_list.txt").write_text(text)
    again, crs = read_control_points(tmp_path / "gcp_list.txt")
    assert crs == "EPSG:32632" and [p.marks for p in again] == [p.marks for p in found]
    tabs = [
        "\t".join(map(str, (e, n, h, x, f"\t{y}", f"Flug 1/{image[:3]} 1.JPG ")))
        for _, e, n, h, image, x, y in rows
    ]
    (tmp_path / "gcp_list.txt").write_text("\n".join(["EPSG:32632", *tabs, "\t" * 6]))
    again, _ = read_control_points(tmp_path / "gcp_list.txt")
    assert {mark[0] for p in again for mark in p.marks} == {"Flug 1/DJI 1.JPG"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,E,N,image,x,y\n", "line 1: the columns h are missing"),
        ("name,E,N,h,image,x,y\nA,1,2,3,i.jpg,4\n", "line 2: 6 values in 7 columns"),
        ("name,E,N,h,image,x,y\nA,1,2,nan,i.jpg,4,5\n", "line 2: h must be a finite number, got 'nan'"),
        ("name,E,N,h,image,x,y\nA,1,2,3,,4,5\n", "line 2: a name or an image is missing"),
        ("name,E,N,h,image,x,y\nA,1,2,3,i.jpg,4,5\nA,1,2,9,j.jpg,4,5\n", "line 3: A has another place"),
        ("EPSG:32633\n1 2 3 4 5\n", "line 2: expected E, N, h, x, y and an image"),
        ("EPSG:32633\n", "no points: expected the columns"),
    ],
)
def test_damaged_files_of_points_are_refused_by_line(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    refused(ValueError, message, read_control_points, tmp_path / "p.csv")
