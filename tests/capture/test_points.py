# SPDX-License-Identifier: Apache-2.0
"""Points of PLY, LAS, LAZ and E57 files, in the coordinates of the cameras whatever their own are."""

import json
import re
import shutil
import struct
import warnings

import numpy as np
import plyfile
import pytest

from blitzgs.capture import colmap
from blitzgs.capture.capture import load_capture
from blitzgs.capture.layouts import read_layout
from blitzgs.capture.points import file_points
from blitzgs.formats.ply import read_point_cloud
from blitzgs.training import understood
from tests.capture import helpers as files
from tests.capture.helpers import as_text, frame, warned, write_capture, write_ply, write_transforms
from tests.helpers import refused

pytestmark = pytest.mark.filterwarnings("ignore")
COUNT = 50
COLORS = np.random.default_rng(0).integers(0, 256, (COUNT, 3))
POSITIONS = np.random.default_rng(1).uniform(-1, 1, (COUNT, 3))
C0 = 0.28209479177387814


WORDS = ["red green blue", "Red Green Blue", "RED GREEN BLUE", "r g b", "R G B", "color_r color_g color_b"]


@pytest.mark.parametrize("words", [*WORDS, "diffuse_red diffuse_green diffuse_blue"])
@pytest.mark.parametrize("kind", ["u1", "i4", "u2", "f4", "f8", "fraction"])
def test_colours_by_name_and_kind_of_number(tmp_path, words, kind):
    values = COLORS / 255 if kind == "fraction" else COLORS
    kind = "f4" if kind == "fraction" else kind
    cloud = read_point_cloud(write_ply(tmp_path / "a.ply", POSITIONS, values, words.split(), kind))
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.colors_from == words.lower().replace(" ", ", ")


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(
    ("change", "is_fraction"),
    [
        (1.0000001, True),
        (1.04, True),
        (-1e-7, True),
        (1.9, True),
        (4.0, True),
        (255.0001, False),
        (-0.4, False),
    ],
)
def test_colours_that_overshoot_their_range(tmp_path, kind, change, is_fraction):
    values = COLORS / 255 if is_fraction else COLORS.astype(float)
    values[0, 0] = change
    colors = read_point_cloud(write_ply(tmp_path / "a.ply", POSITIONS, values, kind=kind)).colors
    np.testing.assert_array_equal(colors[1:], COLORS[1:])
    assert colors[0, 0] == (255 if change > 1 else 0)


@pytest.mark.parametrize("extra", [(), ("opacity", "scale_0", "rot_0", "f_rest_0")])
def test_gaussians_have_the_colour_that_all_sides_show(tmp_path, extra):
    names = ("f_dc_0", "f_dc_1", "f_dc_2", *extra)
    values = np.zeros((COUNT, len(names)))
    values[:, :3] = (COLORS / 255 - 0.5) / C0
    cloud = read_point_cloud(write_ply(tmp_path / "a.ply", POSITIONS, values, names, "f4"))
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.colors_from == "f_dc_0 to f_dc_2"
    values[3, 1] = np.nan
    with pytest.raises(ValueError, match="a.ply: a point has the colour nan"):
        read_point_cloud(write_ply(tmp_path / "a.ply", POSITIONS, values, names, "f4"))


def test_coefficients_beyond_black_and_white_are_clipped(tmp_path):
    values = np.tile([[-9.0, 0.0, 9.0]], (COUNT, 1))
    cloud = read_point_cloud(
        write_ply(tmp_path / "a.ply", POSITIONS, values, ("f_dc_0", "f_dc_1", "f_dc_2"), "f4")
    )
    assert (cloud.colors == [0, 128, 255]).all()


def test_capital_axes_are_read(tmp_path):
    cloud = read_point_cloud(write_ply(tmp_path / "a.ply", POSITIONS, axes="XYZ"))
    np.testing.assert_allclose(cloud.positions, POSITIONS, atol=1e-6)


