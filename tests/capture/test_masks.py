# SPDX-License-Identifier: Apache-2.0
"""What masks and alpha exclude, by format and way of writing, and to which image a mask belongs."""

import struct

import cv2
import numpy as np
import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.capture.image_files import decode_mask, decode_rgb, described, read_header
from blitzgs.capture.images import ImageStore
from blitzgs.capture.masks import find_masks
from tests.capture.helpers import png, smooth_image, tiff, warned, write_capture, write_image
from tests.helpers import refused

SHAPE = (48, 64)


def scene():
    """True where pixels count."""
    counts = np.zeros(SHAPE, dtype=bool)
    counts[:, 17:] = True
    cv2.circle(view := counts.astype(np.uint8), (40, 24), 9, 0, -1)
    return view > 0


COUNTS = scene()


def coded(suffix, pixels, *flags):
    return cv2.imencode(suffix, pixels, list(flags))[1].tobytes()


def grey(black, white, dtype=np.uint8):
    return np.where(COUNTS, white, black).astype(dtype)


def with_alpha(color, alpha, dtype=np.uint8):
    alpha = np.broadcast_to(np.asarray(alpha), SHAPE).astype(dtype)
    return np.dstack([np.broadcast_to(np.asarray(color), SHAPE).astype(dtype)] * 3 + [alpha])


