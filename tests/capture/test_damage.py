# SPDX-License-Identifier: Apache-2.0
"""Files of kinds that are not supported, and damage that is found before a file is needed."""

import re

import cv2
import numpy as np
import pytest

from blitzgs.capture import masks
from blitzgs.capture.capture import load_capture
from blitzgs.capture.image_files import (
    check_photograph,
    decode_mask,
    decode_rgb,
    described,
    read_header,
    read_whole,
)
from blitzgs.capture.images import ImageStore
from blitzgs.capture.masks import damaged
from tests.capture.helpers import edit_model, smooth_image, tiff, warned, write_capture, write_image
from tests.helpers import refused

NAMES = [f"{i}.png" for i in range(9)]
DIAGONAL = np.repeat(255 * np.eye(48, 64, dtype=np.uint8)[..., None], 3, axis=2)  # of a mask
BOX = b"\0\0\0\x20ftyp%s\0\0\0\0mif1" + bytes(20)


def floats(kind, bands=3):
    return tiff(np.full((48, 64, bands), 1, dtype=kind))


# Name of the file, its content, and the kind that the message has to name.
KINDS = [
    ("a.tif", floats("f4"), "float32 TIFF"),
    ("a.tif", floats("f8"), "float64 TIFF"),
    ("a.tif", floats("f4", 1), "float32 TIFF"),
    ("a.tif", floats("f4", 4), "float32 TIFF"),
    ("a.tif", floats("u4"), "uint32 TIFF"),
    ("a.tif", floats("i2"), "int16 TIFF"),
    ("a.tif", floats("i1"), "int8 TIFF"),
    ("a.tif", tiff(np.ones((48, 64, 4), dtype=np.uint16), photometric=5), "CMYK TIFF of 16 bits"),
    ("a.tif", tiff(np.ones((48, 64, 7), dtype=np.uint8)), "TIFF of 7 bands"),
    ("a.dng", tiff(np.ones((48, 64, 3), dtype=np.uint8), t50706=1), "camera raw"),
    ("a.nef", tiff(np.ones((48, 64, 3), dtype=np.uint8), t254=1, t330=8), "camera raw"),
    ("a.tga", bytes(12) + b"\x40\0\x30\0\x18\0" + bytes(9216), "TGA"),
    ("a.jpg", bytes(12) + b"\x40\0\x30\0\x18\0" + bytes(9216) + bytes(8) + b"TRUEVISION-XFILE.\0", "TGA"),
    ("a.heic", BOX % b"heic", "HEIC"),
    ("a.jpg", BOX % b"heic", "HEIC"),
    ("a.cr3", BOX % b"crx ", "camera raw"),
    ("a.jxl", b"\xff\x0a" + bytes(60), "JPEG XL"),
    ("a.psd", b"8BPS\0\1" + bytes(60), "Photoshop"),
    ("a.exr", b"v/1\x01" + bytes(60), "OpenEXR"),
    ("a.hdr", cv2.imencode(".hdr", np.ones((48, 64, 3), np.float32))[1].tobytes(), "Radiance HDR"),
    ("a.pfm", cv2.imencode(".pfm", np.ones((48, 64, 3), np.float32))[1].tobytes(), "PFM"),
    ("a.pdf", b"%PDF-1.4" + bytes(60), "PDF"),
    ("a.ico", bytes(60), "ICO"),
    ("a.sgi", b"\x01\xda" + bytes(60), "SGI"),
    ("a.tif", tiff(np.ones((48, 64, 4), dtype=np.uint16), 2, t284=2), "TIFF of 16 bits with an alpha"),
]


@pytest.mark.parametrize(("name", "data", "kind"), KINDS)
def test_what_is_not_supported_is_called_so_at_load(tmp_path, name, data, kind, capfd):
    root = write_capture(tmp_path, ["a.png"])
    (root / "images" / "a.png").rename(root / "images" / name).write_bytes(data)
    edit_model(root, lambda model: model.images.names.__setitem__(0, name))
    with pytest.raises(ValueError, match=rf"{name}: .*not supported: {kind}.*convert") as caught:
        load_capture(root)
    assert "damaged" not in str(caught.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty; copy it again"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "a pointer of Git LFS.*git lfs pull"),
    ],
)
def test_files_without_an_image_are_called_what_they_are(tmp_path, data, message):
    for name in ("a.png", "a.jpg", "a.tif"):
        (tmp_path / name).write_bytes(data)
        for reads in (read_header, check_photograph):
            refused(ValueError, f"{name}: {message}", reads, tmp_path / name)
        write_image(whole := tmp_path / "whole.png", smooth_image(8, 8))
        assert re.search(f"the mask: .*{name}: {message}", damaged([(whole, tmp_path / name)])[0])


