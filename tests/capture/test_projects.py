# SPDX-License-Identifier: Apache-2.0
"""Projects of other programs give the pixels, points and world of the capture that they were written from."""

import re
import shutil

import numpy as np
import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.capture.layouts import read_layout
from blitzgs.capture.projects.metashape import read_metashape
from blitzgs.capture.projects.realitycapture import read_realitycapture
from tests.capture import helpers as files
from tests.helpers import refused

pytestmark = pytest.mark.filterwarnings("ignore")
UTM = np.array([412_345.0, 5_654_321.0, 120.0])


def residual(capture, views, points=None):
    """Largest distance in pixels of the capture's points, `points` in the coordinates of the views."""
    points = capture.points if points is None else points
    assert [view.name for view in views] == capture.names
    worst = 0.0
    for index, view in enumerate(views):
        x, y, z = view.world_to_camera[:3, :3] @ points.T + view.world_to_camera[:3, 3:]
        found = np.stack(view.lens.project(x / z, y / z), axis=1)
        worst = max(worst, np.abs(found - capture.pixels(index)).max())
    return worst


def read(root):
    return read_layout(root, "images", 1)


def test_metashape(tmp_path):
    capture = files.Posed(origin=np.array([3_900_000.0, 1_000_000.0, 4_900_000.0]))
    chunk, scale, shift = files.metashape(capture, capture.write_images(tmp_path) / "cameras.xml")
    views, points, source = read(tmp_path)
    assert residual(capture, views, (capture.points - shift) @ chunk / scale) < 1e-5  # float64 at 5e6
    assert views[0].path == tmp_path / "images" / "DJI_0000.JPG"
    assert source.cameras == "cameras.xml (Metashape)" and len(points.positions) == 0
    assert source.frame.crs == "EPSG:4978"
    local = (capture.points - shift) @ chunk / scale
    np.testing.assert_allclose(source.frame.to_world(local), capture.points, atol=1e-8)
    np.testing.assert_allclose(source.frame.from_world(capture.points), local, atol=1e-8)
    assert any("1 photographs of the project have no pose" in note for note in source.notes)
    text = (tmp_path / "cameras.xml").read_text().replace(' component_id="2"', "")
    (tmp_path / "cameras.xml").write_text(text.replace('id="3" ', 'id="3" enabled="false" '))
    views, _, again = read(tmp_path)
    assert len(views) == 5 and again.frame.scale == source.frame.scale


def test_metashape_affinity_fourth_radial_and_old_fields(tmp_path):
    capture = files.Posed()
    files.metashape(capture, tmp_path / "cameras.xml", k4=0.004, b1=1.25, b2=-0.75)
    view = read_metashape(tmp_path / "cameras.xml").views[2]
    x, y = np.array([0.31, -0.4]), np.array([-0.22, 0.1])
    r2 = x * x + y * y
    (k1, k2, k3), k4, (p2, p1) = capture.k, 0.004, capture.p
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xs = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    ys = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    u = capture.cx + xs * capture.fy + xs * 1.25 + ys * -0.75
    np.testing.assert_allclose(view.lens.project(x, y), [u, capture.cy + ys * capture.fy], atol=1e-9)
    scaled = view.lens.scaled(2 * files.WIDTH, 2 * files.HEIGHT)
    np.testing.assert_allclose(scaled.project(x, y)[0], 2 * u, atol=1e-9)


def test_metashape_fisheye(tmp_path):
    capture = files.Posed()
    files.metashape(capture, tmp_path / "cameras.xml", sensor_type="fisheye")
    lens = read_metashape(tmp_path / "cameras.xml").views[0].lens
    theta = np.arctan(np.hypot(0.9, 0.5))
    x, y = np.array([0.9, 0.5]) / np.hypot(0.9, 0.5) * theta
    radial = 1 + capture.k[0] * theta**2 + capture.k[1] * theta**4 + capture.k[2] * theta**6
    u = x * radial + capture.p[1] * (theta**2 + 2 * x * x) + 2 * capture.p[0] * x * y
    found = lens.project(np.array([0.9]), np.array([0.5]))[0][0]
    assert found == pytest.approx(capture.cx + capture.fx * u, abs=1e-9)


