# SPDX-License-Identifier: Apache-2.0
"""Splits by rule and by a capture's own files, and photographs that have no camera."""

import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest

from blitzgs.capture import colmap
from blitzgs.capture.cameras import SourceView
from blitzgs.capture.capture import load_capture
from blitzgs.capture.splits import split_views
from tests.capture.helpers import (
    frame,
    reconstruction,
    smooth_image,
    warned,
    write_capture,
    write_image,
    write_transforms,
)
from tests.helpers import look_at_origin, refused

NAMES = ["a/1.jpg", "a/2.jpg", "b/1.jpg", "b/3.jpg"]
ROOT = Path("/capture")


def split(root, spec="auto", names=NAMES, paths=None):
    """Train and test views of these names, whose images are in /capture/images or have these paths."""
    paths = paths or [ROOT / "images" / name for name in names]
    views = [SourceView(name, path, None, None, None) for name, path in zip(names, paths, strict=True)]
    return split_views(views, root, spec)[:2]


@pytest.mark.parametrize(("spec", "test"), [(2, [0, 2]), ("3", [0, 3]), (0, []), ("auto", [0])])
def test_every_nth_view_is_held_out(spec, test):
    train, found = split(ROOT, spec)
    assert found == test and sorted(train + found) == [0, 1, 2, 3]


def test_list_file_matches_names_file_names_and_stems(tmp_path):
    # A byte order mark, as of editors on Windows, is no part of the first line.
    (tmp_path / "test.txt").write_bytes(b"\xef\xbb\xbfa\\1.jpg\r\n# held out\n\n2.JPG  # by file name\n3\n")
    assert split(tmp_path, "test.txt") == ([2], [0, 1, 3])
    assert split(ROOT, tmp_path / "test.txt") == ([2], [0, 1, 3])


@pytest.mark.parametrize("name", ["\udcfc.jpg", "\u00fc.jpg"])
def test_a_list_file_may_have_names_that_are_not_utf_8(tmp_path, name):
    """The file may be called so, or the list may be in the letters of Windows."""
    (tmp_path / "test.txt").write_bytes(b"\xfc.jpg\n")
    assert split(tmp_path, "test.txt", ["1.jpg", name]) == ([0], [1])


def test_a_name_without_parts_is_split_like_any_other(tmp_path):
    assert split(tmp_path, names=[".", "1.jpg"]) == ([1], [0])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1.jpg", "line 1: '1.jpg' names 2 views"),
        ("9", "names no view of the capture"),
        ("# 9", "test.txt names no view: list the held-out ones, .* --data.split=0"),
    ],
)
def test_list_entries_must_name_one_view(tmp_path, line, message):
    (tmp_path / "test.txt").write_text(line)
    refused(ValueError, message, split, tmp_path, "test.txt")


def test_val_folder_is_used_when_it_is_there():
    paths = [ROOT / ("val" if i == 2 else "train") / "rgbs" / f"{i}.jpg" for i in range(4)]
    assert split(ROOT, paths=paths) == ([0, 1, 3], [2])
    assert split(ROOT, "val", paths=paths) == ([0, 1, 3], [2])
    refused(ValueError, "no view's image is in /capture/val", split, ROOT, "val")


def test_invalid_splits_are_refused(tmp_path):
    for number in (1, "-1"):
        message = f"data.split: must be 0 .no view is held out. or at least 2, got {number}"
        refused(ValueError, message, split, ROOT, number)
    refused(ValueError, "must be a whole number n .*, 'auto', 'val' or a file", split, ROOT, "missing.txt")
    (tmp_path / "all.txt").write_text("\n".join(NAMES))
    refused(ValueError, "leaves no training view of 4", split, tmp_path, "all.txt")


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*the capture has no points"),
    pytest.mark.filterwarnings("ignore:.* see none of the points"),
    pytest.mark.filterwarnings("ignore:.*photographs have no camera"),
]
FRAMES = [f"images/f{i}.png" for i in range(6)]


def frames(names=FRAMES):
    angles = 2 * np.pi * np.arange(len(names)) / 6
    places = np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.full(len(names), 0.5)], axis=1)
    poses = [np.linalg.inv(look_at_origin(place)) @ np.diag([1.0, -1, -1, 1]) for place in places]
    return [frame(name, pose) for name, pose in zip(names, poses, strict=True)]


