# SPDX-License-Identifier: Apache-2.0
"""Points of LAS, LAZ and E57 files, in the coordinates of the cameras whatever their own are."""

import shutil
import warnings

import numpy as np
import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.capture.layouts import read_layout
from blitzgs.capture.points import file_points
from tests.capture import helpers as files
from tests.capture.helpers import write_capture

UTM = np.array([412_345.0, 5_654_321.0, 120.0])


@pytest.fixture(autouse=True)
def _quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


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


def test_points_of_another_reference_system_are_moved_to_the_cameras(tmp_path):
    """Metashape's cameras are in a chunk's coordinates, its points in UTM."""
    pyproj = pytest.importorskip("pyproj")
    place = np.array(pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978").transform(47.5, 8.25, 432.0))
    capture = files.Posed(origin=place)
    chunk, scale, shift = files.metashape(capture, capture.write_images(tmp_path) / "cameras.xml")
    utm = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS("EPSG:32632").to_3d()).transform(
        *capture.points.T
    )
    write_las(tmp_path / "cloud.las", np.stack(utm, axis=1), capture.colors, pyproj.CRS("EPSG:32632"))
    _, points, _ = read_layout(tmp_path, "images", 1)
    local = (capture.points - shift) @ chunk / scale
    np.testing.assert_allclose(points.positions, local, atol=2e-4)


def test_points_in_world_coordinates_and_cameras_without_the_offset(tmp_path):
    capture = files.Posed(origin=UTM)
    files.pix4d(capture, capture.write_images(tmp_path) / "params", UTM)
    write_las(tmp_path / "cloud.las", capture.points)
    with pytest.warns(UserWarning, match="the points are in coordinates of WGS 84 / UTM zone 33N"):
        loaded = load_capture(tmp_path)
    np.testing.assert_allclose(loaded.points + loaded.offset, capture.points - UTM, atol=1e-4)
    assert loaded.colors.tolist() == [[128] * 3] * 40
    (tmp_path / "other.laz").write_bytes(b"")
    with pytest.warns(UserWarning, match="2 files of points .* call one of them points.las"):
        load_capture(tmp_path)


def test_a_colmap_model_takes_points_and_an_offset_from_files_beside_it(tmp_path):
    write_capture(tmp_path, [f"v{i}.png" for i in range(9)])
    (tmp_path / "sparse" / "0" / "points3D.bin").unlink()
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    write_las(tmp_path / "sparse" / "0" / "points3D.las", points)
    (tmp_path / "offset.xyz").write_text("412345.5 5654321.25 0\n")
    (tmp_path / "site.prj").write_text("EPSG:32633")
    loaded = load_capture(tmp_path)
    np.testing.assert_allclose(loaded.points + loaded.offset, points, atol=1e-4)
    assert loaded.about.source.frame.crs == "EPSG:32633"
    np.testing.assert_array_equal(loaded.about.source.frame.to_world(np.zeros(3)), [412345.5, 5654321.25, 0])
    (tmp_path / "offset.xyz").write_text("412345.5 nan 0\n")
    with pytest.raises(ValueError, match="translation finite"):
        load_capture(tmp_path)


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
    with pytest.raises(ValueError, match=rf"p{suffix} cannot be read"):
        file_points(path)
    shutil.rmtree(tmp_path)
