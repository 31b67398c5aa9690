# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from blitzgs.capture.splits import split_views

NAMES = ["a/1.jpg", "a/2.jpg", "b/1.jpg", "b/3.jpg"]
ROOT = Path("/capture")
PATHS = [ROOT / "images" / name for name in NAMES]


@pytest.mark.parametrize(("spec", "test"), [(2, [0, 2]), ("3", [0, 3]), (0, []), ("auto", [0])])
def test_every_nth_view_is_held_out(spec, test):
    train, found = split_views(NAMES, PATHS, ROOT, spec)
    assert found == test and sorted(train + found) == [0, 1, 2, 3]


def test_list_file_matches_names_file_names_and_stems(tmp_path):
    (tmp_path / "test.txt").write_text("# held out\n\na/1.jpg\n2.jpg  # by file name\n3\n")
    assert split_views(NAMES, PATHS, tmp_path, "test.txt") == ([2], [0, 1, 3])
    assert split_views(NAMES, PATHS, ROOT, tmp_path / "test.txt") == ([2], [0, 1, 3])


def test_a_list_file_may_have_names_that_are_not_utf_8(tmp_path):
    (tmp_path / "test.txt").write_bytes(b"\xfc.jpg\n")
    names = ["1.jpg", "\udcfc.jpg"]
    assert split_views(names, [tmp_path / name for name in names], tmp_path, "test.txt") == ([0], [1])


def test_a_name_without_parts_is_split_like_any_other(tmp_path):
    assert split_views([".", "1.jpg"], [tmp_path, tmp_path / "1.jpg"], tmp_path) == ([1], [0])


@pytest.mark.parametrize(
    ("line", "message"), [("1.jpg", "line 1: '1.jpg' names 2 views"), ("9", "names no view of the capture")]
)
def test_list_entries_must_name_one_view(tmp_path, line, message):
    (tmp_path / "test.txt").write_text(line)
    with pytest.raises(ValueError, match=message):
        split_views(NAMES, PATHS, tmp_path, "test.txt")


def test_val_folder_is_used_when_it_is_there():
    paths = [ROOT / ("val" if i == 2 else "train") / "rgbs" / f"{i}.jpg" for i in range(4)]
    assert split_views(NAMES, paths, ROOT, "auto") == ([0, 1, 3], [2])
    assert split_views(NAMES, paths, ROOT, "val") == ([0, 1, 3], [2])
    with pytest.raises(ValueError, match="no view's image is in /capture/val"):
        split_views(NAMES, PATHS, ROOT, "val")


def test_invalid_splits_are_refused(tmp_path):
    for number in (1, "-1"):
        message = f"data.split: must be 0 .no view is held out. or at least 2, got {number}"
        with pytest.raises(ValueError, match=message):
            split_views(NAMES, PATHS, ROOT, number)
    with pytest.raises(ValueError, match=r"must be a whole number n .*, 'auto', 'val' or a file"):
        split_views(NAMES, PATHS, ROOT, "missing.txt")
    (tmp_path / "all.txt").write_text("\n".join(NAMES))
    with pytest.raises(ValueError, match="leaves no training view of 4"):
        split_views(NAMES, PATHS, tmp_path, "all.txt")
