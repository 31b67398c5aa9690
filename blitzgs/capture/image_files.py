# SPDX-License-Identifier: Apache-2.0
"""Reads size, orientation and bands of image files from their headers, and decodes images and masks.

Damaged files are refused, and files of a kind that is not supported are called so. Alpha is used only where
the file says that a band is alpha: decoders take any fourth band for it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.formats import native

UInt8 = npt.NDArray[np.uint8]
T = TypeVar("T")
R = TypeVar("R")

_HEADER_BYTES = 1 << 16
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_HEADERS_WITH_SIZE = ("JPEG", "PNG", "TIFF")
_LFS_START = b"version https://git-lfs.github.com/spec/"
# Formats without a mark by which their content would tell them.
_FORMATS_BY_SUFFIX = {".tga": "TGA", ".pcx": "PCX", ".svg": "SVG", ".eps": "EPS", ".psd": "Photoshop"}
_FORMATS_BY_SUFFIX |= {".ico": "ICO", ".sgi": "SGI", ".xbm": "XBM", ".xcf": "GIMP"}
_FORMATS_BY_SUFFIX |= dict.fromkeys((".raw", ".nef", ".arw", ".cr2", ".orf", ".rw2", ".pef"), "camera raw")
_CONVERT = "convert it to PNG or JPEG"
# A mask of black and white: how far, of the whole range, its black and white may be from 0 and 1.
_NEARLY = 1 / 16
# The least brightness, of the whole range, that the counted pixels of a lossy mask have.
_LEAST_WHITE = 1 / 4


class ImageFile(NamedTuple):
    """The bytes of an image file, and what its header says (csrc/io/image_file.h)."""

    name: str
    data: bytes | UInt8
    header: dict[str, Any]


@dataclass(frozen=True)
class ImageHeader:
    """The stored size (pixels), the EXIF orientation (1 to 8), and what its bands are."""

    width: int
    height: int
    orientation: int = 1
    has_alpha: bool = False
    extra_bands: int = 0
    is_grey: bool = False


def in_threads(call: Callable[[T], R], files: Iterable[T]) -> list[R]:
    """Return what a function returns for each of several files, which may be on a slow network disk."""
    with ThreadPoolExecutor(16) as pool:
        return list(pool.map(call, files))


def read_header(path: Path) -> ImageHeader:
    """Return size, orientation and bands of an image file; JPEG, PNG and TIFF files are not decoded.

    ValueError: the file is damaged, not an image, or of a kind that is not supported; names it.
    """
    with path.open("rb") as file:
        data = file.read(_HEADER_BYTES)
        found = None
        if data[:4] not in _TIFF_STARTS:  # a TIFF may have its header at its end
            try:
                found = described(data, str(path))
            except ValueError:  # the size follows a large preview or colour profile
                found = None
        if found is None or found.header["format"] not in _HEADERS_WITH_SIZE:
            data += file.read()
            found = described(data, str(path))
    _check_supported(found)
    header = found.header
    width, height = header["width"], header["height"]
    if header["format"] not in _HEADERS_WITH_SIZE:
        pixels = _imdecode(found, cv2.IMREAD_UNCHANGED)
        height, width = pixels.shape[:2]
    is_grey = header["colors"] == 1
    return ImageHeader(width, height, header["orientation"], bool(header["alpha"]), header["extras"], is_grey)


def described(data: bytes | UInt8, name: str, header: dict[str, Any] | None = None) -> ImageFile:
    """Return an image file in memory with what its header says; None: `header` is not read yet.

    ValueError: it is damaged, or not an image file but what is there instead of one.
    """
    if len(data) == 0:
        raise ValueError(f"{name}: the file is empty; copy it again")
    if bytes(data[: len(_LFS_START)]) == _LFS_START:
        raise ValueError(f"{name}: a pointer of Git LFS, not the file itself; fetch it with git lfs pull")
    found = native.read_image_header(data, os.fsencode(name)) if header is None else header
    if not found["format"] and (kind := _FORMATS_BY_SUFFIX.get(Path(name).suffix.lower())):
        found |= {"format": kind, "supported": False}
    return ImageFile(name, data, found)


def _check_supported(file: ImageFile) -> None:
    """Refuse a photograph of a kind that would be decoded wrongly or not at all."""
    name, header = file.name, file.header
    kind, bits, colors, alpha = (header[key] for key in ("format", "bits", "colors", "alpha"))
    bands = colors + header["extras"] + bool(alpha)
    if not header["supported"]:
        raise ValueError(f"{name}: not supported: {kind}; {_CONVERT}")
    if header["samples"] != "uint" or bits > 16:
        number = f"{header['samples']}{bits}"
        raise ValueError(
            f"{name}: pixels must be of 8 or 16 bits, got {number}; not supported: {number} {kind}; "
            f"{_CONVERT}"
        )
    reason = None
    if kind != "JPEG" and bands > max(4, colors):
        reason = f"{kind} of {bands} bands; convert it to a file of its red, green and blue band"
    elif kind in ("TIFF", "JPEG 2000") and alpha and colors == 1:
        reason = f"grey {kind} with an alpha channel; {_CONVERT}"
    elif kind == "TIFF" and colors == 4 and (bits != 8 or bands > 4):
        reason = f"CMYK {kind} of {bits} bits and {bands} bands; {_CONVERT}"
    elif alpha and _is_misread(header):
        reason = f"{kind} of 16 bits with an alpha channel and separate bands; {_CONVERT}"
    elif kind == "TIFF" and alpha and bits not in (8, 16):
        reason = f"{kind} of {bits} bits with an alpha channel; {_CONVERT}"
    elif kind == "JPEG" and bits != 8:
        reason = f"JPEG of {bits} bits; convert it to JPEG of 8 bits"
    if reason is not None:
        raise ValueError(f"{name}: not supported: {reason}")


def _is_misread(header: dict[str, Any]) -> bool:
    """Tell whether OpenCV takes the bands of a TIFF, each stored on its own, for those of one pixel."""
    bands = header["colors"] + header["extras"] + bool(header["alpha"])
    return bool(header["is_planar"]) and header["bits"] == 16 and bands > 1


_quiet_lock = threading.Lock()
_quiet_count, _loud = 0, 0


@contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV from writing to the terminal; our messages name the file and the reason.

    Within another such context it costs nothing.
    """
    global _quiet_count, _loud
    log = cv2.utils.logging
    with _quiet_lock:
        if _quiet_count == 0:
            _loud = log.setLogLevel(log.LOG_LEVEL_SILENT)
        _quiet_count += 1
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_count -= 1
            if _quiet_count == 0:
                log.setLogLevel(_loud)