def write_images(root):
    for seed, name in enumerate(FRAMES):
        write_image(root / name, smooth_image(32, 48, seed))


def write(root, file="transforms.json", names=FRAMES, **fields):
    write_transforms(root, frames(names), file, fl_x=40.0, **fields)


def split_of(root, **options):
    capture = load_capture(root, **options)
    train, test = ([capture.cameras[i].name for i in part] for part in (capture.train, capture.test))
    return train, test, capture


LISTS = [list(c) for c in itertools.product([None, [0, 1]], [None, [2], []], [None, [3], [2]])]


@pytest.mark.parametrize(("train", "val", "test"), LISTS)
def test_lists_are_followed_exactly(tmp_path, train, val, test):
    write_images(tmp_path)
    given = {"train_filenames": train, "val_filenames": val, "test_filenames": test}
    # A name may begin with "./", as programs write it.
    lists = {
        key: [("./" if i % 2 else "") + FRAMES[i] for i in part]
        for key, part in given.items()
        if part is not None
    }
    write(tmp_path, **lists)
    # The formula: held out is what val or test name; trained on is what train names, or without it the rest.
    held_out = sorted({FRAMES[i] for part in (val, test) if part for i in part})
    if not lists:
        trained, held_out = FRAMES[1:], FRAMES[:1]  # every 8th
    elif train is None:
        trained = [name for name in FRAMES if name not in held_out]
    else:
        trained = [FRAMES[i] for i in train]
    got_train, got_test, capture = split_of(tmp_path)
    assert (got_train, got_test) == (trained, held_out)
    assert capture.about.unused == (0 if train is None else len(FRAMES) - len({*trained, *held_out}))
    assert len(capture.cameras) == len(FRAMES) - capture.about.unused
    own = capture.about.split == "the capture's own split"
    assert own == bool(lists) and all(key in capture.about.split_from for key in lists)
    # A split that is asked for uses all frames.
    assert len(split_of(tmp_path, split=3)[2].cameras) == len(FRAMES)


@pytest.mark.parametrize("part", ["train", "val", "test"])
def test_a_list_must_name_frames(tmp_path, part):
    write_images(tmp_path)
    write(tmp_path, **{f"{part}_filenames": [FRAMES[0], "images/gone.png"]})
    with pytest.raises(ValueError, match=f"{part}_filenames name 1 images that are no frames .*gone.png"):
        load_capture(tmp_path)
    for wrong in ("a.png", None, [3]):
        write(tmp_path, **{f"{part}_filenames": wrong})
        refused(ValueError, f"{part}_filenames must be a list", load_capture, tmp_path)


def test_a_view_cannot_be_trained_on_and_held_out(tmp_path):
    write_images(tmp_path)
    write(tmp_path, train_filenames=FRAMES[:3], test_filenames=FRAMES[2:4])
    refused(ValueError, r"1 views are in train_filenames and also .*images/f2.png", load_capture, tmp_path)
    assert len(split_of(tmp_path, split=0)[0]) == len(FRAMES)
    write(tmp_path, train_filenames=[])
    with pytest.raises(ValueError):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    "parts", [c for n in (1, 2, 3) for c in itertools.combinations(["train", "val", "test"], n)]
)
def test_the_files_of_blenders_split_are_all_read(tmp_path, parts):
    write_images(tmp_path)
    names = {"train": FRAMES[:3], "val": FRAMES[3:4], "test": FRAMES[4:]}
    for part in parts:
        write(tmp_path, f"transforms_{part}.json", names[part])
    if "train" not in parts:
        refused(ValueError, "the capture's own split leaves no training view of", load_capture, tmp_path)
        return
    train, test, capture = split_of(tmp_path)
    assert train == names["train"]
    assert test == [name for part in ("val", "test") if part in parts for name in names[part]]
    assert capture.about.split_from == " and ".join(f"transforms_{part}.json" for part in parts)


def test_what_is_beside_transforms_json_is_named(tmp_path):
    write_images(tmp_path)
    write(tmp_path)
    write(tmp_path, "transforms_val.json", FRAMES[:1])
    warned("transforms.json is read, and transforms_val.json beside it not", load_capture, tmp_path)


