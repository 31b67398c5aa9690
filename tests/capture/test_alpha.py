# SPDX-License-Identifier: Apache-2.0
"""Alpha is what a file calls so, and is applied once: rgb a + background (1 - a), whatever the format."""

import struct

import cv2
import numpy as np
import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.capture.image_files import decode_rgb, read_header
from blitzgs.capture.images import ImageStore
from tests.capture.helpers import write_capture
from tests.capture.image_bytes import png, tiff

BACKGROUNDS = [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2371, 0.5513, 0.9127)]
SIZE = 16


def samples(full, bands=4, seed=0):
    """Pixels of all kinds of alpha, none and full among them."""
    pixels = np.random.default_rng(seed).integers(0, full + 1, (SIZE, SIZE, bands))
    pixels[:2, :, -1], pixels[2:4, :, -1] = 0, full
    return pixels


def blended(fractions, background, associated=False):
    """The formula, in float64, of RGBA in [0, 1]."""
    alpha = fractions[..., 3:]
    rgb = fractions[..., :3] * (1 if associated else alpha) + np.array(background) * (1 - alpha)
    return np.floor(np.minimum(rgb, 1) * 255 + 0.5)


def check(data, fractions, associated=False, tolerance=0.0):
    for background in BACKGROUNDS:
        expected = blended(fractions, background, associated)
        difference = np.abs(decode_rgb(data, "x", background).astype(float) - expected)
        # float32 may round the other way at a half.
        assert difference.max() <= max(1, tolerance) and (difference > tolerance).mean() < 0.01


def encode(suffix, rgba, flags=()):
    return cv2.imencode(suffix, np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]), list(flags))[1].tobytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("extra", [1, 2])
def test_tiff(dtype, order, big, extra):
    full = np.iinfo(dtype).max
    pixels = samples(full).astype(dtype)
    if extra == 1:
        pixels[..., :3] = (pixels[..., :3] / full * pixels[..., 3:]).astype(dtype)
    data = tiff(pixels, extra, order=order, big=big)
    check(data, pixels / full, associated=extra == 1)
    check(tiff(pixels, extra, order=order, big=big, t274=3), pixels / full, associated=extra == 1)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("extra", "bands"), [(0, 4), (None, 4), (0, 2), (None, 2)])
def test_a_band_that_a_tiff_does_not_call_alpha_is_not_used(tmp_path, dtype, extra, bands):
    full = np.iinfo(dtype).max
    pixels = samples(full, bands).astype(dtype)
    data = tiff(pixels, extra)
    colours = pixels[..., :3] if bands == 4 else np.repeat(pixels[..., :1], 3, axis=2)
    for background in BACKGROUNDS:
        shown = decode_rgb(data, "x", background)
        assert np.abs(shown.astype(float) - colours / full * 255).max() <= 1
    (tmp_path / "a.tif").write_bytes(data)
    header = read_header(tmp_path / "a.tif")
    assert (header.has_alpha, header.extra_bands) == (False, 1)


@pytest.mark.parametrize(
    ("suffix", "dtype", "bits", "flags", "tolerance"),
    [
        (".png", np.uint8, 8, (), 0),
        (".png", np.uint16, 16, (), 0),
        (".webp", np.uint8, 8, (cv2.IMWRITE_WEBP_QUALITY, 101), 0),
        (".jp2", np.uint8, 8, (), 1),
        (".jp2", np.uint16, 16, (), 1),
        (".bmp", np.uint8, 8, (), 0),
        (".avif", np.uint8, 8, (cv2.IMWRITE_AVIF_QUALITY, 100, cv2.IMWRITE_AVIF_DEPTH, 8), 4),
        (".avif", np.uint16, 10, (cv2.IMWRITE_AVIF_QUALITY, 100, cv2.IMWRITE_AVIF_DEPTH, 10), 4),
        (".avif", np.uint16, 12, (cv2.IMWRITE_AVIF_QUALITY, 100, cv2.IMWRITE_AVIF_DEPTH, 12), 4),
    ],
)
def test_formats_with_an_alpha_channel(suffix, dtype, bits, flags, tolerance):
    full = (1 << bits) - 1
    pixels = samples(full).astype(dtype)
    if tolerance:  # lossy: little detail
        pixels[:] = np.array([200, 100, 50, 128]) * full // 255
    pixels = np.repeat(np.repeat(pixels, 4, axis=0), 4, axis=1)  # JPEG 2000 needs some size
    check(encode(suffix, pixels, flags), pixels / full, tolerance=tolerance)


