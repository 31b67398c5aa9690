# SPDX-License-Identifier: Apache-2.0
"""Small captures and image files, also of kinds that encoders do not write, and the real captures."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from blitzgs.capture import colmap

pycolmap = pytest.importorskip("pycolmap")

ROOT = Path(__file__).resolve().parents[2]


def shared_data() -> Path | None:
    """Folder of the real captures: BLITZGS_SHARED_DATA, or shared/data beside the repository."""
    candidates = [os.environ.get("BLITZGS_SHARED_DATA", ""), ROOT.parent / "shared" / "data"]
    return next((Path(p) for p in candidates if p and Path(p).is_dir()), None)


def smooth_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    """RGB uint8 noise without fine detail, so that JPEG keeps it."""
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8 + 2, width // 8 + 2, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def write_image(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., ::-1])


def reconstruction(
    names: list[str], width: int, height: int, model: str = "PINHOLE", params: list[float] | None = None
) -> pycolmap.Reconstruction:
    """Cameras on a circle of radius 4 that look at 20 points with tracks around the origin."""
    rec = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 0.8 * width, width, height)
    if params is not None:
        camera.params = params
    rec.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (20, 3))
    for index, name in enumerate(names, start=1):
        angle = 2 * np.pi * index / max(len(names), 1)
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.5])
        pose = pycolmap.Rigid3d(np.hstack([r := look_at(center), (-r @ center)[:, None]]))
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(random.uniform(0, 50, 2)) for _ in points])
        rec.add_image_with_trivial_frame(image, pose)
    for k, xyz in enumerate(points):
        elements = [pycolmap.TrackElement(i, k) for i in range(1, len(names) + 1) if (i + k) % 3 or k == 0]
        rec.add_point3D(xyz, pycolmap.Track(elements), random.integers(0, 256, 3).astype(np.uint8))
    return rec


def look_at(center: np.ndarray) -> np.ndarray:
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def write_capture(root: Path, names: list[str], width: int = 64, height: int = 48, **camera: object) -> Path:
    """A COLMAP capture with an image file for each name."""
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    reconstruction(names, width, height, **camera).write_binary(str(sparse))
    for seed, name in enumerate(names):
        write_image(root / "images" / name, smooth_image(height, width, seed))
    return root


def edit_model(root, change):
    """Read the COLMAP model of a capture, let `change` alter it, and write it back."""
    folder = root / "sparse" / "0"
    model = colmap.read_model(folder, points2d=True, tracks=True)
    change(model)
    colmap.write_model(folder, model)


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