def models(root, counts, text=False):
    names = [f"{i:02d}.png" for i in range(max(counts))]
    for seed, name in enumerate(names):
        write_image(root / "images" / name, smooth_image(48, 64, seed))
    for number, count in enumerate(counts):
        folder = root / "sparse" / str(number)
        folder.mkdir(parents=True)
        model = reconstruction(names[:count], 64, 48, around=len(names))
        getattr(model, "write_text" if text else "write_binary")(str(folder))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("counts", [(2, 9), (9, 2), (3, 3), (1, 4, 9), (1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 5)])
def test_the_largest_of_several_models_is_read(tmp_path, counts, text):
    models(tmp_path, counts, text)
    best = counts.index(max(counts))
    message = f"of {len(counts)} COLMAP models, the largest is used: sparse/{best} "
    capture = warned(message, load_capture, tmp_path)
    assert len(capture.cameras) == max(counts) and capture.about.cameras == f"sparse/{best}"
    other = len(counts) - 1
    named = load_capture(tmp_path, sparse=f"sparse/{other}")
    assert len(named.cameras) == counts[other]
    assert named.about.without_camera == max(counts) - counts[other]
    everything = load_capture(tmp_path, sparse="all")
    assert len(everything.cameras) == max(counts) and len(everything.points) == 20 * len(counts)
    with pytest.raises(FileNotFoundError, match="data.sparse: .*sparse/77 has no complete COLMAP model"):
        load_capture(tmp_path, sparse="sparse/77")


def test_models_of_different_worlds_are_not_joined(tmp_path):
    models(tmp_path, (4, 9))
    assert len(load_capture(tmp_path, sparse="all").cameras) == 9
    model = colmap.read_model(tmp_path / "sparse/0", points2d=True, tracks=True)
    model.images.quats = np.roll(model.images.quats, 1, axis=1)
    colmap.write_model(tmp_path / "sparse/0", model)
    message = "data.sparse: 00.png is in two COLMAP models and looks elsewhere in the second"
    refused(ValueError, message, load_capture, tmp_path, sparse="all")
    assert len(load_capture(tmp_path, sparse="sparse/0").cameras) == 4


def test_the_files_of_a_model_that_are_not_read_are_named(tmp_path):
    models(tmp_path, (4,))
    assert load_capture(tmp_path).about.notes == ()
    reconstruction(["00.png"], 64, 48).write_text(str(tmp_path / "sparse/0"))
    capture = load_capture(tmp_path)
    assert len(capture.cameras) == 4
    assert capture.about.notes == ("sparse/0/images.bin is read, and images.txt beside it not",)
    (tmp_path / "sparse/0/cameras.bin").unlink()
    notes = load_capture(tmp_path, sparse="sparse/0").about.notes
    assert notes == ("sparse/0/images.txt is read, and images.bin beside it not",)


def test_a_damaged_model_is_not_the_largest(tmp_path):
    models(tmp_path, (4, 9))
    (tmp_path / "sparse" / "1" / "images.bin").write_bytes(b"\xff" * 40)
    assert len(load_capture(tmp_path).cameras) == 4


def test_a_single_model_of_another_number_is_read(tmp_path):
    write_capture(tmp_path, ["0.png", "1.png", "2.png"])
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "1")
    assert load_capture(tmp_path).about.cameras == "sparse/1"


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_photographs_without_a_camera_are_counted(tmp_path, form):
    if form == "colmap":
        write_capture(tmp_path, [f"{i}.png" for i in range(4)])
    else:
        write_images(tmp_path)
        write(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*no points|.*see none")
        assert load_capture(tmp_path).about.without_camera == 0
    for extra in ("x.png", "y.PNG", "notes.txt", "z_depth_0001.png", "z_mask.png"):
        if not extra.endswith("txt"):
            write_image(tmp_path / "images" / "w.png", smooth_image(48, 64))
            (tmp_path / "images" / "w.png").rename(tmp_path / "images" / extra)
        else:
            (tmp_path / "images" / extra).write_text("")
    count = 4 if form == "colmap" else len(FRAMES)
    with pytest.warns(UserWarning, match=f"2 of {count + 2} photographs have no camera in .* not used"):
        assert load_capture(tmp_path).about.without_camera == 2
