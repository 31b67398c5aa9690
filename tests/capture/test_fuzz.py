# SPDX-License-Identifier: Apache-2.0
"""Damaged files give a ValueError or a model of the size of the file: no crash, no wild allocation."""

import json
import multiprocessing
import resource
import struct
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blitzgs.capture.image_files import decode_rgb, read_header, read_whole
from blitzgs.capture.transforms import read_transforms
from blitzgs.formats import native
from blitzgs.formats.ply import read_ply, read_point_cloud
from tests.capture.helpers import reconstruction, smooth_image, tiff, write_image
from tests.formats.test_ply import gaussians, inria_file
from tests.helpers import refused

SETTINGS = settings(max_examples=150, deadline=None, derandomize=True)


@pytest.fixture(scope="module")
def samples():
    folder = Path(tempfile.mkdtemp())
    rec = reconstruction(["a.jpg", "b.jpg"], 64, 48, model="OPENCV")
    rec.write_binary(str(folder))
    rec.write_text(str(folder))
    inria_file(folder / "model.ply", gaussians(4, 1))
    write_image(folder / "photo.jpg", smooth_image(48, 64))
    assert cv2.imwrite(str(folder / "stages.jpg"), smooth_image(48, 64), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    write_image(folder / "photo.png", smooth_image(8, 8))
    (folder / "photo.tif").write_bytes(tiff(np.ones((8, 8, 4), dtype=np.uint8), 2, t274=6))
    rows = np.zeros(4, [(name, "f4") for name in ("x", "y", "z", "red", "green", "blue")])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=True).write(folder / "cloud.ply")
    (folder / "QOI").write_bytes(native.encode_qoi(smooth_image(48, 64)))
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "mask_path": "b.png"}
    frame |= {"camera_angle_x": 1.0, "camera_angle_y": 0.8, "cx": 31.5, "is_fisheye": False}
    lens = {"w": 64, "h": 48, "fl_x": 60.0, "k1": 0.1, "ply_file_path": "p.ply", "camera_model": "RADIAL"}
    lens |= {"fl_y": 61.0, "cy": 24.0, "p1": 0.001, "distortion_params": [0.1, 0, 0, 0, 0.001, 0]}
    lens |= {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 0.5}
    lists = {"train_filenames": ["a.png"], "val_filenames": [], "test_filenames": []}
    (folder / "transforms.json").write_text(json.dumps(lens | lists | {"frames": [frame]}))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def damage(data: bytes, cut: float, flips: list[tuple[float, int]]) -> bytes:
    out = bytearray(data[: int(cut * len(data))])
    for place, value in flips:
        if out:
            out[int(place * (len(out) - 1))] = value
    return bytes(out)


def read_image(path: str) -> None:
    read_header(Path(path))
    decode_rgb(read_whole(Path(path)))


def read_parts(path: str) -> None:
    """Read what this package reads of a file itself, before OpenCV decodes it."""
    data, name = Path(path).read_bytes(), path.encode()
    native.read_image_header(data, name)
    if path.endswith(".tif"):
        native.tiff_as_stored(data, name)
    if path.endswith(".png"):
        read_whole(Path(path))


READERS = {
    "photo.png": read_parts,
    "photo.tif": read_parts,
    "cloud.ply": read_point_cloud,
    "cameras.bin": native.read_cameras,
    "images.bin": lambda path: native.read_images(path, True),
    "points3D.bin": lambda path: native.read_points(path, True),
    "cameras.txt": native.read_cameras,
    "images.txt": lambda path: native.read_images(path, True),
    "points3D.txt": lambda path: native.read_points(path, True),
    "model.ply": read_ply,
    "photo.jpg": read_image,
    "stages.jpg": read_image,
    "transforms.json": lambda path: read_transforms(Path(path).parent),
    "QOI": lambda path: native.decode_qoi(Path(path).read_bytes()),  # its messages have no other name
}
FRACTION = st.floats(0, 1, exclude_max=True)


# What a reader may take, in MiB. The samples have some kilobytes, and damaged counts claim gigabytes.
LITTLE = 24
# The check of a progressive JPEG keeps 8 bytes for each of its blocks, of which it reads at most 2^24.
BLOCKS = 128


