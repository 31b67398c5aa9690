# SPDX-License-Identifier: Apache-2.0
"""Writes image files of kinds that encoders do not write: bands, depths and marks of alpha as one likes."""

import struct
import zlib

import numpy as np


def tiff(pixels: np.ndarray, extra=None, photometric=None, order="<", big=False, bits=None, **tags) -> bytes:
    """An uncompressed TIFF of [H, W, bands]. `extra`: its ExtraSamples (0 unspecified, 1 associated,
    2 unassociated alpha), a number or a list; None: no such tag. `tags`: further ones, as t254=1."""
    height, width, bands = pixels.shape
    data = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    kind = {"u": 1, "i": 2, "f": 3}[pixels.dtype.kind]
    depth = bits or 8 * pixels.itemsize
    photometric = photometric if photometric is not None else 2 if bands >= 3 else 1
    start = 16 if big else 8
    fields = {256: (4, [width]), 257: (4, [height]), 258: (3, [depth] * bands), 259: (3, [1])}
    fields |= {262: (3, [photometric]), 273: (4, [start]), 277: (3, [bands]), 278: (4, [height])}
    fields |= {279: (4, [len(data)]), 284: (3, [1]), 339: (3, [kind] * bands)}
    if extra is not None:
        fields[338] = (3, extra if isinstance(extra, list) else [extra])
    fields |= {int(name[1:]): (3, [value]) for name, value in tags.items()}
    word, count, entry = ("Q", "Q", 20) if big else ("I", "H", 12)
    inline = struct.calcsize(order + word)
    at = start + len(data) + (len(data) % 2)
    tail_at = at + struct.calcsize(order + count) + entry * len(fields) + inline
    directory, tail = struct.pack(order + count, len(fields)), b""
    for tag, (type_, values) in sorted(fields.items()):
        raw = struct.pack(order + "HI"[type_ == 4] * len(values), *values)
        if len(raw) > inline:
            offset, tail = tail_at + len(tail), tail + raw + b"\0" * (len(raw) % 2)
            raw = struct.pack(order + word, offset)
        directory += struct.pack(order + "HH" + word, tag, type_, len(values)) + raw.ljust(inline, b"\0")
    magic = {"<": b"II", ">": b"MM"}[order]
    head = magic + (struct.pack(order + "HHHQ", 43, 8, 0, at) if big else struct.pack(order + "HI", 42, at))
    return head + data + b"\0" * (len(data) % 2) + directory + struct.pack(order + word, 0) + tail


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(pixels: np.ndarray, kind: int, bits: int, transparent=b"", palette=b"") -> bytes:
    """A PNG of [H, W] or [H, W, bands] samples; `kind`: its colour type (0 grey, 2 RGB, 3 palette, ...)."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    if bits == 16:
        packed = [row.astype(">u2").tobytes() for row in rows]
    elif bits == 8:
        packed = [row.astype("u1").tobytes() for row in rows]
    else:
        planes = (rows[..., None] >> np.arange(bits - 1, -1, -1)) & 1
        packed = [np.packbits(row.reshape(-1).astype("u1")).tobytes() for row in planes]
    out = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0))
    out += chunk(b"PLTE", palette) if palette else b""
    out += chunk(b"tRNS", transparent) if transparent else b""
    return out + chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in packed))) + chunk(b"IEND", b"")