def transforms_capture(root, names=4, **fields):
    """A transforms.json beside a COLMAP model of the same cameras in colmap/sparse/0."""
    write_capture(root, [f"{i}.png" for i in range(names)])
    (root / "colmap").mkdir()
    (root / "sparse").rename(root / "colmap" / "sparse")
    model = colmap.read_model(root / "colmap" / "sparse" / "0")
    applied = np.eye(4)
    applied[:3] = np.array(fields.get("applied_transform", applied[:3]))
    frames = []
    for name, world_to_camera in zip(model.images.names, colmap.world_to_camera(model.images), strict=True):
        pose = applied @ np.linalg.inv(world_to_camera) @ np.diag([1, -1, -1, 1.0])
        pose[:3, 3] *= fields.get("applied_scale", 1.0)
        frames.append(frame(f"images/{name}", pose))
    write_transforms(root, frames, w=64, h=48, fl_x=51.2, **fields)
    return model


APPLIED = [[1, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 0]]


@pytest.mark.parametrize(
    "fields", [{}, {"applied_transform": APPLIED}, {"applied_transform": APPLIED, "applied_scale": 0.25}]
)
def test_the_points_of_colmap_beside_transforms_are_used_in_their_world(tmp_path, fields):
    model = transforms_capture(tmp_path, **fields)
    capture = load_capture(tmp_path)
    matrix = np.array(fields.get("applied_transform", np.eye(4)[:3]))
    expected = (model.points.positions @ matrix[:, :3].T + matrix[:, 3]) * fields.get("applied_scale", 1.0)
    np.testing.assert_allclose(capture.points + capture.offset, expected, atol=1e-9)
    np.testing.assert_array_equal(capture.colors, model.points.colors)
    assert capture.about.points_from == "colmap/sparse/0/points3D.bin" and capture.about.blind == 0


def test_points_of_another_world_are_named_and_not_used(tmp_path):
    transforms_capture(tmp_path, applied_transform=APPLIED)
    content = json.loads((tmp_path / "transforms.json").read_text())
    del content["applied_transform"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning) as said:
        capture = load_capture(tmp_path)
    text = " ".join(str(warning.message) for warning in said)
    assert re.search("the 20 points of colmap/sparse/0 are not used: its cameras are elsewhere", text)
    assert capture.about.random_points


@pytest.mark.parametrize("name", ["sparse_pc.ply", "points3D.ply", "points3d.ply"])
def test_clouds_beside_transforms_that_programs_write(tmp_path, name):
    transforms_capture(tmp_path)
    write_ply(tmp_path / name, POSITIONS, COLORS)
    capture = load_capture(tmp_path)
    np.testing.assert_allclose(capture.points + capture.offset, POSITIONS, atol=1e-6)
    np.testing.assert_array_equal(capture.colors, COLORS)
    assert (capture.about.points_from, capture.about.colors_from) == (name, "red, green, blue")


def test_any_other_cloud_beside_transforms_is_named(tmp_path):
    transforms_capture(tmp_path)
    (tmp_path / "colmap").rename(tmp_path / "other")
    write_ply(tmp_path / "cloud.ply", POSITIONS, COLORS)
    warned('cloud.ply beside it is not used.*"ply_file_path": "cloud.ply"', load_capture, tmp_path)


def test_points_without_colours_are_said(tmp_path):
    transforms_capture(tmp_path)
    write_ply(tmp_path / "sparse_pc.ply", POSITIONS, COLORS[:, :1], ("intensity",), "f4")
    with pytest.warns(UserWarning, match="no colours and start grey: the file has x, y, z, intensity"):
        assert (load_capture(tmp_path).colors == 128).all()


def test_a_file_of_points_that_is_missing_is_named(tmp_path):
    transforms_capture(tmp_path, ply_file_path="lost.ply")
    refused(FileNotFoundError, "lost.ply is missing", load_capture, tmp_path)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_a_colmap_model_with_its_points_in_a_ply(tmp_path, suffix):
    root = write_capture(tmp_path, [f"{i}.png" for i in range(4)])
    folder = root / "sparse" / "0"
    if suffix == ".txt":
        as_text(folder)
    (folder / f"points3D{suffix}").unlink()
    write_ply(folder / "points3D.ply", POSITIONS, COLORS)
    capture = load_capture(root)
    np.testing.assert_array_equal(capture.colors, COLORS)
    assert capture.about.points_from == "sparse/0/points3D.ply" and capture.track_lengths is None


