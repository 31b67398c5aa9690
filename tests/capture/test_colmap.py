# SPDX-License-Identifier: Apache-2.0
"""Models of COLMAP, and the names of image files in all layouts."""

import os
import shutil
import unicodedata

import numpy as np
import pytest

from blitzgs.capture import colmap
from blitzgs.capture.capture import MissingImagesError, load_capture
from blitzgs.capture.names import files_below, match_names
from blitzgs.formats import native
from tests.capture.helpers import (
    as_text,
    at,
    edit_model,
    frame,
    reconstruction,
    shared_data,
    smooth_image,
    warned,
    write_capture,
    write_image,
    write_ply,
    write_transforms,
)
from tests.helpers import refused

pycolmap = pytest.importorskip("pycolmap")

NAMES = ["a.jpg", "sub/b c.png", "ü.jpg"]


def assert_same(model: colmap.ColmapModel, rec: pycolmap.Reconstruction) -> None:
    assert len(model.cameras) == len(rec.cameras)
    for camera in model.cameras:
        other = rec.cameras[camera.id]
        assert (camera.model, camera.width, camera.height) == (other.model_name, other.width, other.height)
        np.testing.assert_array_equal(camera.params, other.params)
    images, points = model.images, model.points
    assert sorted(images.names) == sorted(image.name for image in rec.images.values())
    poses = colmap.world_to_camera(images)
    for i, image_id in enumerate(images.ids.tolist()):
        other = rec.images[image_id]
        assert (images.names[i], images.camera_ids[i]) == (other.name, other.camera_id)
        np.testing.assert_allclose(poses[i, :3], other.cam_from_world().matrix(), atol=1e-12)
        rows = slice(*images.point2d_offsets[i : i + 2].tolist())
        np.testing.assert_array_equal(images.points2d[rows], [p.xy for p in other.points2D])
        ids = [p.point3D_id if p.has_point3D() else -1 for p in other.points2D]
        np.testing.assert_array_equal(images.point3d_ids[rows], ids)
    assert len(points.ids) == len(rec.points3D)
    for i, point_id in enumerate(points.ids.tolist()):
        other = rec.points3D[point_id]
        np.testing.assert_array_equal(points.positions[i], other.xyz)
        np.testing.assert_array_equal(points.colors[i], other.color)
        assert points.errors[i] == other.error
        assert points.track_lengths[i] == other.track.length()
        rows = slice(*points.track_offsets[i : i + 2].tolist())
        track = [(e.image_id, e.point2D_idx) for e in other.track.elements]
        found = (points.track_image_ids[rows].tolist(), points.track_point2d_ids[rows].tolist())
        assert list(zip(*found, strict=True)) == track


def test_every_camera_model_of_colmap_is_known_with_its_parameters():
    ours = {name: (id_, params) for id_, name, params in native.camera_models()}
    for name, model_id in pycolmap.CameraModelId.__members__.items():
        if name == "INVALID":
            continue
        camera = pycolmap.Camera.create_from_model_id(1, model_id, 500.0, 640, 480)
        assert ours[name] == (int(model_id), camera.params_info.replace(" ", ""))
    assert len(ours) == len(pycolmap.CameraModelId.__members__) - 1


@pytest.mark.parametrize("model", [m for m in pycolmap.CameraModelId.__members__ if m != "INVALID"])
@pytest.mark.parametrize("text", [False, True])
def test_reads_what_colmap_writes_and_colmap_reads_what_we_write(tmp_path, model, text):
    names = [name.replace(" ", "_") if text else name for name in NAMES]  # its text reader ends at a blank
    rec = reconstruction(names, 640, 480, model=model)
    (rec.write_text if text else rec.write_binary)(str(tmp_path))
    ours = colmap.read_model(tmp_path, points2d=True, tracks=True)
    assert_same(ours, rec)

    again = tmp_path / "again"
    colmap.write_model(again, ours)
    back = pycolmap.Reconstruction()
    back.read_binary(str(again))
    assert_same(ours, back)
    assert_same(colmap.read_model(again, points2d=True, tracks=True), rec)


def test_observations_and_tracks_are_left_out_unless_asked_for(tmp_path):
    reconstruction(NAMES, 64, 48).write_binary(str(tmp_path))
    model = colmap.read_model(tmp_path)
    assert model.images.points2d.shape == (0, 2) and not model.images.point2d_offsets.any()
    assert len(model.points.track_image_ids) == 0
    lengths = model.points.track_lengths.tolist()
    assert lengths == colmap.read_model(tmp_path, tracks=True).points.track_lengths.tolist() and sum(lengths)


