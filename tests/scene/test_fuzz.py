# SPDX-License-Identifier: Apache-2.0
"""Damaged files give a ValueError or a model of the size of the file: no crash, no wild allocation."""

import resource
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blitzgs.formats.native import native_io
from blitzgs.formats.ply import read_ply
from blitzgs.scene.image_files import decode_rgb, read_header, read_whole
from tests.formats.test_ply import gaussians, inria_file
from tests.scene.helpers import reconstruction, smooth_image, write_image

SETTINGS = settings(max_examples=150, deadline=None, derandomize=True)


@pytest.fixture(scope="module")
def samples():
    folder = Path(tempfile.mkdtemp())
    rec = reconstruction(["a.jpg", "b.jpg"], 64, 48, model="OPENCV")
    rec.write_binary(str(folder))
    rec.write_text(str(folder))
    inria_file(folder / "model.ply", gaussians(4, 1))
    write_image(folder / "photo.jpg", smooth_image(48, 64))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def damage(data: bytes, cut: float, flips: list[tuple[float, int]]) -> bytes:
    out = bytearray(data[: int(cut * len(data))])
    for place, value in flips:
        if out:
            out[int(place * (len(out) - 1))] = value
    return bytes(out)


READERS = {
    "cameras.bin": native_io().read_cameras,
    "images.bin": lambda path: native_io().read_images(path, True),
    "points3D.bin": lambda path: native_io().read_points(path, True),
    "cameras.txt": native_io().read_cameras,
    "images.txt": lambda path: native_io().read_images(path, True),
    "points3D.txt": lambda path: native_io().read_points(path, True),
    "model.ply": read_ply,
    "photo.jpg": lambda path: (read_header(Path(path)), decode_rgb(read_whole(Path(path)), path)),
}
FRACTION = st.floats(0, 1, exclude_max=True)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_never_crash_or_allocate_wildly(samples, tmp_path, name):
    path = tmp_path / name
    outcomes = {"read": 0, "refused": 0}

    @SETTINGS
    @given(
        st.sampled_from([1.0, 0.999, 0.9, 0.5]) | FRACTION,
        st.lists(st.tuples(FRACTION, st.integers(0, 255)), max_size=4),
    )
    def run(cut, flips):
        path.write_bytes(damage(samples[name], cut, flips))
        try:
            READERS[name](str(path))
            outcomes["read"] += 1
        except ValueError as error:
            assert name in str(error)
            outcomes["refused"] += 1

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    run()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 200 * 1024, f"{grown} KiB more for files of {len(samples[name])} bytes"
    assert outcomes["read"] > 0 and outcomes["refused"] > 0


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "model.ply"])
def test_every_truncation_of_a_binary_file_is_refused(samples, tmp_path, name):
    path = tmp_path / name
    data = samples[name]
    for length in range(0, len(data), max(1, len(data) // 300)):
        path.write_bytes(data[:length])
        with pytest.raises(ValueError, match=f"{name}: "):
            READERS[name](str(path))


@pytest.mark.parametrize("kind", ["BASELINE", "OPTIMIZE", "PROGRESSIVE", "RST_INTERVAL"])
def test_a_lost_sector_of_a_jpeg_is_noticed(tmp_path, kind):
    """512 bytes of zeros, as a disk leaves them, wherever they lie in the image data."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, 93]
    if kind != "BASELINE":
        flags += [getattr(cv2, f"IMWRITE_JPEG_{kind}"), 7]
    random = np.random.default_rng(3)
    pixels = cv2.GaussianBlur(random.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 2)
    pixels = np.clip((pixels.astype(np.float32) - 128) * 5 + random.normal(128, 4, pixels.shape), 0, 255)
    ok, data = cv2.imencode(".jpg", pixels.astype(np.uint8), flags)
    data, path = data.tobytes(), tmp_path / "a.jpg"
    path.write_bytes(data)
    read_whole(path)
    for at in random.integers(700, len(data) - 514, 60):
        path.write_bytes(data[:at] + bytes(512) + data[at + 512 :])
        with pytest.raises(ValueError, match="JPEG"):
            read_whole(path)


@pytest.mark.parametrize("progressive", [0, 1])
def test_flat_areas_are_no_holes(tmp_path, progressive):
    """Black borders compress to long runs of zeros."""
    pixels = np.zeros((900, 900, 3), dtype=np.uint8)
    pixels[400:500, 400:500] = np.random.default_rng(1).integers(0, 256, (100, 100, 3))
    for flags in ([], [cv2.IMWRITE_JPEG_OPTIMIZE, 1]):
        flags += [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
        assert cv2.imwrite(str(tmp_path / "a.jpg"), pixels, flags)
        read_whole(tmp_path / "a.jpg")