@pytest.mark.parametrize(
    ("separator", "mark", "header"),
    [(",", ".", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"),
     (";", ".", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"),
     (";", ",", "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2")],
)  # fmt: skip
def test_realitycapture_with_the_points_of_a_bundle(tmp_path, separator, mark, header):
    capture = files.Posed(origin=UTM)
    path = capture.write_images(tmp_path) / "registration.csv"
    files.realitycapture(capture, path, header)
    text = re.sub(r"(?<=[0-9])[.](?=[0-9])", mark, path.read_text().replace(",", separator))
    path.write_text(text)
    files.bundler(capture, tmp_path / "bundle.out")
    views, points, source = read(tmp_path)
    assert residual(capture, views) < 1e-4
    np.testing.assert_allclose(points.positions, capture.points, atol=1e-8)
    assert source.cameras == "registration.csv (RealityCapture)"


@pytest.mark.parametrize("letters", ["utf-8", "utf-8-sig", "cp1252"])
def test_names_with_umlauts_are_read_as_windows_and_others_write_them(tmp_path, letters):
    capture = files.Posed(names=[f"Fl\u00e4che {i}.JPG" for i in range(6)])
    path = capture.write_images(tmp_path) / "registration.csv"
    files.realitycapture(capture, path)
    path.write_text(path.read_text("utf-8-sig"), encoding=letters)
    assert [camera.name for camera in load_capture(tmp_path).cameras] == capture.names


def test_realitycapture_angles_are_those_of_its_help(tmp_path):
    angles = {"down.jpg": "0,0", "down_east.jpg": "90,0", "north.jpg": "0,90", "east.jpg": "90,90"}
    rows = [f"{name},{angle},0,1,2,3,30\n" for name, angle in angles.items()]
    (tmp_path / "r.csv").write_text("#name,heading,pitch,roll,x,y,alt,f\n" + "".join(rows))
    views = read_realitycapture(tmp_path / "r.csv").views
    right, down, forward = np.stack([view.world_to_camera[:3, :3] for view in views], axis=1)
    np.testing.assert_allclose(forward, [[0, 0, -1], [0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(-down, [[0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(right[:2], [[1, 0, 0], [0, -1, 0]], atol=1e-12)


def test_realitycapture_in_degrees_is_refused(tmp_path):
    capture = files.Posed()
    path = capture.write_images(tmp_path) / "registration.csv"
    files.realitycapture(capture, path)
    assert len(read(tmp_path)[0]) == 6
    usual, capture.centres = capture.centres, capture.centres * [1e-3, 1e-3, 1.0]  # of a mast
    files.realitycapture(capture, path)
    assert len(read(tmp_path)[0]) == 6
    capture.centres = usual * [1e-5, 0.9e-5, 1.0] + [13.4, 52.5, 80.0]
    files.realitycapture(capture, path)
    refused(ValueError, "registration.csv: x and y are longitudes and latitudes, .* UTM", read, tmp_path)
    capture.centres = np.zeros((6, 3))  # a camera on a tripod
    files.realitycapture(capture, path)
    assert len(read(tmp_path)[0]) == 6


def test_bundler(tmp_path):
    names = [f"Flug 0 {i}.JPG" for i in range(6)]
    middle = {"cx": files.WIDTH / 2, "cy": files.HEIGHT / 2}
    capture = files.Posed(names=names, k=(-0.1, 0.02, 0.0), p=(0.0, 0.0), **middle)
    files.bundler(capture, capture.write_images(tmp_path) / "bundle.out")
    listed = tmp_path / "list.txt"  # a line may have the focal length
    listed.write_text(listed.read_text().replace("0 2.JPG", "0 2.JPG 0 1234.5"))
    views, points, source = read(tmp_path)
    assert residual(capture, views) < 1e-9
    np.testing.assert_array_equal(points.positions, capture.points)
    np.testing.assert_array_equal(points.colors, capture.colors)
    assert points.track_lengths.tolist() == [2] * 40
    assert any("1 photographs of the project have no pose" in note for note in source.notes)


def test_pix4d(tmp_path):
    capture = files.Posed(origin=UTM)
    files.pix4d(capture, capture.write_images(tmp_path) / "1_initial" / "params", UTM - [7, 8, 9])
    views, _, source = read(tmp_path)
    assert residual(capture, views, capture.points - UTM + [7, 8, 9]) < 1e-9
    np.testing.assert_allclose(source.frame.to_world(np.array([1.0, 2, 3])), UTM + [-6, -6, -6], atol=1e-9)
    assert source.frame.name == "WGS 84 / UTM zone 33N"
    parameters = tmp_path / "1_initial" / "params" / "site_calibrated_camera_parameters.txt"
    loaded = load_capture(parameters)
    assert loaded.root == tmp_path and len(loaded.cameras) == 6


def test_opf(tmp_path):
    capture = files.Posed(origin=UTM)
    files.opf(capture, capture.write_images(tmp_path), -UTM)
    views, _, source = read(tmp_path)
    assert residual(capture, views, capture.points - UTM) < 1e-7
    assert source.frame.crs == "EPSG:32633"
    np.testing.assert_allclose(source.frame.to_world(capture.points - UTM), capture.points, atol=1e-9)
    assert any("1 photographs of the project have no pose" in note for note in source.notes)


def test_opensfm(tmp_path):
    pyproj = pytest.importorskip("pyproj")
    capture = files.Posed()
    files.opensfm(capture, capture.write_images(tmp_path) / "reconstruction.json", (47.5, 8.25, 432.0))
    views, points, source = read(tmp_path)
    assert residual(capture, views) < 1e-9
    np.testing.assert_array_equal(points.positions, capture.points)
    geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    place = geodetic.transform(*source.frame.to_world(np.array([0.0, 0.0, 100.0])))
    np.testing.assert_allclose(place, [8.25, 47.5, 532.0], atol=1e-8)
    north = geodetic.transform(*source.frame.to_world(np.array([0.0, 100.0, 0.0])))
    assert north[1] - 47.5 == pytest.approx(100 / 111_178, rel=1e-3) and abs(north[0] - 8.25) < 1e-9
    assert any("of 2 reconstructions" in note for note in source.notes)


def test_opendronemap_offset_or_its_topocentric_original(tmp_path):
    capture = files.Posed()
    folder = capture.write_images(tmp_path) / "opensfm"
    files.opensfm(capture, folder / "reconstruction.json")
    (tmp_path / "odm_georeferencing").mkdir()
    (tmp_path / "odm_georeferencing" / "coords.txt").write_text("WGS84 UTM 33S\n412345 5654321\n1 2 3\n")
    _, _, source = read(tmp_path)
    assert source.frame.crs == "EPSG:32733"
    np.testing.assert_array_equal(source.frame.to_world(np.zeros(3)), [412345, 5654321, 0])
    files.opensfm(capture, folder / "reconstruction.topocentric.json", (47.5, 8.25, 432.0))
    _, _, source = read(tmp_path)
    assert source.frame.crs == "EPSG:4978"


def test_a_label_without_a_suffix_finds_its_photograph_in_a_folder(tmp_path):
    capture = files.Posed(names=[f"flight_1/a{i}.JPG" for i in range(6)])
    path = capture.write_images(tmp_path) / "export.xml"
    files.metashape(capture, path, labels=[f"A{i}" for i in range(6)])
    loaded = load_capture(tmp_path / "export.xml")
    assert [camera.image_path.name for camera in loaded.cameras] == [f"a{i}.JPG" for i in range(6)]
    assert loaded.cameras[0].name == "flight_1/a0.JPG"
    (images := tmp_path / "images").joinpath("flight_2").mkdir()
    shutil.copy(images / "flight_1/a0.JPG", images / "flight_2")
    with pytest.raises(ValueError, match=r"2 files could be the photograph A0 \(flight_1/a0.JPG, flight_2/a"):
        load_capture(tmp_path / "export.xml")
    shutil.copy(images / "flight_1/a0.JPG", images)
    assert load_capture(tmp_path / "export.xml").cameras[0].name == "a0.JPG"


def test_several_projects_are_refused_by_name(tmp_path):
    capture = files.Posed()
    files.metashape(capture, capture.write_images(tmp_path) / "a.xml")
    files.realitycapture(capture, tmp_path / "b.csv")
    refused(ValueError, r"2 projects \(a.xml, b.csv\): name one .* with --data", load_capture, tmp_path)
    assert len(load_capture(tmp_path / "b.csv").cameras) == 6
    with pytest.raises(FileNotFoundError, match="DJI_0000.JPG is no project that can be read"):
        load_capture(tmp_path / "images" / "DJI_0000.JPG")


PIX4D = "params/site_calibrated_camera_parameters.txt"
WRITERS = {
    "c.xml": files.metashape,
    "r.csv": files.realitycapture,
    "bundle.out": files.bundler,
    PIX4D: lambda capture, path: files.pix4d(capture, path.parent, UTM),
    "project.opf": lambda capture, path: files.opf(capture, path.parent, UTM),
    "reconstruction.json": files.opensfm,
}
LEVELS = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
BOMB = f'<!DOCTYPE d [<!ENTITY e0 "lol">{LEVELS}]><document><chunk>&e9;</chunk></document>'
EXTERNAL = '<!DOCTYPE d [<!ENTITY e SYSTEM "file:///etc/passwd">]><document><chunk>&e;</chunk></document>'


def cut(count):
    return lambda text: "\n".join(text.splitlines()[:count])


# A file, a text in it and what takes its place, or a function of all its text, and the message.
DAMAGE = [
    ("c.xml", lambda _: BOMB, r"c.xml: line 1: no readable XML \(it defines entities"),
    ("c.xml", lambda _: EXTERNAL, r"c.xml: line 1: no readable XML \(it defines entities"),
    ("c.xml", ("</cameras>", "</camera>"), r"c.xml: line \d+: no readable XML"),
    ("c.xml", ('type="frame">', 'type="spherical">'), "sensor 7: type 'spherical' makes"),
    ("c.xml", ("<f>81.5</f>", "<f>nan</f>"), "sensor 7: f must be a finite number, got 'nan'"),
    ("c.xml", ('height="72"/>\n<f>', 'height="1e9"/>\n<f>'), "is no size of an image"),
    ("c.xml", ('"><transform>', '"><transform>2 '), r"camera 0 .*transform: expected 16 num"),
    ("r.csv", ("DJI_0001.JPG,", "DJI_0001.JPG,x"), "line 4: x must be a finite number"),
    ("r.csv", ("DJI_0001.JPG,", ""), "line 4: 15 values in 16 columns"),
    ("bundle.out", cut(100), "bundle.out: 100 lines are too few for 7 cameras and 40 points"),
    ("bundle.out", ("7 40\n", "7 4000000000\n"), "expected the numbers of cameras and points"),
    ("bundle.out", ("\n2 0 11 1.5", f"\n{10**20} 0 11 1.5"), "a point has not three lines of numbers"),
    (PIX4D, cut(-2), "58 lines are not 10 for each camera: it is cut off"),
    (PIX4D, ("0 0 1\n", "0 1\n"), "line 9: K, row 3: expected 3 numbers, got 2"),
    ("project.opf", ("calibrated", "other"), r"has no application/opf-calibrated-cameras\+json"),
    ("project.opf", ("camera-list%201.json", "../secret.json"), "'../secret.json' leads outside the project"),
    ("reconstruction.json", ("brown", "spherical"), "'spherical' cannot be read; known:"),
    ("reconstruction.json", ('"shots"', '"shot"'), "the field shots is missing"),
    ("reconstruction.json", ('"coordinates": [', f'"coordinates": [{10**400}, '), "points: expected three"),
    ("reconstruction.json", ('"points": {', '"points": [1], "other": {'), "points: expected three"),
    ("reconstruction.json", ("[{", "["), "reconstruction.json: no JSON"),
    ("reconstruction.json", ('"width": 96', '"width": Infinity'), "a finite number, got inf"),
]


@pytest.mark.parametrize(("name", "change", "message"), DAMAGE)
def test_damaged_and_hostile_projects_are_refused(tmp_path, name, change, message):
    capture = files.Posed()
    WRITERS[name](capture, capture.write_images(tmp_path) / name)
    text = (tmp_path / name).read_text()
    damaged = change(text) if callable(change) else text.replace(*change)
    assert damaged != text
    (tmp_path / name).write_text(damaged)
    refused(ValueError, message, load_capture, tmp_path)