@pytest.fixture(scope="module")
def in_fresh_process():
    """Call a function of this file on a path in a process of its own, which has no freed memory."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])

    def call(function, path: Path):
        with ProcessPoolExecutor(1, context) as pool:
            return pool.submit(function, str(path)).result()

    return call


def limit_memory(mebibytes: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (mebibytes << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def read_damaged(path: str) -> dict[str, int]:
    name, sample = Path(path).name, Path(path).read_bytes()
    outcomes = {"read": 0, "refused": 0}

    def attempt(data: bytes) -> None:
        Path(path).write_bytes(data)
        try:
            READERS[name](path)
            outcomes["read"] += 1
        except ValueError as error:
            assert name in str(error)
            outcomes["refused"] += 1

    @SETTINGS
    @given(
        st.sampled_from([1.0, 0.999, 0.9, 0.5]) | FRACTION,
        st.lists(st.tuples(FRACTION, st.integers(0, 255)), max_size=4),
    )
    def run(cut, flips):
        attempt(damage(sample, cut, flips))

    READERS[name](path)  # what is loaded at the first use is no part of what a file takes
    limit_memory(LITTLE)
    for at in range(min(len(sample), 250)):  # where the counts and sizes of all kinds are
        attempt(sample[:at] + b"\x7f\x7f\x7f" + sample[at + 3 :])
        attempt(sample[:at] + b"99999999" + sample[at:])
    run()
    return outcomes


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_never_crash_or_allocate_wildly(samples, tmp_path, in_fresh_process, name):
    (tmp_path / name).write_bytes(samples[name])
    outcomes = in_fresh_process(read_damaged, tmp_path / name)
    assert outcomes["read"] > 0 and outcomes["refused"] > 0


def check_huge(path: str) -> str:
    limit_memory(BLOCKS + LITTLE)
    read_whole(Path(path))
    return "whole"


@pytest.mark.parametrize(("components", "height"), [(1, 16384), (3, 5456), (3, 16384), (4, 65535)])
def test_a_small_jpeg_of_many_blocks_allocates_little(tmp_path, in_fresh_process, components, height):
    """Each component has a scan in which one code of 15 zero bits stands for 16,384 empty blocks."""

    def segment(marker: int, *payload: int) -> bytes:
        return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + bytes(payload)

    blocks = 8192 * -(-height // 8)
    kinds = [part for k in range(components) for part in (k, 0x11, 0)]
    data = b"\xff\xd8" + segment(0xC4, 0x10, 1, *[0] * 15, 0xE0)
    data += segment(0xC2, 8, height >> 8, height & 0xFF, 0xFF, 0xFF, components, *kinds)
    for k in range(components):
        data += segment(0xDA, 1, k, 0, 1, 63, 0) + bytes(-(-15 * (blocks // 16384) // 8))
    (tmp_path / "huge.jpg").write_bytes(data + b"\xff\xd9")
    assert in_fresh_process(check_huge, tmp_path / "huge.jpg") == "whole"


def test_a_jpeg_of_many_scans_is_refused(tmp_path):
    """Some bytes a scan cost a decoder the time of the whole picture."""
    data = cv2.imencode(".jpg", smooth_image(48, 64), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    first = data.index(b"\xff\xda")
    scan = data[first : data.index(b"\xff\xc4", first)]
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:first] + scan * 80 + data[first:])
    read_whole(path)
    path.write_bytes(data[:first] + scan * 100 + data[first:])
    refused(ValueError, "a.jpg: .* JPEG: it has more than 100 scans", read_whole, path)


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
        refused(ValueError, "JPEG", read_whole, path)


@pytest.mark.parametrize("progressive", [0, 1])
def test_flat_areas_are_no_holes(tmp_path, progressive):
    """Black borders compress to long runs of zeros."""
    pixels = np.zeros((900, 900, 3), dtype=np.uint8)
    pixels[400:500, 400:500] = np.random.default_rng(1).integers(0, 256, (100, 100, 3))
    for flags in ([], [cv2.IMWRITE_JPEG_OPTIMIZE, 1]):
        flags += [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
        assert cv2.imwrite(str(tmp_path / "a.jpg"), pixels, flags)
        read_whole(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".jp2", ".webp", ".gif", ".bmp", ".avif", ".jpg"])
def test_damaged_headers_of_all_formats_are_read_or_refused(suffix):
    data = cv2.imencode(suffix, np.full((64, 64, 4 if suffix != ".jpg" else 3), 90, np.uint8))[1].tobytes()[
        :600
    ]
    name = b"file"

    def attempt(damaged: bytes) -> None:
        try:
            found = native.read_image_header(damaged, name)
            if found["format"] == "TIFF":
                assert len(native.tiff_as_stored(damaged, name)) == len(damaged)
            assert 1 <= found["orientation"] <= 8 and found["extras"] >= 0
        except ValueError as error:
            assert str(error).startswith("file: ")

    for length in range(len(data)):
        attempt(data[:length])
    random = np.random.default_rng(0)
    for _ in range(3000):
        damaged = bytearray(data)
        for at in random.integers(0, len(data), random.integers(1, 4)):
            damaged[at] = random.integers(0, 256)
        attempt(bytes(damaged))