def test_a_ply_beside_the_points_of_the_model_is_not_used(tmp_path):
    """INRIA's code writes one there."""
    root = write_capture(tmp_path, [f"{i}.png" for i in range(4)])
    write_ply(root / "sparse" / "0" / "points3D.ply", POSITIONS, COLORS)
    assert len(load_capture(root).points) == 20


UTM = np.array([412_345.0, 5_654_321.0, 120.0])


@pytest.mark.parametrize(("kind", "local"), [("f4", False), ("f8", False), ("f4", True)])
def test_points_that_float32_rounds_are_named(tmp_path, kind, local):
    capture = files.Posed(origin=np.zeros(3) if local else UTM)
    rows = np.zeros(len(capture.points), [(axis, kind) for axis in "xyz"])
    for axis, column in zip("xyz", capture.points.T, strict=True):
        rows[axis] = column
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(tmp_path / "p.ply")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        file_points(tmp_path / "p.ply")
    rounded = [
        str(w.message) for w in caught if "p.ply: its float32 positions are rounded to 0.5" in str(w.message)
    ]
    assert len(rounded) == (kind == "f4" and not local)


def write_las(path, positions, colors=None, crs=None):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3 if colors is not None else 0, version="1.4" if crs else "1.2")
    header.offsets, header.scales = positions.min(axis=0), [1e-4] * 3
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = positions.T
    if colors is not None:
        las.red, las.green, las.blue = colors.T
    las.write(str(path))


@pytest.mark.parametrize(("suffix", "factor"), [(".las", 257), (".laz", 1)])
def test_las_keeps_large_coordinates_and_colours_of_16_bits_or_bytes(tmp_path, suffix, factor):
    capture = files.Posed(origin=UTM)
    write_las(tmp_path / f"p{suffix}", capture.points, capture.colors * factor)
    found = file_points(tmp_path / f"p{suffix}")
    np.testing.assert_allclose(found.positions, capture.points, atol=0.51e-4)
    np.testing.assert_array_equal(found.colors, capture.colors)


def test_e57_applies_the_pose_of_each_scan(tmp_path):
    pye57 = pytest.importorskip("pye57")
    capture = files.Posed()
    file = pye57.E57(str(tmp_path / "scan.e57"), mode="w")
    red, green, blue = capture.colors.T.astype(np.uint8)
    turn = np.array([np.cos(0.3), 0, 0, np.sin(0.3)])  # about z
    c, s = np.cos(0.6), np.sin(0.6)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    for part in (slice(0, 15), slice(15, 40)):
        local = ((capture.points[part] - [1, 2, 3]) @ rotation).T
        data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), local, strict=True))
        data |= {"colorRed": red[part], "colorGreen": green[part], "colorBlue": blue[part]}
        file.write_scan_raw(data, rotation=turn, translation=np.array([1.0, 2.0, 3.0]))
    file.close()
    found = file_points(tmp_path / "scan.e57")
    np.testing.assert_allclose(found.positions, capture.points, atol=1e-6)
    np.testing.assert_array_equal(found.colors, capture.colors)