def test_an_empty_model_round_trips(tmp_path):
    colmap.write_model(tmp_path, colmap.ColmapModel())
    for change in (lambda _: None, as_text):
        change(tmp_path)
        model = colmap.read_model(tmp_path, points2d=True, tracks=True)
        assert model.cameras == [] and len(model.images.ids) == 0 and model.points.positions.shape == (0, 3)


def test_text_tolerates_blank_lines_carriage_returns_and_a_missing_last_line(tmp_path):
    (tmp_path / "cameras.txt").write_bytes(b"# comment\r\n\r\n1 PINHOLE 4 3 +1.5 2 2 1.5\r\n")
    (tmp_path / "images.txt").write_bytes(
        b"7 1 0 0 0 0 1e-400 1e-3 1 name with blanks.jpg\n1 2 +3\n8 1 0 0 0 0 0 0 1 b.jpg"
    )
    (tmp_path / "points3D.txt").write_bytes(b"")
    model = colmap.read_model(tmp_path, points2d=True)
    assert model.cameras[0].params.tolist() == [1.5, 2, 2, 1.5]
    assert model.images.names == ["name with blanks.jpg", "b.jpg"]
    assert model.images.translations[0].tolist() == [0, 0, 1e-3]
    assert colmap.read_model(tmp_path).images.names == model.images.names


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("cameras.bin", b"\xff" * 8, "cameras.bin: at byte 8: it claims 18446744073709551615 cameras"),
        ("cameras.bin", b"\x01" + b"\0" * 7, "but 0 bytes are left"),
        ("cameras.txt", b"1 PINHOLE 4 3 1 2 x 4", "line 1: 'x' is not a valid camera parameter"),
        ("cameras.txt", b"\n1 NOVEL 4 3 1", "line 2: camera 1 has the unknown model NOVEL"),
        ("cameras.txt", b"1 PINHOLE 4 3 1 2 3", r"needs 4 parameters \(fx,fy,cx,cy\), got 3"),
        ("images.txt", b"1 1 0 0 0 0 0 0 1", "image 1 has no name"),
        ("images.txt", b"1 1 0 0 0 0 0 0 1 a\n1 2", "line 2: the line ends before observation point id"),
        ("points3D.txt", b"1 0 0 0 256 0 0 0", "line 1: '256' is not a valid colour"),
    ],
)
def test_damage_is_named_with_file_place_and_reason(tmp_path, file, content, message):
    colmap.write_model(tmp_path, colmap.ColmapModel())
    if file.endswith(".txt"):
        as_text(tmp_path)
    (tmp_path / file).write_bytes(content)
    refused(ValueError, message, colmap.read_model, tmp_path, points2d=True, tracks=True)


def test_the_complete_model_is_read_where_files_of_another_kind_are_left(tmp_path):
    rec = reconstruction(NAMES[:1], 64, 48)
    rec.write_text(str(tmp_path))
    (tmp_path / "cameras.bin").write_bytes(b"stale")
    assert colmap.read_model(tmp_path).images.names == NAMES[:1]
    rec.write_binary(str(tmp_path))
    (tmp_path / "cameras.txt").write_bytes(b"stale")
    assert colmap.read_model(tmp_path).images.names == NAMES[:1]
    (tmp_path / "images.bin").unlink()
    (tmp_path / "points3D.txt").unlink()
    refused(FileNotFoundError, "images.bin is missing", colmap.read_model, tmp_path)


def test_what_the_files_cannot_hold_is_not_written(tmp_path):
    reconstruction(NAMES, 64, 48).write_binary(str(tmp_path))
    model = colmap.read_model(tmp_path)
    message = "columns of the model have different lengths"
    without_tracks = rf"{message}: \d+ rows of tracks or observations, got 0"
    refused(ValueError, without_tracks, colmap.write_model, tmp_path / "out", model)
    model = colmap.read_model(tmp_path, tracks=True)
    names = model.images.names
    model.images.names = names[:-1]
    refused(ValueError, message, colmap.write_model, tmp_path / "out", model)
    model.images.names = names
    model.images.names[1] = "a\nb"
    refused(ValueError, r"name .a\\nb. is empty or has a NUL", colmap.write_model, tmp_path / "out", model)
    model.cameras[0].params = model.cameras[0].params[:-1]
    refused(ValueError, "camera 1: 3 parameters do not fit PIN", colmap.write_model, tmp_path / "out", model)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", [" a.jpg", "a.jpg ", "\ta.jpg", "a.jpg\r", "\va.jpg", "a.jpg\f", " "])