PALETTE = b"\0\0\0\x80\0\0\0\x04\0"
WAYS = {
    "black and white": coded(".png", grey(0, 255)),
    "1 bit": png(COUNTS.astype(int), 0, 1),
    "labels 0 and 1": coded(".png", grey(0, 1)),
    "labels 0 and 3 of 16 bits": coded(".png", grey(0, 3, np.uint16)),
    "labels 0, 1 and 2": coded(
        ".png", np.where(COUNTS & (np.arange(64) > 40), 2, grey(0, 1)).astype(np.uint8)
    ),
    "16 bits": coded(".png", grey(0, 65535, np.uint16)),
    "nearly black": coded(".png", grey(1, 255)),
    "nearly black and nearly white": coded(".png", grey(6, 250)),
    "nearly black of 16 bits": coded(".png", grey(300, 65000, np.uint16)),
    "colours": coded(".png", np.dstack([grey(0, 0), grey(0, 0), grey(0, 90)])),
    "palette": png(COUNTS.astype(int), 3, 2, palette=PALETTE),
    "palette of dark colours": png(2 * COUNTS.astype(int), 3, 2, palette=PALETTE),
    "palette with transparent colour": png(COUNTS.astype(int), 3, 2, b"\0\xff", b"\xff\xff\xff\xff\xff\xff"),
    "grey with transparent value": png(grey(200, 255).astype(int), 0, 8, b"\0\xc8"),
    "white, shape in alpha": coded(".png", with_alpha(255, grey(0, 255))),
    "black, shape in alpha": coded(".png", with_alpha(0, grey(0, 255))),
    "shape in both": coded(".png", with_alpha(grey(0, 255), grey(0, 255))),
    "shape in colour, opaque": coded(".png", with_alpha(grey(0, 255), 255)),
    "16 bits, shape in alpha": coded(".png", with_alpha(65535, grey(0, 65535, np.uint16), np.uint16)),
    "grey and alpha": png(np.dstack([np.full(SHAPE, 255), grey(0, 255)]), 4, 8),
    "TIFF": coded(".tiff", grey(0, 255)),
    "TIFF of 16 bits, white is 0": tiff(grey(65535, 0, np.uint16)[..., None], photometric=0),
    "TIFF of 8 bits, white is 0": tiff(grey(255, 0)[..., None], photometric=0),
    "TIFF of floats": tiff(grey(0, 1, np.float32)[..., None]),
    "TIFF, shape in alpha": tiff(with_alpha(255, grey(0, 255)), extra=2),
    "TIFF, shape in associated alpha": tiff(with_alpha(grey(0, 255), grey(0, 255)), extra=1),
    "lossless WebP": coded(".webp", grey(0, 255), cv2.IMWRITE_WEBP_QUALITY, 101),
    "WebP": coded(".webp", grey(0, 255), cv2.IMWRITE_WEBP_QUALITY, 80),
    "WebP, shape in alpha": coded(".webp", with_alpha(255, grey(0, 255)), cv2.IMWRITE_WEBP_QUALITY, 80),
    "BMP": coded(".bmp", grey(0, 255)),
    "JPEG 2000": coded(".jp2", grey(0, 255)),
    "JPEG of quality 60": coded(".jpg", grey(0, 255), cv2.IMWRITE_JPEG_QUALITY, 60),
    "JPEG of quality 90": coded(".jpg", grey(0, 255), cv2.IMWRITE_JPEG_QUALITY, 90),
    "progressive JPEG": coded(".jpg", grey(0, 255), cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "JPEG of grey": coded(".jpg", grey(0, 128), cv2.IMWRITE_JPEG_QUALITY, 90),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_to_write_a_mask(way):
    np.testing.assert_array_equal(decode_mask(described(WAYS[way], "x")), COUNTS)


def test_labels_of_all_brightnesses_count_whatever_they_are():
    labels = np.arange(48 * 64).reshape(SHAPE) % 256
    mask = described(coded(".png", labels.astype(np.uint8)), "x")
    np.testing.assert_array_equal(decode_mask(mask), labels > 0)


@pytest.mark.parametrize(
    ("name", "mask", "message"),
    [
        ("a.png", np.full(SHAPE, 255), "the masks exclude nothing"),
        ("a.png", np.full(SHAPE, 3), "the masks exclude nothing"),
        ("a.png", np.full(SHAPE, 0), "the masks exclude every pixel"),
        ("a.jpg", grey(0, 1), "exclude every pixel.*lossy files.*as PNG"),
    ],
)
def test_masks_without_effect_are_said(tmp_path, name, mask, message):
    names = [name, name.replace("a", "b")]
    root = write_capture(tmp_path, names)
    for file in names:
        write_image(root / "masks" / file, mask.astype(np.uint8))
    warned(message, load_capture, root)


# Names of images, files below masks/, and for each image its file (None: it has none).
OWNERS = [
    (["a.jpg"], ["a.jpg.png"], ["a.jpg.png"]),
    (["a.jpg"], ["a.png"], ["a.png"]),
    (["a.jpg"], ["a.jpg"], ["a.jpg"]),
    (["a.jpg"], ["a_mask.png"], ["a_mask.png"]),
    (["a.jpg"], ["a_mask.jpg"], ["a_mask.jpg"]),
    (["a.jpg"], ["a.jpg_mask.png"], ["a.jpg_mask.png"]),
    (["a.jpg"], ["a.jpg.mask.png"], ["a.jpg.mask.png"]),
    (["a.JPG"], ["A.png"], ["A.png"]),
    (["a.jpg", "b.jpg"], ["b.png", "a.png"], ["a.png", "b.png"]),
    (["a.jpg"], ["a.png", "a.jpg.png"], ["a.jpg.png"]),
    # Another suffix, where one image fits.
    (["a.png"], ["a.tif"], ["a.tif"]),
    (["DJI_1.JPG"], ["dji_1.jpeg"], ["dji_1.jpeg"]),
    (["DJI_1.JPG"], ["DJI_1.JPG.bmp"], ["DJI_1.JPG.bmp"]),
    (["a.jpg"], ["a_mask.webp"], ["a_mask.webp"]),
    (["front/0.jpg", "back/0.jpg"], ["front/0.tif", "back/0.gif"], ["front/0.tif", "back/0.gif"]),
    (["images/front/0.jpg"], ["front/0.tif"], ["front/0.tif"]),
    (["a.png"], ["a.tif", "a.png"], ["a.png"]),
    (["a.jpg", "a.png"], ["a.tif"], ValueError),
    (["front/0.jpg", "back/0.jpg"], ["0.tif"], ValueError),
    # One stem, two images: each file belongs to the image that it is called after most exactly.
    (["a.jpg", "a.png"], ["a.jpg.png", "a.png"], ["a.jpg.png", "a.png"]),
    (["a.jpg", "a.png"], ["a.png.png"], [None, "a.png.png"]),
    (["front/0.png", "back/0.png"], ["front/0.png", "back/0.png"], ["front/0.png", "back/0.png"]),
    (["front/0.png", "back/0.png"], ["front/0.png"], ["front/0.png", None]),
    (["back/0.png"], ["front/0.png", "back/1.png"], ValueError),
    (
        ["images/front/0.png", "images/back/0.png"],
        ["front/0.png", "back/0.png"],
        ["front/0.png", "back/0.png"],
    ),
    (["images\\front\\0.png"], ["front/0.png"], ["front/0.png"]),
    (["front/0.png"], ["images/front/0.png"], ["images/front/0.png"]),
    (["front/0.png"], ["0.png"], ["0.png"]),
    (["front/0.png", "back/0.png"], ["0.png"], ValueError),
    (["front/0.png", "back/0.png", "top/1.png"], ["0.png", "1.png"], ValueError),
    (["a.jpg", "a.jpeg"], ["a.png"], ValueError),
    (["b.jpg"], ["a.png"], ValueError),
    (["a\u0308.jpg"], ["\xe4.png"], ["\xe4.png"]),
]


@pytest.mark.parametrize(("names", "files", "expected"), OWNERS)
def test_a_mask_belongs_to_one_image(tmp_path, names, files, expected):
    folder = tmp_path / "masks"
    for file in files:
        write_image(folder / file, np.zeros((4, 4, 3), dtype=np.uint8))
    if expected is ValueError:
        with pytest.raises(ValueError, match="could belong to several images|belongs to an image"):
            find_masks(tmp_path, None, names, [None] * len(names))
        return
    found = find_masks(tmp_path, None, names, [None] * len(names))
    assert found == [None if file is None else folder / file for file in expected]


def test_a_mask_that_the_file_names_is_used_for_all_that_name_it(tmp_path):
    path = tmp_path / "one.png"
    write_image(path, np.zeros((4, 4, 3), dtype=np.uint8))
    assert find_masks(tmp_path, None, ["a.png", "b.png"], [path, path]) == [path, path]
    with pytest.raises(FileNotFoundError, match="1 masks are missing .first: .*no.png.*mask_path"):
        find_masks(tmp_path, None, ["a.png"], [tmp_path / "no.png"])
    (tmp_path / "no.png").symlink_to("elsewhere.png")
    with pytest.raises(
        FileNotFoundError, match="no.png is a link to elsewhere.png: No such file or directory"
    ):
        find_masks(tmp_path, None, ["a.png"], [tmp_path / "no.png"])


def test_messages_about_masks_speak_of_masks(tmp_path):
    root = write_capture(tmp_path, ["a.png"])
    (root / "masks").mkdir()
    path = root / "masks" / "a.png"
    path.write_bytes(WAYS["black and white"][:-20])
    store = ImageStore(load_capture(root))
    refused(ValueError, r"the mask: .*masks/a.png: at byte \d+: truncated PNG", store.mask, 0)


def test_a_photograph_is_not_taken_for_its_own_mask(tmp_path):
    """Absolute names and `..`, joined to the folder of masks, would lead to the photographs."""
    (tmp_path / "capture" / "masks").mkdir(parents=True)
    write_image(tmp_path / "photos" / "a.png", smooth_image(64, 48))
    photo = str(tmp_path / "photos" / "a.png")
    for name in (photo, "../../photos/a.png"):
        assert find_masks(tmp_path / "capture", None, [name], [None]) == [None]
    write_image(tmp_path / "capture" / "masks" / "a.png", np.ones((4, 4), dtype=np.uint8))
    found = find_masks(tmp_path / "capture", None, [photo], [None])
    assert found == [tmp_path / "capture" / "masks" / "a.png"]


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
        difference = np.abs(decode_rgb(described(data, "x"), background).astype(float) - expected)
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
        shown = decode_rgb(described(data, "x"), background)
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
    shown = decode_rgb(described(encode(".gif", pixels), "x"), (0.0, 0.0, 1.0))
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
        assert decode_rgb(described(jp2_without_marks(), "x"), background)[5, 5].tolist() == [200, 100, 50]
        expected = blended(np.array([200, 100, 50, 128]) / 255, background, associated=True)
        shown = decode_rgb(described(jp2_without_marks(True), "x"), background)
        assert shown[5, 5].tolist() == expected.tolist()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp", ".jp2"])
def test_files_without_alpha_are_the_same_over_every_background(tmp_path, suffix):
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), pixels)
    assert not read_header(path).has_alpha
    shown = [decode_rgb(described(path.read_bytes(), "x"), background) for background in (None, *BACKGROUNDS)]
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
        refused(ValueError, f"a.tif: not supported: {reason}", load_capture, root)


