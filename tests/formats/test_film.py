# SPDX-License-Identifier: Apache-2.0
"""Films: frames, sizes, colours; what is left of an interrupted one."""

import builtins
import resource

import numpy as np
import pytest

pytest.importorskip("av", reason="the extra film is not installed")

import av

from blitzgs.formats.film import check_film, new_film


def test_a_film_has_its_frames(tmp_path):
    file = tmp_path / "a.mp4"
    colours = np.array([[200, 30, 90], [20, 180, 60], [250, 250, 250], [0, 0, 0]], np.uint8)
    with new_film(file, 64, 48, 29.97) as append:
        for colour in colours:
            append(np.broadcast_to(colour, (48, 64, 3)))
    with av.open(str(file)) as film:
        stream = film.streams.video[0]
        assert (stream.width, stream.height) == (64, 48)
        assert float(stream.average_rate) == pytest.approx(29.97, abs=1e-3)
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
    assert len(frames) == 4
    for frame, colour in zip(frames, colours.astype(int), strict=True):
        assert np.abs(frame.reshape(-1, 3).mean(axis=0) - colour).max() < 3


def test_an_interrupted_film_leaves_no_file(tmp_path):
    file = tmp_path / "a.mp4"
    with pytest.raises(KeyboardInterrupt), new_film(file, 64, 48, 30) as append:
        append(np.zeros((48, 64, 3), np.uint8))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    file.write_bytes(b"\0\0\0\x20ftypisom the film of before")
    with pytest.raises(ValueError), new_film(file, 64, 48, 30) as append:
        append(np.zeros((48, 64), np.uint8))
    assert file.read_bytes().endswith(b"before") and list(tmp_path.iterdir()) == [file]


def test_a_full_disk_is_named_and_leaves_no_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).integers(0, 255, (20, 48, 64, 3), dtype=np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        with (
            pytest.raises(OSError, match="File too large") as raised,
            new_film(tmp_path / "a.mp4", 64, 48, 30) as append,
        ):
            for picture in noise:
                append(picture)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert raised.value.filename == str(tmp_path / "a.mp4") and list(tmp_path.iterdir()) == []


def test_what_is_no_film_is_kept(tmp_path):
    file = tmp_path / "a.mp4"
    check_film(file, 64, 48)
    with pytest.raises(ValueError, match="even sides, got 63x48"):
        check_film(file, 63, 48)
    file.write_text("notes on the film")
    with pytest.raises(FileExistsError, match="is no film"):
        check_film(file, 64, 48)


def test_without_the_package_the_message_says_what_to_install(tmp_path, monkeypatch):
    imported = builtins.__import__

    def without_av(name, *rest, **options):
        if name == "av":
            raise ImportError("no av")
        return imported(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(ImportError, match=r'pip install "blitzgs\[film\]"'):
        check_film(tmp_path / "a.mp4", 64, 48)
