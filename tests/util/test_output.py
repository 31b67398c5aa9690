# SPDX-License-Identifier: Apache-2.0
"""Files and terminals: names, progress, laps and charts; memory."""

import os
import time
from pathlib import Path
from xml.etree import ElementTree

import psutil
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from blitzgs.util import memory, progress
from blitzgs.util.charts import line_chart
from blitzgs.util.errors import amount, printable
from blitzgs.util.output import OutputFolder, new_file, write_file
from blitzgs.util.progress import Laps, image_progress
from tests.helpers import refused

PARTS = st.sampled_from(
    ["..", ".", "a", "A", "a.png", "a.jpg", "a.png.jpg", "b", "ä🏙", "x" * 300, "\udcff.png", ""]
)
NAMES = st.lists(
    st.tuples(st.sampled_from(["", "/", "//", "../", "/etc/"]), st.lists(PARTS, max_size=4)).map(
        lambda name: name[0] + "/".join(name[1])
    ),
    max_size=8,
)


@settings(max_examples=300, deadline=None)
@given(NAMES, st.booleans())
@example(["a.jpg", "a.png", "A.png", "a_2.png"], False)
@example(["a/b.jpg", "a_b.jpg", "a_b"], True)
@example(["a.png.jpg", "a.png/b.jpg", "a.png/c.jpg"], False)
def test_paths_stay_inside_and_apart(names, flat):
    root = Path("/nowhere/out")
    paths = OutputFolder(root).paths(names, ".png", flat)
    assert len({str(path).casefold() for path in paths}) == len(names)
    folders = {parent for path in paths for parent in path.parents}
    for path in paths:
        assert os.path.normpath(path) == str(path) and root in path.parents and path not in folders
        assert all(len(os.fsencode(part)) <= 255 for part in path.parts)
        assert path.suffix == ".png" and (not flat or path.parent == root)


def test_names_without_surprises_keep_their_shape(tmp_path):
    found = OutputFolder(tmp_path).paths(["a/b.jpg", "c.v2.jpg", "d.jpg", "d.png"], ".png")
    assert [str(path.relative_to(tmp_path)) for path in found] == [
        "a/b.png", "c.v2.png", "d.jpg.png", "d.png.png",
    ]  # fmt: skip
    found = OutputFolder(tmp_path).paths(["a/b.jpg", "c.v2.jpg", "d.jpg", "d.png"], ".jpg", flat=True)
    assert [path.name for path in found] == ["a_b.jpg", "c.v2.jpg", "d.jpg.jpg", "d.png.jpg"]


def test_absolute_names_lose_the_folders_that_they_share(tmp_path):
    found = OutputFolder(tmp_path).paths(["/data/city/x/1.jpg", "/data/city/y/1.jpg", "../z/1.jpg"], ".png")
    assert [str(path.relative_to(tmp_path)) for path in found] == ["x/1.png", "y/1.png", "z/1.png"]