def _imdecode(file: ImageFile, flags: int) -> npt.NDArray[Any]:
    name, data, header = file
    if header["format"] == "TIFF":
        data = native.tiff_as_stored(data, os.fsencode(name))
    try:
        with quiet():
            pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"{name}: cannot be decoded: {error}") from error
    if pixels is None:
        kind = header["format"]
        reader = f", or a {kind} that OpenCV {cv2.__version__} does not read" if kind else ""
        raise ValueError(f"{name}: cannot be decoded (damaged, truncated or not an image{reader})")
    if flags == cv2.IMREAD_UNCHANGED and pixels.ndim == 2 and header["transparent_grey"] is not None:
        # One grey value of a PNG is transparent, which OpenCV ignores.
        full, bits, value = int(_full(pixels, header)), header["bits"], header["transparent_grey"]
        stored = value * (full // ((1 << bits) - 1)) if bits < 8 else value
        alpha = np.where(pixels == stored, 0, full).astype(pixels.dtype)
        pixels = np.stack([pixels, pixels, pixels, alpha], axis=2)
    return np.asarray(pixels)


def read_whole(path: Path) -> ImageFile:
    """Return an image file; refuse it if a decoder would conceal its damage.

    Decoders show the lost part of a JPEG as grey, without an error, so the codes of the file are walked.
    Damage that leaves a valid sequence of codes (most changes of a single bit) cannot be detected. The
    checksums of a PNG are compared, because decoders complain of them on the terminal. ValueError names the
    file, the byte offset and the reason.
    """
    name = str(path)
    data, header = native.read_image_file(name)
    return described(data, name, header)


def decode_rgb(
    file: ImageFile, background: tuple[float, float, float] | None = None, place: UInt8 | None = None
) -> UInt8:
    """Decode to RGB uint8 [H, W, 3] as stored (EXIF orientation not applied).

    If the file says that it has alpha, colours are composited over `background` (0 to 1); None: they are used
    as they are stored. The result is in `place`, if it fits there. ValueError: the file cannot be decoded, or
    is of a kind that is not supported.
    """
    _check_supported(file)
    header = file.header
    if background is not None and header["alpha"]:
        pixels = _imdecode(file, cv2.IMREAD_UNCHANGED)
        if pixels.ndim == 3 and pixels.shape[2] == 4:
            return _over(pixels, background, _full(pixels, header), header["alpha"] == "associated")
    pixels = _imdecode(file, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if place is None or place.shape != pixels.shape:
        place = np.empty_like(pixels)  # OpenCV would take the GIL once more to make it
    cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB, place)
    return place


def check_photograph(path: Path) -> bool:
    """Check that a photograph can be decoded, and tell whether some pixel is not fully transparent.

    JPEG and PNG files without alpha are not decoded: `read_whole` finds their damage. ValueError: the file is
    damaged or not supported; names it.
    """
    file = read_whole(path)
    _check_supported(file)
    header = file.header
    if header["format"] in ("JPEG", "PNG") and not header["alpha"]:
        return True
    alpha = _alpha(_imdecode(file, cv2.IMREAD_UNCHANGED), header)
    return alpha is None or bool(alpha.any())


def is_opaque(path: Path) -> bool:
    """Tell whether every pixel of a photograph is opaque. ValueError: it cannot be decoded."""
    file = read_whole(path)
    if not file.header["alpha"]:
        return True
    pixels = _imdecode(file, cv2.IMREAD_UNCHANGED)
    alpha = _alpha(pixels, file.header)
    return alpha is None or bool((alpha >= _full(pixels, file.header)).all())


def _alpha(pixels: npt.NDArray[Any], header: dict[str, Any]) -> npt.NDArray[Any] | None:
    """Return the alpha of decoded pixels, [H, W]; None: the file does not say that a band is alpha."""
    return pixels[..., 3] if header["alpha"] and pixels.ndim == 3 and pixels.shape[2] == 4 else None


def _full(pixels: npt.NDArray[Any], header: dict[str, Any]) -> float:
    """Return the number that stands for white or opaque."""
    if pixels.dtype.kind == "f":
        return 1.0
    # Samples of 10 or 12 bits are decoded to 16 bits as they are.
    if pixels.dtype == np.uint16 and header["format"] in ("AVIF", "JPEG 2000"):
        return float((1 << header["bits"]) - 1)
    return float(np.iinfo(pixels.dtype).max)


def _over(
    bgra: npt.NDArray[Any], background: tuple[float, float, float], full: float, associated: bool
) -> UInt8:
    """Composite over a colour: rgb a + background (1 - a), where associated colours have the factor a."""
    alpha = bgra[..., 3:].astype(np.float32) / full
    rgb = bgra[..., 2::-1].astype(np.float32) / full
    if not associated:
        rgb *= alpha
    blended = rgb + np.asarray(background, dtype=np.float32) * (1 - alpha)
    return np.asarray((np.minimum(blended, 1) * 255 + 0.5).astype(np.uint8))


def decode_mask(file: ImageFile) -> UInt8:
    """Decode a mask to uint8 [H, W]: 0 where the file is black or transparent (excluded), 1 elsewhere.

    Numbers and colours may be labels, so of a lossless file only black is black; but a file of nothing else
    than nearly black and nearly white pixels has no labels. In a lossy file all darker than half its
    brightest pixel is black. If all colours are black, the transparent pixels are the excluded ones.
    """
    name, header = file.name, file.header
    if not header["supported"]:
        raise ValueError(f"{name}: not supported: {header['format']}; {_CONVERT}")
    if _is_misread(header):
        raise ValueError(f"{name}: not supported: TIFF of 16 bits with separate bands; {_CONVERT}")
    # Labels may be small numbers of 16 bits or dark colours: a conversion to 8 bits or to grey would make
    # them black.
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = _imdecode(file, cv2.IMREAD_UNCHANGED if header["alpha"] else flags)
    full = _full(pixels, header)
    if header["is_white_zero"] and pixels.dtype == np.uint16:  # which OpenCV turns round for 8 bits only
        pixels = np.asarray(np.iinfo(np.uint16).max - pixels)
    alpha = _alpha(pixels, header)
    opaque = None if alpha is None else alpha * 2.0 >= full
    if pixels.ndim == 3:
        pixels = pixels[..., :3].max(axis=2)
    counted = pixels > _black(pixels, full, header["is_lossy"])
    if opaque is not None:
        counted = counted & opaque if counted.any() or opaque.all() else opaque
    return np.asarray(counted.astype(np.uint8))


def _black(pixels: npt.NDArray[Any], full: float, is_lossy: bool) -> float:
    """Return the brightest value of a mask that stands for black."""
    if is_lossy:
        return max(float(pixels.max()), _LEAST_WHITE * full) / 2
    dark, bright = pixels <= _NEARLY * full, pixels >= (1 - _NEARLY) * full
    return full / 2 if bright.any() and bool((dark | bright).all()) else 0.0


def apply_orientation(pixels: UInt8, orientation: int) -> UInt8:
    """Turn stored pixels [H, W, ...] upright by the EXIF orientation (1 to 8)."""
    if orientation >= 5:
        pixels = np.asarray(cv2.transpose(pixels))
    axis = {2: 1, 3: -1, 4: 0, 6: 1, 7: -1, 8: 0}.get(orientation)
    return pixels if axis is None else np.asarray(cv2.flip(pixels, axis))


def reduced(pixels: UInt8, mask: UInt8 | None, factor: int) -> UInt8:
    """Return the mean colours of squares of `factor` x `factor` pixels (16 at most), rounded.

    The rest of a width or height that does not divide is cut off on the right and below, so that the pinhole
    of the result has the same intrinsics divided by `factor`. A mean is that of the pixels that count (`mask`
    is not 0), or 0 where none does. Pixels are [H, W, 3], or [H, W] without a mask.
    """
    width, height = pixels.shape[1] // factor, pixels.shape[0] // factor
    pixels = pixels[: height * factor, : width * factor]
    if mask is None:
        return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    # In float32, these sums are exact.
    counted = (mask[: height * factor, : width * factor] != 0).astype(np.float32)
    share = cv2.resize(counted, (width, height), interpolation=cv2.INTER_AREA)
    sums = cv2.resize(pixels * counted[..., None], (width, height), interpolation=cv2.INTER_AREA)
    return np.rint(sums / np.maximum(share, factor**-2)[..., None]).astype(np.uint8)


def reduced_mask(mask: UInt8, factor: int) -> UInt8:
    """Return which squares of `factor` x `factor` pixels count, 0 or 1: at least half of their pixels do."""
    height, width = mask.shape[0] // factor, mask.shape[1] // factor
    squares = (mask[: height * factor, : width * factor] != 0).reshape(height, factor, width, factor)
    return (2 * squares.sum((1, 3)) >= factor**2).astype(np.uint8)
