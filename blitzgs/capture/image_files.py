# SPDX-License-Identifier: Apache-2.0
"""Reads size and orientation of image files from their headers, and decodes images; refuses damaged files."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.formats.native import native_io

UInt8 = npt.NDArray[np.uint8]

_HEADER_BYTES = 1 << 16
_EXIF_ORIENTATION = 0x0112
_TIFF_STARTS = (b"II*\0", b"MM\0*")
_TURNS: dict[int, tuple[int, ...]] = {3: (cv2.ROTATE_180,), 6: (cv2.ROTATE_90_CLOCKWISE,)}
_TURNS[8] = (cv2.ROTATE_90_COUNTERCLOCKWISE,)


@dataclass(frozen=True)
class ImageHeader:
    """The stored size (pixels), the EXIF orientation (1 to 8) and whether there is an alpha channel."""

    width: int
    height: int
    orientation: int = 1
    has_alpha: bool = False


def read_header(path: Path) -> ImageHeader:
    """Return size and orientation of an image file; JPEG and PNG files are not decoded.

    Raises:
        ValueError: the file is damaged or not an image; names it.
    """
    with path.open("rb") as file:
        data = file.read(_HEADER_BYTES)
        if data[:2] == b"\xff\xd8":
            try:
                header = _jpeg_header(data)
            except (EOFError, struct.error):  # the size follows a large preview or colour profile
                try:
                    header = _jpeg_header(data + file.read())
                except (EOFError, struct.error):
                    raise ValueError(f"{path}: truncated JPEG: the file ends inside its header") from None
            if header is None:
                raise ValueError(f"{path}: damaged JPEG: no size in its header")
            return header
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 26:
        width, height = struct.unpack(">II", data[16:24])
        # Palettes and single colours may be transparent too (the chunk tRNS, before the pixels).
        has_alpha = data[25] in (4, 6) or b"tRNS" in data.partition(b"IDAT")[0]
        return ImageHeader(width, height, has_alpha=has_alpha)
    data = path.read_bytes()
    pixels = _imdecode(data, cv2.IMREAD_UNCHANGED, str(path))
    orientation = _exif_orientation(data) if data[:4] in _TIFF_STARTS else 1
    has_alpha = pixels.ndim == 3 and pixels.shape[2] == 4
    return ImageHeader(pixels.shape[1], pixels.shape[0], orientation, has_alpha)


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and payload of each segment before the image data; EOFError if the bytes end earlier."""
    at = 2
    while True:
        if at + 4 > len(data):
            raise EOFError
        if data[at] != 0xFF:
            return
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if at + 2 + length > len(data):
            raise EOFError
        yield marker, data[at + 4 : at + 2 + length]
        if marker == 0xDA:
            return
        at += 2 + length


def _jpeg_header(data: bytes) -> ImageHeader | None:
    orientation = 1
    for marker, payload in _jpeg_segments(data):
        if marker == 0xE1 and payload[:6] == b"Exif\0\0":
            orientation = _exif_orientation(payload[6:])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", payload[1:5])
            return ImageHeader(width, height, orientation)
    return None


def _exif_orientation(tiff: bytes) -> int:
    """Return the orientation tag of the first directory; 1 if it is missing or invalid."""
    found = _orientation_field(tiff)
    return found[1] if found is not None and 1 <= found[1] <= 8 else 1


def _orientation_field(tiff: bytes) -> tuple[slice, int] | None:
    """Return the two bytes of the orientation tag in the first directory, and its value; None: no tag."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    try:
        (at,) = struct.unpack(order + "I", tiff[4:8])
        (entries,) = struct.unpack(order + "H", tiff[at : at + 2])
        for entry in range(at + 2, at + 2 + 12 * entries, 12):
            tag, _, _, value = struct.unpack(order + "HHIH", tiff[entry : entry + 10])
            if tag == _EXIF_ORIENTATION:
                return slice(entry + 8, entry + 10), value
    except struct.error:
        pass
    return None


def _unturned(tiff: bytes) -> bytes:
    """Return a TIFF file without its orientation: OpenCV turns TIFF files by their tag whatever the flags."""
    found = _orientation_field(tiff)
    if found is None:
        return tiff
    field, _ = found
    upright = (1).to_bytes(2, "little" if tiff[:2] == b"II" else "big")
    return tiff[: field.start] + upright + tiff[field.stop :]


def _imdecode(data: bytes, flags: int, name: str) -> UInt8:
    if data[:4] in _TIFF_STARTS:
        data = _unturned(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error as error:
        raise ValueError(f"{name}: cannot be decoded: {error}") from error
    if pixels is None:
        raise ValueError(f"{name}: cannot be decoded (damaged, truncated or not an image)")
    return np.asarray(pixels)


def read_whole(path: Path) -> bytes:
    """Return the bytes of an image file; refuse a file if a decoder would conceal its damage.

    Decoders show the lost part of a JPEG as grey, without an error, so this function walks the codes of the
    file. Damage that leaves a valid sequence of codes (most changes of a single bit) cannot be detected.

    Raises:
        ValueError: the file is truncated or damaged; names it, the byte offset and the reason.
    """
    data = path.read_bytes()
    if data[:2] == b"\xff\xd8":
        native_io().check_jpeg(data, os.fsencode(path))
    return data


def decode_rgb(data: bytes, name: str, background: tuple[float, float, float] | None = None) -> UInt8:
    """Decode to RGB uint8 [H, W, 3] as stored (EXIF orientation not applied).

    Args:
        data: the file, from `read_whole`.
        name: names the file in errors.
        background: colour (0 to 1) over which an alpha channel is composited; None: drop the channel.

    Raises:
        ValueError: the file cannot be decoded.
    """
    if background is not None:
        pixels = _imdecode(data, cv2.IMREAD_UNCHANGED, name)
        if pixels.ndim == 3 and pixels.shape[2] == 4:
            if pixels.dtype.kind != "u":
                raise ValueError(f"{name}: pixels must be of 8 or 16 bits, got {pixels.dtype}")
            return _over(pixels, background)
    pixels = _imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, name)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))


def _over(bgra: npt.NDArray[np.uint8], background: tuple[float, float, float]) -> UInt8:
    full = float(np.iinfo(bgra.dtype).max)
    alpha = bgra[..., 3:].astype(np.float32) / full
    rgb = bgra[..., 2::-1].astype(np.float32) / full
    blended = rgb * alpha + np.asarray(background, dtype=np.float32) * (1 - alpha)
    return np.asarray((blended * 255 + 0.5).astype(np.uint8))


def decode_mask(data: bytes, name: str) -> UInt8:
    """Decode a mask to uint8 [H, W]: 0 where the file is black (excluded), 1 elsewhere.

    Raises:
        ValueError: the file cannot be decoded.
    """
    # Labels may be small numbers of 16 bits or dark colours: a conversion to 8 bits or to grey would make
    # them black.
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = _imdecode(data, flags, name)
    if pixels.ndim == 3:
        pixels = pixels.max(axis=2)
    return np.asarray((pixels > 0).astype(np.uint8))


def apply_orientation(pixels: UInt8, orientation: int) -> UInt8:
    """Turn stored pixels [H, W, ...] upright by the EXIF orientation (1 to 8)."""
    if orientation in (2, 5, 7):
        pixels = np.asarray(cv2.flip(pixels, 1))
        orientation = {2: 1, 5: 8, 7: 6}[orientation]
    elif orientation == 4:
        return np.asarray(cv2.flip(pixels, 0))
    for turn in _TURNS.get(orientation, ()):
        pixels = np.asarray(cv2.rotate(pixels, turn))
    return pixels