def test_blanks_of_names_are_kept(tmp_path, name):
    reconstruction(NAMES, 64, 48).write_binary(str(tmp_path))
    model = colmap.read_model(tmp_path, tracks=True)
    model.images.names[0] = name
    colmap.write_model(tmp_path / "binary", model)
    assert colmap.read_model(tmp_path / "binary").images.names == model.images.names


@pytest.mark.skipif(shared_data() is None, reason="the real captures are not here")
@pytest.mark.parametrize("name", ["sheffield", "caliterra"])
def test_a_real_model_is_written_back_byte_for_byte(tmp_path, name):
    folder = colmap.find_models(shared_data() / name)[0][0]
    colmap.write_model(tmp_path, colmap.read_model(folder, points2d=True, tracks=True))
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / file).read_bytes() == (folder / file).read_bytes()


E_ACUTE, DECOMPOSED = "\xe9.jpg", unicodedata.normalize("NFD", "\xe9.jpg")
# Names that are wanted, names that were found, further files on disk, and what each wanted name becomes.
NOTATIONS = [
    ({"images\\a.jpg": "images/a.jpg"}, [], []),
    ({"./images//a.jpg": "images/a.jpg"}, [], []),
    ({"A.JPG": "a.jpg", "B.JPG": "b.jpg"}, [], []),
    ({"a.JPG": "a.jpg"}, ["b.jpg"], []),
    ({E_ACUTE: DECOMPOSED}, [], []),
    ({DECOMPOSED: E_ACUTE}, [], []),
    ({"a.jpg": "a.png", "b.jpg": "b.png"}, [], []),
    ({"a.tif": "a.JPEG"}, [], []),
    ({"a.HEIC": "a.jpg", "b.ARW": "b.jpg"}, [], ["b.dng"]),
    ({"day/a.jpg": "a.jpg"}, [], []),
    ({"a.jpg": "day/a.jpg"}, [], []),
    ({"day/a.jpg": "day_a.jpg", "night/a.jpg": "night_a.jpg"}, [], []),
    ({"day\\A.JPG": "a.jpeg"}, [], []),
    # Not resolved: another photograph may be meant.
    ({"a.jpg": None}, [], ["a.png", "a.tif"]),
    ({"A.jpg": None}, [], ["a.jpg", "a.JPG"]),
    ({"day/a.jpg": None, "night/a.jpg": None}, [], ["a.jpg"]),
    ({"day/a.jpg": None}, ["day/b.jpg"], ["night/a.jpg"]),
    ({"a.jpg": None}, ["b.jpg"], ["a.png"]),
    ({"a.jpg": None}, ["a.png"], []),
    ({"a.jpg": None}, [], ["b.jpg"]),
    ({"images/a.png": None}, [], ["masks/a.png"]),
    ({"images/a.png": None}, [], ["depths/a.png"]),
]


@pytest.mark.filterwarnings("ignore:.*have other names")
@pytest.mark.parametrize(("names", "found", "others"), NOTATIONS)
def test_a_name_is_resolved_if_exactly_one_file_fits(tmp_path, names, found, others):
    for file in {*names.values(), *found, *others} - {None}:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    matches = match_names(names, found, tmp_path)
    assert matches == {name: tmp_path / file for name, file in names.items() if file is not None}