def test_unused_bands_are_said_at_load_and_alpha_is_counted(tmp_path):
    root = write_capture(tmp_path, ["a.tif", "b.tif", "c.tif"])
    pixels = np.full((48, 64, 4), (200, 100, 50, 128), dtype=np.uint8)
    for name, extra in (("a.tif", 0), ("b.tif", 2), ("c.tif", 1)):
        (root / "images" / name).write_bytes(tiff(pixels, extra))
    capture = warned(r"1 of 3 photographs have a further band .*first: a.tif.*not used", load_capture, root)
    about = capture.about
    assert (capture.has_alpha, about.with_alpha, about.extra_bands) == (True, 2, 1)
    store = ImageStore(capture, background=(0.0, 0.0, 0.0))
    shown = [store.get(i)[5, 5].tolist() for i in range(3)]
    assert shown == [[200, 100, 50], [100, 50, 25], [200, 100, 50]]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_grey_photographs_among_colours_are_named(tmp_path, suffix, recwarn):
    names = ["a_D.jpg", f"b_MS_G{suffix}", "c_D.jpg"]
    root = write_capture(tmp_path, names)
    load_capture(root)
    assert not [w for w in recwarn if "grey" in str(w.message)]
    write_image(root / "images" / names[1], np.full((48, 64), 90, np.uint8))
    warned(rf"1 of 3 photographs are grey \(first: {names[1]}\)", load_capture, root)
    for name in names:
        write_image(root / "images" / name, np.full((48, 64), 90, np.uint8))
    recwarn.clear()
    load_capture(root)
    assert not [w for w in recwarn if "grey" in str(w.message)]