def test_inputs_are_never_overwritten(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.png").write_bytes(b"photograph")
    (tmp_path / "out").mkdir()
    inputs = [photos / "a.png"]
    refused(OSError, "among .*photos/a.png", OutputFolder(photos, inputs).paths, ["b.png"], ".png")
    (tmp_path / "alias").symlink_to(photos)
    refused(OSError, "among the inputs", OutputFolder(tmp_path / "alias", inputs).paths, ["a.png"], ".png")
    (tmp_path / "out" / "sub").symlink_to(photos)
    with pytest.raises(OSError, match="out/sub leads out of .*remove that link"):
        OutputFolder(tmp_path / "out", inputs).paths(["sub/a.png"], ".png")
    os.link(photos / "a.png", tmp_path / "out" / "a.png")
    with pytest.raises(OSError, match="would overwrite the input .*photos/a.png"):
        OutputFolder(tmp_path / "out", inputs).paths(["a.png"], ".png")
    assert (photos / "a.png").read_bytes() == b"photograph"


def test_files_of_others_are_kept_and_own_files_are_replaced(tmp_path):
    (tmp_path / "a.png").write_bytes(b"a copy of a photograph")
    with pytest.raises(FileExistsError, match="a.png exists, and no earlier call .* choose another --out"):
        OutputFolder(tmp_path).paths(["a.jpg", "b.jpg"], ".png")
    refused(FileExistsError, "a.png exists", OutputFolder(tmp_path).write, tmp_path / "a.png", b"render")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    for content in (b"render", b"render again"):
        output = OutputFolder(tmp_path / "out")
        (path,) = output.paths(["a.jpg"], ".png")
        output.write(path, content)
        assert path.read_bytes() == content


def test_a_link_that_appears_later_is_not_followed(tmp_path):
    (tmp_path / "other").mkdir()
    output = OutputFolder(tmp_path / "out")
    (path,) = output.paths(["sub/a.png"], ".png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "sub").symlink_to(tmp_path / "other")
    refused(OSError, "leads out of", output.write, path, b"x")
    assert not list((tmp_path / "other").iterdir())


@pytest.mark.parametrize("kind", ["link", "dangling link", "folder", "pipe", "device"])
def test_only_regular_files_are_replaced(tmp_path, kind):
    path = Path("/dev/null") if kind == "device" else tmp_path / "file"
    if kind == "link":
        (tmp_path / "target").write_text("old")
    if kind.endswith("link"):
        path.symlink_to(tmp_path / "target")
    elif kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    before = path.lstat()
    remedy = "name a file in it" if kind == "folder" else "remove it or choose another name"
    refused(OSError, f"which is not overwritten: {remedy}", write_file, path, b"new")
    assert path.lstat().st_ino == before.st_ino and path.lstat().st_mode == before.st_mode


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    write_file(tmp_path / "file", "old")
    with pytest.raises(RuntimeError), new_file(tmp_path / "file") as partial:
        partial.write_text("half")
        raise RuntimeError
    assert (tmp_path / "file").read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    write_file(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new" and len(list(tmp_path.iterdir())) == 1


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "missing" / "figures.json"
    with pytest.raises(FileNotFoundError) as caught:
        write_file(path, "{}")
    assert caught.value.filename == str(path)


def test_a_full_disk_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "figures.json"
    with pytest.raises(OSError, match="No space left") as caught, new_file(path) as partial:
        partial.unlink()
        partial.symlink_to("/dev/full")
        partial.write_bytes(b"x")
    assert caught.value.filename == str(path) and not list(tmp_path.iterdir())


NAMESPACE = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(
    ("points", "most", "columns", "rows"),
    [
        ([(0, 1547), (750, 10411)], None, "0 200 400 600", "0 2.5k 5k 7.5k 10k 12.5k"),
        ([(0, 3), (30_000, 1e6)], None, "0 10k 20k 30k", "0 200k 400k 600k 800k 1M"),
        ([(5, 0.5)], 1.0, "0 1 2 3 4 5", "0 0.2 0.4 0.6 0.8 1"),
        ([(0, 0)], None, "0 0.2 0.4 0.6 0.8 1", "0 0.2 0.4 0.6 0.8 1"),
    ],
)
def test_axes_have_round_numbers(points, most, columns, rows):
    chart = ElementTree.fromstring(line_chart({"": points}, "images", "Gaussians", most))
    labels = list(chart.iter(f"{NAMESPACE}text"))
    assert [label.text for label in labels if label.get("text-anchor") == "middle"] == columns.split()
    below = [label for label in labels if label.get("text-anchor") == "end" and label.text != "images"]
    assert [label.text for label in below] == rows.split()


def test_a_label_is_below_its_point():
    chart = ElementTree.fromstring(line_chart({"": [(0, 1), (600, 2), (750, 3)]}, "images", "Gaussians"))
    points = next(chart.iter(f"{NAMESPACE}polyline")).get("points").split()
    (label,) = (text for text in chart.iter(f"{NAMESPACE}text") if text.text == "600")
    assert label.get("x") == points[1].split(",")[0]


def test_names_of_lines_are_above_the_chart():
    names = ("one", "two", "three")
    chart = ElementTree.fromstring(line_chart({name: [(0, 0), (1, 1)] for name in names}, "x", "y"))
    labels = {label.text: float(label.get("y")) for label in chart.iter(f"{NAMESPACE}text")}
    top = float(chart.find(f"{NAMESPACE}polyline").get("points").split()[1].split(",")[1])
    assert labels["one"] < labels["two"] < labels["three"] < top
    assert float(chart.get("viewBox").split()[3]) == 360 + 2 * 14


def test_parts_add_up_from_the_start_of_the_process(monkeypatch):
    begin = psutil.Process().create_time()
    laps = Laps(since_start=True)
    for seconds, name in ((2, "imports"), (5, "capture"), (4, "clock set back"), (6.5, "capture")):
        monkeypatch.setattr(time, "time", lambda at=begin + seconds: at)
        laps.lap(name)
    assert laps.seconds == pytest.approx({"imports": 2, "capture": 5.5, "clock set back": 0})
    assert laps.text() == "set-up 7.5 s: imports 2.0, capture 5.5, clock set back 0.0"


def count(shown):
    with image_progress("Counting", shown) as report:
        for done in range(1, 4):
            report(done, 3)


def test_a_terminal_shows_how_far_the_work_is(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    count(True)
    shown = capsys.readouterr()
    assert "Counting" in shown.err and "3/3" in shown.err and not shown.out
    count(False)
    assert not capsys.readouterr().err


def test_a_file_gets_no_bar(capsys, monkeypatch):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    count(True)
    assert not capsys.readouterr().err
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    count(True)
    assert "Counting: 3 of 3 images\n" in capsys.readouterr().err
    count(False)
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, ünïcode 🏙\tand more\n", "plain, ünïcode 🏙\tand more\\n"),
        ("a\x1b[31mred", "a\\x1b[31mred"),
        ("\x07\x00\x7f\r", "\\x07\\x00\\x7f\\r"),
        ("\x9b2J", "\\x9b2J"),
        ("gpj.\u202e", "gpj.\\u202e"),
    ],
)
def test_control_characters_are_escaped(text, shown):
    assert printable(text) == shown
    assert printable(text, lines=True) == shown.replace("\\n", "\n")


def test_amounts_have_a_unit_that_fits():
    sizes = (0, 999, 1234, 999_600, 12.34e6, 8e9, 1.2345e12)
    assert [amount(size) for size in sizes] == [
        "0 bytes", "999 bytes", "1.23 kB", "1.00 MB", "12.3 MB", "8.00 GB", "1,234 GB"
    ]  # fmt: skip


# Memory.


@pytest.mark.parametrize(
    ("group", "limits", "host", "available"),
    [
        ("0::/", {"": None}, 8192, 3072),  # no container
        ("0::/", {"": (5000, 4500)}, 5000, 900),  # in a container; 400 bytes of its use are caches
        ("3:cpu:/\n0::/job/step", {"job": (9000, 7000), "job/step": ("max", 1)}, 8192, 2400),
        ("0::/job", {"job": (6000, 6900)}, 6000, 0),
    ],
)
def test_memory_is_that_of_the_container_or_job(tmp_path, monkeypatch, group, limits, host, available):
    (tmp_path / "meminfo").write_text("MemTotal:  8 kB\nMemFree:  1 kB\nMemAvailable:  3 kB\n")
    (tmp_path / "own").write_text(group + "\n")
    for name, found in limits.items():
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
        if found is not None:
            (tmp_path / name / "memory.max").write_text(f"{found[0]}\n")
            (tmp_path / name / "memory.current").write_text(f"{found[1]}\n")
            text = "anon 9\ninactive_file 300\nactive_file 100\nslab 7\n"
            (tmp_path / name / "memory.stat").write_text(text)
    monkeypatch.setattr(memory, "_HOST", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_OWN_GROUP", tmp_path / "own")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path)
    assert (memory.host_bytes(), memory.available_bytes()) == (host, available)
