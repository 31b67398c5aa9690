# SPDX-License-Identifier: Apache-2.0
"""Ground control points: the similarity from marks in photographs, outliers, and what is refused."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blitzgs.capture.capture import load_capture
from blitzgs.capture.control_points import ControlPoint, align, normalised, place, read_control_points
from blitzgs.capture.lens import Lens
from tests.capture import project_files as files

TURN = Rotation.from_euler("xyz", [3, -8, 100], degrees=True).as_matrix()
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
    world = 1.7 * posed.points @ TURN.T + SHIFT
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
    np.testing.assert_allclose(frame.rotation, TURN, atol=1e-9)
    np.testing.assert_allclose(frame.to_world(posed.points), [p.world for p in points], atol=5e-9)
    assert all(np.linalg.norm(p.offset) < 5e-9 and p.reprojection < 1e-6 and not p.problem for p in placed)


def test_a_wrong_survey_and_unusable_points_are_named_and_left_out(setting):
    posed, capture, points = setting
    wrong = ControlPoint("wrong", points[8].world + [0.4, 0, 0.3], points[8].marks)
    single = ControlPoint("single", points[9].world, points[9].marks[:1] + [("nowhere.jpg", 1.0, 2.0)])
    narrow = ControlPoint("narrow", points[10].world, [points[10].marks[0]] * 2)
    placed = place([*points[:7], wrong, single, narrow], capture.cameras, capture.offset)
    frame = align(placed, capture.offset, "", "test")
    np.testing.assert_allclose(frame.rotation, TURN, atol=1e-9)
    problems = {p.point.name: p.problem for p in placed if p.problem}
    assert problems["wrong"] == "contradicts the others and is left out"
    assert problems["single"] == "marked in fewer than 2 views (nowhere.jpg is none)"
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


def test_points_on_a_line_and_too_few_are_refused(setting):
    posed, capture, points = setting
    placed = place(points[:2], capture.cameras, capture.offset)
    with pytest.raises(ValueError, match="2 of 2 control points can be used, and 3 are needed"):
        align(placed, capture.offset, "", "")
    placed = place(points[:5], capture.cameras, capture.offset)
    for k, point in enumerate(placed):
        point.position = posed.points[0] + k * np.array([1.0, 0.5, 0.0])
    with pytest.raises(ValueError, match="the 5 points lie on a line in the capture"):
        align(placed, capture.offset, "", "")


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
    with pytest.raises(ValueError, match="the mark 94, 36 is outside what its lens of 96 x 72 maps"):
        normalised(lens, 94, 36)


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
    text = "WGS84 UTM 32N\n" + "".join(
        f"{e} {n} {h} {x} {y} {image} {name}\n" for name, e, n, h, image, x, y in rows
    )
    (tmp_path / "gcp_list.txt").write_text(text)
    again, crs = read_control_points(tmp_path / "gcp_list.txt")
    assert crs == "EPSG:32632" and [p.marks for p in again] == [p.marks for p in found]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,E,N,image,x,y\n", "line 1: the columns h are missing"),
        ("name,E,N,h,image,x,y\nA,1,2,3,i.jpg,4\n", "line 2: 6 values in 7 columns"),
        (
            "name,E,N,h,image,x,y\nA,1,2,nan,i.jpg,4,5\n",
            "line 2: a name, an image or a finite number is missing",
        ),
        ("name,E,N,h,image,x,y\nA,1,2,3,i.jpg,4,5\nA,1,2,9,j.jpg,4,5\n", "line 3: A has another place"),
        ("EPSG:32633\n1 2 3 4 5\n", "line 2: expected E, N, h, x, y and an image"),
        ("EPSG:32633\n", "no points: expected the columns"),
    ],
)
def test_damaged_files_of_points_are_refused_by_line(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_control_points(tmp_path / "p.csv")
