# SPDX-License-Identifier: Apache-2.0
"""Names in another notation, what is in the place of a file, and names that lead outside the capture."""

import json
import os
import unicodedata

import numpy as np
import pytest

from blitzgs.capture.capture import MissingImagesError, load_capture
from blitzgs.capture.names import match_names, unified
from tests.capture.helpers import edit_model, smooth_image, write_capture, write_image

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
    with pytest.raises(ValueError, match="day/a.jpg and night/a.jpg would be the same file"):
        load_capture(root)


@pytest.mark.filterwarnings("ignore:.*have other names")
def test_transforms_that_were_written_on_windows(tmp_path):
    frames = []
    for i in range(3):
        write_image(tmp_path / "images" / f"{i}.png", smooth_image(48, 64, i))
        write_image(tmp_path / "masks" / f"{i}.png", np.full((48, 64, 3), 255, dtype=np.uint8))
        pose = np.eye(4)
        pose[0, 3] = i
        frame = {"file_path": f".\\images\\{i}.png", "mask_path": f"masks\\{i}.png"}
        frames.append(frame | {"transform_matrix": pose.tolist()})
    (tmp_path / "cloud").mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {a}\n" for a in "xyz")
    (tmp_path / "cloud" / "p.ply").write_text(header + "end_header\n0.5 0 -3\n")
    content = {"w": 64, "h": 48, "fl_x": 60.0, "ply_file_path": "cloud\\p.ply", "frames": frames}
    content["test_filenames"] = [".\\images\\1.png"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert [camera.name for camera in capture.cameras] == [f"images/{i}.png" for i in range(3)]
    assert [camera.mask_path for camera in capture.cameras] == [
        tmp_path / "masks" / f"{i}.png" for i in range(3)
    ]
    assert capture.test == [1] and len(capture.points) == 1


def fifo(path):
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path.symlink_to("lost.jpg"), "is a link to lost.jpg, which does not exist"),
        (lambda path: path.symlink_to(path.name), "is a link to a.jpg: Too many levels of symbolic links"),
        (lambda path: path.mkdir(), "is a folder"),
        (fifo, "is a named pipe"),
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
    with pytest.raises(MissingImagesError, match="images is a file, no folder"):
        load_capture(root)


@pytest.mark.parametrize("way", ["..", "absolute", "mask", "link"])
def test_names_that_lead_outside_the_capture(tmp_path, way):
    root = write_capture(tmp_path / "capture", ["a.png", "b.png"])
    outside = tmp_path / "secret.png"
    write_image(outside, smooth_image(48, 64))
    if way == "link":
        (root / "images" / "a.png").unlink()
        (root / "images" / "a.png").symlink_to(outside)
    elif way == "mask":
        frame = {
            "transform_matrix": np.eye(4).tolist(),
            "file_path": "images/a.png",
            "mask_path": "../secret.png",
        }
        other = {"file_path": "images/b.png", "transform_matrix": np.diag([-1.0, 1, -1, 1]).tolist()}
        other["transform_matrix"][2][3] = -9.0
        content = {"w": 64, "h": 48, "fl_x": 60.0, "frames": [frame, other]}
        (root / "transforms.json").write_text(json.dumps(content))
        for path in (root / "sparse" / "0").iterdir():
            path.unlink()
    else:

        def rename(model):
            model.images.names[0] = "../../secret.png" if way == ".." else str(outside)

        edit_model(root, rename)
    with pytest.raises(ValueError, match="leads outside it, to .*data.inside_only"):
        load_capture(root, inside_only=True)
    if way != "link":  # which people use to have one copy of their photographs
        with pytest.warns(UserWarning, match="1 names of the capture lead outside .*secret.png.*inside_only"):
            load_capture(root)


def test_folders_that_the_caller_names_may_be_anywhere(tmp_path, recwarn):
    root = write_capture(tmp_path / "capture", [f"{i}.png" for i in range(4)])
    (root / "images").rename(tmp_path / "photographs")
    assert len(load_capture(root, images="../photographs", inside_only=True).cameras) == 4
    assert not [str(warning.message) for warning in recwarn.list]


def test_unified_names():
    assert unified(".\\a\\b.jpg") == unified("a/./b.jpg") == "a/b.jpg"