def test_what_was_resolved_is_said_once(tmp_path):
    root = write_capture(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
    for name in ("a", "b"):
        (root / "images" / f"{name}.jpg").rename(root / "images" / f"{name}.JPG")
    with pytest.warns(
        UserWarning, match=r"2 of 3 files have other names .*a.JPG is used for a.jpg.*case"
    ) as said:
        capture = load_capture(root)
    assert [camera.image_path.name for camera in capture.cameras] == ["a.JPG", "b.JPG", "c.jpg"]
    assert len(said) == 1


def test_two_names_are_never_one_file(tmp_path):
    root = write_capture(tmp_path, ["day/a.jpg", "night/a.jpg"])
    for folder in ("day", "night"):
        (root / "images" / folder / "a.jpg").unlink()
    write_image(root / "a.jpg", smooth_image(48, 64))
    refused(ValueError, "day/a.jpg and night/a.jpg would be the same file", load_capture, root)


@pytest.mark.filterwarnings("ignore:.*have other names")
def test_transforms_that_were_written_on_windows(tmp_path):
    frames = []
    for i in range(3):
        write_image(tmp_path / "images" / f"{i}.png", smooth_image(48, 64, i))
        write_image(tmp_path / "masks" / f"{i}.png", np.full((48, 64, 3), 255, dtype=np.uint8))
        frames.append(frame(f".\\images\\{i}.png", at(i, 0, 0), mask_path=f"masks\\{i}.png"))
    write_ply(tmp_path / "cloud" / "p.ply", [[0.5, 0, -3]])
    named = {"ply_file_path": "cloud\\p.ply", "test_filenames": [".\\images\\1.png"]}
    write_transforms(tmp_path, frames, w=64, h=48, fl_x=60.0, **named)
    capture = load_capture(tmp_path)
    assert [camera.name for camera in capture.cameras] == [f"images/{i}.png" for i in range(3)]
    masks = [camera.mask_path for camera in capture.cameras]
    assert masks == [tmp_path / "masks" / f"{i}.png" for i in range(3)]
    assert capture.test == [1] and len(capture.points) == 1


def test_files_are_found_once_and_none_that_is_hidden(tmp_path):
    others = ("@eaDir/a.jpg/SYNOFILE_THUMB_M.jpg", "day/@eaDir/b.jpg", "$RECYCLE.BIN/d.jpg", "#recycle/e.jpg")
    for file in ("a.jpg", "._a.jpg", "day/b.jpg", ".cache/c.jpg", *others):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    (tmp_path / "day/up").symlink_to(tmp_path)
    (tmp_path / "night").symlink_to("day")
    assert files_below(tmp_path) == ["a.jpg", "day/b.jpg", "night/b.jpg"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path.symlink_to("lost.jpg"), "is a link to lost.jpg: No such file or directory"),
        (lambda path: path.symlink_to(path.name), "is a link to a.jpg: Too many levels of symbolic links"),
        (lambda path: path.mkdir(), "is a folder"),
        (os.mkfifo, "is a named pipe"),
        (lambda path: path.symlink_to("/dev/null"), "is a device"),
    ],
)
def test_what_is_no_file_is_called_what_it_is(tmp_path, make, message):
    root = write_capture(tmp_path, ["a.jpg", "b.jpg"])
    (root / "images" / "a.jpg").unlink()
    make(root / "images" / "a.jpg")
    with pytest.raises(MissingImagesError, match=f"images/a.jpg {message}; *put|images/a.jpg {message}: put"):
        load_capture(root)
    with pytest.warns(UserWarning, match=message):
        assert len(load_capture(root, allow_missing=True).cameras) == 1


def test_a_file_in_the_place_of_the_image_folder_is_named(tmp_path):
    root = write_capture(tmp_path, ["a.jpg"])
    (root / "images" / "a.jpg").unlink()
    (root / "images").rmdir()
    (root / "images").write_text("")
    refused(FileNotFoundError, "images is a file, no folder", load_capture, root)


@pytest.mark.parametrize("way", ["..", "absolute", "mask", "link"])
def test_names_that_lead_outside_the_capture(tmp_path, way):
    root = write_capture(tmp_path / "capture", ["a.png", "b.png"])
    outside = tmp_path / "secret.png"
    write_image(outside, smooth_image(48, 64))
    if way == "link":
        (root / "images" / "a.png").unlink()
        (root / "images" / "a.png").symlink_to(outside)
    elif way == "mask":
        facing = at(0, 0, -9) @ np.diag([-1.0, 1, -1, 1])
        frames = [frame("images/a.png", mask_path="../secret.png"), frame("images/b.png", facing)]
        write_transforms(root, frames, w=64, h=48, fl_x=60.0)
        shutil.rmtree(root / "sparse")
    else:

        def rename(model):
            model.images.names[0] = "../../secret.png" if way == ".." else str(outside)

        edit_model(root, rename)
    refused(ValueError, "leads outside it, to .*data.inside_only", load_capture, root, inside_only=True)
    if way != "link":  # which people use to have one copy of their photographs
        warned("1 names of the capture lead outside .*secret.png.*inside_only", load_capture, root)


def test_folders_that_the_caller_names_may_be_anywhere(tmp_path, recwarn):
    root = write_capture(tmp_path / "capture", [f"{i}.png" for i in range(4)])
    (root / "images").rename(tmp_path / "photographs")
    assert len(load_capture(root, images="../photographs", inside_only=True).cameras) == 4
    assert not [str(warning.message) for warning in recwarn.list]