def test_gif_with_a_transparent_colour():
    # The encoder has a palette of its own.
    pixels = np.zeros((SIZE, SIZE, 4), dtype=np.uint8)
    pixels[:, :8] = (255, 0, 0, 255)
    shown = decode_rgb(encode(".gif", pixels), "x", (0.0, 0.0, 1.0))
    assert shown[4, 2].tolist() == [252, 0, 0] and shown[4, 12].tolist() == [0, 0, 255]


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_a_grey_png_with_a_transparent_value(bits):
    full = (1 << bits) - 1
    values = np.random.default_rng(bits).integers(0, full + 1, (SIZE, SIZE))
    value = int(values[3, 5])
    fractions = np.repeat(values[..., None] / full, 4, axis=2)
    fractions[..., 3] = values != value
    check(png(values, 0, bits, struct.pack(">H", value)), fractions)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kind", ["transparent colour", "grey and alpha"])
def test_other_pngs_with_alpha(bits, kind):
    full = (1 << bits) - 1
    if kind == "grey and alpha":
        pixels = samples(full, bands=2)
        check(png(pixels, 4, bits), pixels[..., [0, 0, 0, 1]] / full)
        return
    pixels = samples(full, bands=3)
    pixels[4:8] = pixels[0, 0]
    fractions = np.ones((SIZE, SIZE, 4))
    fractions[..., :3] = pixels / full
    fractions[..., 3] = (pixels != pixels[0, 0]).any(axis=2)
    check(png(pixels, 2, bits, struct.pack(">3H", *pixels[0, 0].tolist())), fractions)


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_palettes_with_alpha(bits):
    count = 1 << bits
    random = np.random.default_rng(bits)
    values = random.integers(0, count, (SIZE, SIZE))
    palette, alpha = random.integers(0, 256, (count, 3)), random.integers(0, 256, count)
    alpha[-1] = 255  # left out of the file, as writers do
    fractions = np.concatenate([palette[values], alpha[values][..., None]], axis=2) / 255
    check(png(values, 3, bits, bytes(alpha[:-1].tolist()), palette.astype("u1").tobytes()), fractions)


def jp2_without_marks(associated=None):
    """A JPEG 2000 of four bands; `associated`: its channel definition is that of associated alpha."""
    pixels = np.full((64, 64, 4), (200, 100, 50, 128), dtype=np.uint8)
    data = bytearray(encode(".jp2", pixels))
    at = data.index(b"cdef")
    if associated:
        data[at + 4 + 2 + 3 * 6 + 3] = 2
    else:
        data[at : at + 4] = b"free"
    return bytes(data)


def test_the_channel_definition_of_jpeg_2000_decides():
    for background in BACKGROUNDS:
        assert decode_rgb(jp2_without_marks(), "x", background)[5, 5].tolist() == [200, 100, 50]
        expected = blended(np.array([200, 100, 50, 128]) / 255, background, associated=True)
        assert decode_rgb(jp2_without_marks(True), "x", background)[5, 5].tolist() == expected.tolist()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jp2"])
def test_files_without_alpha_are_the_same_over_every_background(tmp_path, suffix):
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), pixels)
    assert not read_header(path).has_alpha
    shown = [decode_rgb(path.read_bytes(), "x", background) for background in (None, *BACKGROUNDS)]
    assert all(np.array_equal(shown[0], other) for other in shown[1:])


@pytest.mark.parametrize(
    ("bands", "extra", "reason"),
    [
        (5, None, "TIFF of 5 bands"),
        (5, [2, 0], "TIFF of 5 bands"),
        (5, [0, 0], "TIFF of 5 bands"),
        (2, 2, "grey TIFF with an alpha channel; convert it to PNG"),
        (2, 1, "grey TIFF with an alpha channel; convert it to PNG"),
    ],
)
def test_bands_that_cannot_be_used_are_refused_by_name(tmp_path, bands, extra, reason):
    for dtype in (np.uint8, np.uint16):
        root = write_capture(tmp_path / np.dtype(dtype).name, ["a.tif"])
        (root / "images" / "a.tif").write_bytes(tiff(np.zeros((48, 64, bands), dtype=dtype), extra))
        with pytest.raises(ValueError, match=f"a.tif: not supported: {reason}"):
            load_capture(root)


def test_unused_bands_are_said_at_load_and_alpha_is_counted(tmp_path):
    root = write_capture(tmp_path, ["a.tif", "b.tif", "c.tif"])
    pixels = np.full((48, 64, 4), (200, 100, 50, 128), dtype=np.uint8)
    for name, extra in (("a.tif", 0), ("b.tif", 2), ("c.tif", 1)):
        (root / "images" / name).write_bytes(tiff(pixels, extra))
    with pytest.warns(UserWarning, match=r"1 of 3 photographs have a further band .*first: a.tif.*not used"):
        capture = load_capture(root)
    about = capture.about
    assert (capture.has_alpha, about.with_alpha, about.extra_bands) == (True, 2, 1)
    store = ImageStore(capture, background=(0.0, 0.0, 0.0))
    shown = [store.get(i)[5, 5].tolist() for i in range(3)]
    assert shown == [[200, 100, 50], [100, 50, 25], [200, 100, 50]]