@pytest.mark.parametrize(
    ("at", "crs", "foot"), [((47.5, 8.25), "EPSG:32632", 1), ((37.5, -122.0), "EPSG:2227", 1200 / 3937)]
)
def test_points_of_another_reference_system_are_moved_to_the_cameras(tmp_path, at, crs, foot):
    """Metashape's cameras are in a chunk's coordinates, its points in UTM, or in feet."""
    pyproj = pytest.importorskip("pyproj")
    place = np.array(pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(*at, 432.0))
    capture = files.Posed(origin=place)
    chunk, scale, shift = files.metashape(capture, capture.write_images(tmp_path) / "cameras.xml")
    moved = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS(crs).to_3d()).transform(*capture.points.T)
    rows = np.stack(moved, axis=1) / [1, 1, foot]  # pyproj's heights are in metres
    write_las(tmp_path / "cloud.las", rows, capture.colors, pyproj.CRS(crs))
    _, points, _ = read_layout(tmp_path, "images", 1)
    local = (capture.points - shift) @ chunk / scale
    np.testing.assert_allclose(points.positions, local, atol=2e-4)


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4979"])
def test_points_without_a_reference_system_have_that_of_the_project(tmp_path, crs):
    """Metashape exports PLY in the chunk's reference system, which only its XML states."""
    pyproj = pytest.importorskip("pyproj")
    place = np.array(pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(47.5, 8.25, 432.0))
    capture = files.Posed(origin=place)
    path = capture.write_images(tmp_path) / "cameras.xml"
    chunk, scale, shift = files.metashape(capture, path)
    system = pyproj.CRS(crs).to_3d()
    wkt = pyproj.CRS(crs).to_wkt("WKT2_2019" if crs == "EPSG:4979" else "WKT1_GDAL")
    spheroid = 'SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]]'
    wkt = wkt.replace(spheroid, f"{spheroid},TOWGS84[0,0,0,0,0,0,0]")  # as Metashape writes
    path.write_text(
        re.sub("<reference>.*</reference>", lambda _: f"<reference>{wkt}</reference>", path.read_text())
    )
    moved = pyproj.Transformer.from_crs("EPSG:4978", system, always_xy=True).transform(*capture.points.T)
    write_ply(tmp_path / "cloud.ply", np.stack(moved, axis=1), capture.colors)
    loaded = warned(f"the points are in coordinates of {system.name}", read_layout, tmp_path, "images", 1)
    np.testing.assert_allclose(loaded[1].positions, (capture.points - shift) @ chunk / scale, atol=2e-4)
    write_ply(tmp_path / "cloud.ply", np.stack(moved, axis=1) + [1e9, 0, 0], capture.colors)
    with pytest.raises(ValueError, match="see none of the"):
        understood.check_worlds(load_capture(tmp_path))


def test_points_in_world_coordinates_and_cameras_without_the_offset(tmp_path):
    capture = files.Posed(origin=UTM)
    files.pix4d(capture, capture.write_images(tmp_path) / "params", UTM)
    write_las(tmp_path / "cloud.las", capture.points)
    loaded = warned("the points are in coordinates of WGS 84 / UTM zone 33N", load_capture, tmp_path)
    np.testing.assert_allclose(loaded.points + loaded.offset, capture.points - UTM, atol=1e-4)
    assert loaded.colors.tolist() == [[128] * 3] * 40
    (tmp_path / "other.laz").write_bytes(b"")
    warned("2 files of points .* call one of them points.las", load_capture, tmp_path)


def test_a_colmap_model_takes_points_and_an_offset_from_files_beside_it(tmp_path):
    write_capture(tmp_path, [f"v{i}.png" for i in range(9)])
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    write_las(tmp_path / "sparse" / "0" / "points3D.las", points)
    (tmp_path / "offset.xyz").write_text("412345.5 5654321.25 0\n")
    (tmp_path / "site.prj").write_text("EPSG:32633")
    loaded = load_capture(tmp_path)
    np.testing.assert_allclose(loaded.points + loaded.offset, points, atol=1e-4)
    assert loaded.about.frame.crs == "EPSG:32633"
    np.testing.assert_array_equal(loaded.about.frame.to_world(np.zeros(3)), [412345.5, 5654321.25, 0])
    (tmp_path / "offset.xyz").write_text("412345.5 nan 0\n")
    refused(ValueError, "translation finite", load_capture, tmp_path)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".e57"])
def test_damaged_files_are_refused_by_name(tmp_path, suffix):
    pytest.importorskip("laspy"), pytest.importorskip("pye57")
    path = tmp_path / f"p{suffix}"
    if suffix == ".e57":
        path.write_bytes(b"ASTM-E57" + bytes(40))
    else:
        write_las(path, np.ones((1000, 3)))
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 2 // 3])
    refused(ValueError, rf"p{suffix} cannot be read \([^\n]*$", file_points, path)
    shutil.rmtree(tmp_path)


@pytest.mark.parametrize(
    ("suffix", "place"),
    [(".las", "count"), (".las", "records"), (".las", "begin"), (".laz", "records"), (".laz", "chunks")],
)
def test_counts_that_a_file_cannot_hold_are_refused(tmp_path, suffix, place):
    path = tmp_path / f"p{suffix}"
    write_las(path, np.ones((1000, 3)))
    content = bytearray(path.read_bytes())
    (begin,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, begin)
    at = {"begin": 96, "records": 100, "count": 107, "chunks": table + 4}[place]
    content[at : at + 4] = b"\xff\xff\xff\x7f"
    path.write_bytes(content)
    refused(ValueError, f"p{suffix} cannot be read .its header counts", file_points, path)