def test_a_mask_in_separate_bands_of_16_bits_is_refused():
    data = tiff(np.ones((8, 8, 3), dtype=np.uint16), t284=2)
    refused(ValueError, "m.tif: not .* of 16 bits with separate bands", decode_mask, described(data, "m.tif"))


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jpg", ".jp2", ".bmp"])
def test_damaged_files_leave_the_terminal_to_our_message(tmp_path, suffix, capfd):
    """Decoders write lines of their own before they fail."""
    path = tmp_path / f"a{suffix}"
    write_image(path, smooth_image(48, 64))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=rf"a\{suffix}: "):
        read_header(path)
        decode_rgb(read_whole(path))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("place", ["IHDR", "IDAT", "IEND"])
def test_a_png_with_a_wrong_checksum_is_refused_with_its_place(tmp_path, place):
    path = tmp_path / "a.png"
    write_image(path, smooth_image(48, 64))
    data = bytearray(path.read_bytes())
    at = data.index(place.encode())
    data[at + 4] ^= 1
    path.write_bytes(data)
    refused(ValueError, rf"a.png: at byte {at - 4}: damaged PNG: the checksum", read_whole, path)


def test_a_png_with_damage_in_what_no_picture_needs_is_read(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, smooth_image(8, 8))
    data = path.read_bytes()
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + b"\0\0\0\4tEXtspam\0\0\0\0" + data[at:])
    assert decode_rgb(read_whole(path)).shape == (8, 8, 3)
    for length in range(8, len(data)):
        path.write_bytes(data[:length])
        refused(ValueError, "truncated PNG", read_whole, path)


def spoil(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["image", "mask"])
@pytest.mark.parametrize("index", [0, 4])  # a held-out view, and one to train on
def test_damage_is_found_in_the_background_and_ends_every_read(tmp_path, kind, index):
    root = write_capture(tmp_path, NAMES)
    for name in NAMES:
        write_image(root / "masks" / name, DIAGONAL)
    capture = load_capture(root)
    store = ImageStore(capture)
    store.check_files(range(9)).wait()
    assert store.get(7).shape == (48, 64, 3)
    camera = capture.cameras[index]
    spoil(camera.image_path if kind == "image" else camera.mask_path)
    store.close()
    store = ImageStore(capture)  # which has no copy of the file in memory
    store.check_files(range(9)).wait()
    refused(ValueError, ("the mask: " if kind == "mask" else "") + rf".*{index}.png: at byte", store.get, 7)
    store.close()
    message = rf"1 of 9 images or their masks are damaged; dropped .*{index}.png: at"
    left = warned(message, load_capture, root, allow_missing=True)
    assert len(left.cameras) == 8 and left.about.damaged == 1
    np.testing.assert_array_equal(left.offset, capture.offset)


@pytest.mark.parametrize("kind", ["transparent", "masked"])
def test_photographs_without_a_pixel_that_counts_are_named(tmp_path, kind):
    root = write_capture(tmp_path, NAMES[:4])
    if kind == "transparent":
        cv2.imwrite(str(root / "images" / NAMES[2]), np.zeros((48, 64, 4), dtype=np.uint8))
    else:
        write_image(root / "masks" / NAMES[1], DIAGONAL)
        write_image(root / "masks" / NAMES[2], np.zeros((48, 64, 3), dtype=np.uint8))
    store = ImageStore(load_capture(root))
    warned(
        "1 photographs have no pixel that counts.*first: 2.png", lambda: store.check_files(range(4)).wait()
    )


def test_a_header_beyond_the_first_bytes_is_found(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, smooth_image(48, 64))
    data = path.read_bytes()
    profile = b"".join(b"\xff\xe2" + (65535).to_bytes(2, "big") + bytes(65533) for _ in range(3))
    path.write_bytes(data[:2] + profile + data[2:])
    header = read_header(path)
    assert (header.width, header.height) == (64, 48)


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("count", [1, 4, 100, 2000])
def test_bytes_after_the_last_block_of_a_jpeg_change_no_pixel(tmp_path, progressive, count):
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_QUALITY, 90]
    data = cv2.imencode(".jpg", smooth_image(96, 128), flags)[1].tobytes()
    more = np.random.default_rng(count).integers(1, 255, count, dtype=np.uint8).tobytes()
    (tmp_path / "a.jpg").write_bytes(data[:-2] + more + data[-2:])
    shown = decode_rgb(read_whole(tmp_path / "a.jpg"))
    np.testing.assert_array_equal(shown, decode_rgb(described(data, "a.jpg")))


def test_a_photograph_that_was_read_is_not_checked_again(tmp_path, monkeypatch):
    names = [name.replace(".png", ".jpg") for name in NAMES]
    store = ImageStore(load_capture(write_capture(tmp_path, names)))
    store.get(3), store.get(4)
    checked = []
    monkeypatch.setattr(masks, "check_photograph", lambda path: not checked.append(path.name))
    store.check_files(range(9)).wait()
    assert checked == [names[index] for index in (0, 8, 1, 2, 5, 6, 7)]
    store.close()
