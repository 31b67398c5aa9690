# SPDX-License-Identifier: Apache-2.0
"""Small captures, image files of all kinds, and one posed capture as the files of photogrammetry programs."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import plyfile
import pytest
from scipy.spatial.transform import Rotation

from blitzgs.capture import colmap
from tests.helpers import look_at_origin

pycolmap = pytest.importorskip("pycolmap")

ROOT = Path(__file__).resolve().parents[2]


def shared_data() -> Path | None:
    """Folder of the real captures: BLITZGS_SHARED_DATA, or shared/data beside the repository."""
    candidates = [os.environ.get("BLITZGS_SHARED_DATA", ""), ROOT.parent / "shared" / "data"]
    return next((Path(p) for p in candidates if p and Path(p).is_dir()), None)


def warned(text: str, call: Callable, /, *given: object, **named: object) -> Any:
    """Check that a call warns with a text that the regular expression matches; return its result."""
    with pytest.warns(UserWarning, match=text):
        return call(*given, **named)


def smooth_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    """RGB uint8 noise without fine detail, so that JPEG keeps it."""
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8 + 2, width // 8 + 2, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def write_image(path: Path, pixels: np.ndarray, *flags: int) -> None:
    """Write RGB [H, W, 3] or grey [H, W], with OpenCV's flags."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels if pixels.ndim == 2 else pixels[..., ::-1], flags)


def reconstruction(
    names: list[str],
    width: int,
    height: int,
    model: str = "PINHOLE",
    params: list[float] | None = None,
    around: int = 0,
) -> pycolmap.Reconstruction:
    """Cameras on a circle of radius 4 that look at 20 points with tracks around the origin.

    `around`: the number of cameras that the circle has room for; 0: as many as there are.
    """
    rec = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 0.8 * width, width, height)
    if params is not None:
        camera.params = params
    rec.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (20, 3))
    for index, name in enumerate(names, start=1):
        angle = 2 * np.pi * index / (around or max(len(names), 1))
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.5])
        pose = pycolmap.Rigid3d(look_at_origin(center)[:3])
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(random.uniform(0, 50, 2)) for _ in points])
        rec.add_image_with_trivial_frame(image, pose)
    for k, xyz in enumerate(points):
        elements = [pycolmap.TrackElement(i, k) for i in range(1, len(names) + 1) if (i + k) % 3 or k == 0]
        rec.add_point3D(xyz, pycolmap.Track(elements), random.integers(0, 256, 3).astype(np.uint8))
    return rec


def write_capture(root: Path, names: list[str], width: int = 64, height: int = 48, **camera: object) -> Path:
    """A COLMAP capture with an image file for each name."""
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    reconstruction(names, width, height, **camera).write_binary(str(sparse))
    for seed, name in enumerate(names):
        write_image(root / "images" / name, smooth_image(height, width, seed))
    return root


def frame(name: str, pose: np.ndarray | None = None, **fields: object) -> dict:
    """A frame of transforms.json; its pose is the identity by default."""
    return {"file_path": name, "transform_matrix": (np.eye(4) if pose is None else pose).tolist(), **fields}


def at(*place: float) -> np.ndarray:
    """The pose [4, 4] of a frame of transforms.json that looks along -z from a place."""
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def write_transforms(root: Path, frames: list, file: str = "transforms.json", **fields: object) -> Path:
    """Write frames, and fields of the root."""
    root.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(json.dumps({**fields, "frames": frames}))
    return root / file


RGB = ("red", "green", "blue")


def write_ply(path: Path, positions, values=None, names=RGB, kind: str = "u1", axes: str = "xyz") -> Path:
    """Write points, and columns of numbers of this kind [N, len(names)] if there are some."""
    columns = [(axis, "f8") for axis in axes] + [(name, kind) for name in names if values is not None]
    rows = np.zeros(len(positions), columns)
    table = positions if values is None else np.hstack([positions, values])
    for (name, _), column in zip(columns, np.transpose(table), strict=True):
        rows[name] = column
    path.parent.mkdir(parents=True, exist_ok=True)
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(path)
    return path


def as_text(folder: Path) -> None:
    """Replace the binary files of a COLMAP model by text."""
    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    for path in folder.glob("*.bin"):
        path.unlink()


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


WIDTH, HEIGHT = 96, 72


@dataclass
class Posed:
    """Six oblique views of 40 points around `origin`."""

    fx: float = 81.5
    fy: float = 81.5
    cx: float = 49.25
    cy: float = 34.6
    k: tuple = (-0.11, 0.031, -0.006)
    p: tuple = (0.0021, -0.0034)
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    names: list = field(default_factory=lambda: [f"DJI_{i:04d}.JPG" for i in range(6)])

    def __post_init__(self):
        random = np.random.default_rng(4)
        turns = Rotation.from_euler("xyz", random.uniform(-8, 8, (6, 3)), degrees=True).as_matrix()
        places = np.array([[4 * np.cos(a), 4 * np.sin(a), 3 + 0.3 * a] for a in np.arange(6) * 1.1])
        self.rotations = [
            turn @ look_at_origin(place)[:3, :3] for turn, place in zip(turns, places, strict=True)
        ]
        self.centres = places + self.origin
        self.points = random.uniform(-0.8, 0.8, (40, 3)) + self.origin
        self.colors = random.integers(0, 256, (40, 3))

    def pixels(self, index: int) -> np.ndarray:
        k = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        local = (self.points - self.centres[index]) @ self.rotations[index].T
        distortion = np.array([*self.k[:2], *self.p, *self.k[2:]])
        return cv2.projectPoints(local, np.zeros(3), np.zeros(3), k, distortion)[0][:, 0]

    def write_images(self, root: Path) -> Path:
        for seed, name in enumerate(self.names):
            write_image(root / "images" / name, smooth_image(HEIGHT, WIDTH, seed))
        return root


def metashape(capture: Posed, path: Path, labels=None, sensor_type="frame", k4=0.0, b1=0.0, b2=0.0):
    """Cameras XML in coordinates of a chunk that lies askew in the world."""
    chunk = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
    scale, shift = 2.5, capture.origin + [3.0, -2.0, 5.0]  # world = scale * chunk @ x + shift
    cameras = ""
    for i, name in enumerate(labels or [Path(name).stem for name in capture.names]):
        matrix = np.eye(4)
        matrix[:3, :3] = chunk.T @ capture.rotations[i].T
        matrix[:3, 3] = chunk.T @ (capture.centres[i] - shift) / scale
        cameras += f'<camera id="{i}" sensor_id="7" component_id="2" label="{name}"><transform>'
        cameras += " ".join(map(repr, matrix.ravel().tolist())) + "</transform></camera>\n"
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">
<sensor id="7" label="FC6310R" type="{sensor_type}"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="frame" class="initial"><f>1</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<f>{capture.fy}</f><cx>{capture.cx - WIDTH / 2}</cx><cy>{capture.cy - HEIGHT / 2}</cy>
<b1>{b1}</b1><b2>{b2}</b2>
<k1>{capture.k[0]}</k1><k2>{capture.k[1]}</k2><k3>{capture.k[2]}</k3><k4>{k4}</k4>
<p1>{capture.p[1]}</p1><p2>{capture.p[0]}</p2></calibration></sensor></sensors>
<components next_id="1" active_id="2"><component id="2" label="Component 1"><transform>
<rotation locked="false">{" ".join(map(repr, chunk.ravel().tolist()))}</rotation>
<translation locked="false">{" ".join(map(repr, shift.tolist()))}</translation>
<scale locked="false">{scale}</scale></transform></component></components>
<cameras next_id="6" next_group_id="0">{cameras}
<camera id="99" sensor_id="7" label="not_aligned"/></cameras>
<reference>GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]</reference></chunk></document>"""
    path.write_text(text)
    return chunk, scale, shift


def realitycapture(
    capture: Posed, path: Path, header="#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
):
    side = max(WIDTH, HEIGHT)
    lines = [f"#cameras {len(capture.names)}", header]
    for name, rotation, centre in zip(capture.names, capture.rotations, capture.centres, strict=True):
        right_up_back = rotation.T * [1, -1, -1]
        heading, pitch, roll = Rotation.from_matrix(right_up_back).as_euler("ZXY", degrees=True) * [-1, 1, 1]
        values = [*centre, heading, pitch, roll, capture.fx * 36 / side]
        values += [(capture.cx - WIDTH / 2) / side, (capture.cy - HEIGHT / 2) / side, *capture.k, 0.0]
        lines.append(",".join([name, *(repr(float(v)) for v in (*values, capture.p[1], capture.p[0]))]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")


def bundler(capture: Posed, path: Path):
    """Only f, k1 and k2, and the principal point in the middle."""
    flip = np.diag([1.0, -1.0, -1.0])
    lines = ["# Bundle file v0.3", f"{len(capture.names) + 1} {len(capture.points)}"]
    for rotation, centre in zip(capture.rotations, capture.centres, strict=True):
        r = flip @ rotation
        lines.append(f"{capture.fx!r} {capture.k[0]!r} {capture.k[1]!r}")
        lines += [" ".join(map(repr, row.tolist())) for row in (*r, -r @ centre)]
    lines += ["0 0 0"] * 5
    for point, color in zip(capture.points, capture.colors, strict=True):
        lines += [
            " ".join(map(repr, point.tolist())),
            " ".join(map(str, color)),
            "2 0 11 1.5 -2.5 1 12 0.5 3.5",
        ]
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "list.txt").write_text("\n".join([*capture.names, "lost.JPG"]) + "\n")


def pix4d(capture: Posed, folder: Path, offset):
    """A params folder whose coordinates are the world's minus an offset."""
    folder.mkdir(parents=True)
    text = "fileName imageWidth imageHeight \ncamera matrix K [3x3]\nradial distortion [3x1]\n"
    text += "tangential distortion [2x1]\ncamera position t [3x1]\ncamera rotation R [3x3]\n"
    text += "camera model m = K [R|-Rt] X\n\n"
    for name, rotation, centre in zip(capture.names, capture.rotations, capture.centres, strict=True):
        text += f"{name} {WIDTH} {HEIGHT}\n"
        text += f"{capture.fx!r} 0 {capture.cx!r}\n0 {capture.fy!r} {capture.cy!r}\n0 0 1\n"
        for row in (capture.k, capture.p, centre - offset, *rotation):
            text += " ".join(repr(float(v)) for v in row) + "\n"
    (folder / "site_calibrated_camera_parameters.txt").write_text(text)
    (folder / "site_offset.xyz").write_text(" ".join(f"{v:.3f}" for v in offset))
    (folder / "site_wkt.prj").write_text('PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84"]]')


def opf(capture: Posed, folder: Path, shift):
    """A calibrated project whose processing frame is the world plus a shift."""
    sensor = {"id": 5, "image_size_px": [WIDTH, HEIGHT], "name": "FC6310R"}
    internals = {"type": "perspective", "principal_point_px": [capture.cx, capture.cy],
                 "focal_length_px": capture.fx, "radial_distortion": list(capture.k),
                 "tangential_distortion": list(capture.p)}  # fmt: skip
    cameras = []
    for i, (rotation, centre) in enumerate(zip(capture.rotations, capture.centres, strict=True)):
        angles = Rotation.from_matrix(rotation.T * [1, -1, -1]).as_euler("XYZ", degrees=True)
        cameras.append({"id": 100 + i, "sensor_id": 5, "position": (centre + shift).tolist(),
                        "orientation_deg": angles.tolist()})  # fmt: skip
    transform = {"shift": list(shift), "scale": [1, 1, 1], "swap_xy": False}
    listed = [{"id": 100 + i, "uri": f"file:///c:/survey/{name}"} for i, name in enumerate(capture.names)]
    shots = [{"cameras": [{"id": 100 + i}]} for i in range(7)]
    files = {
        "camera-list": {"cameras": listed},
        "input-cameras": {"sensors": [sensor], "captures": shots},
        "calibrated-cameras": {"sensors": [{"id": 5, "internals": internals}], "cameras": cameras},
        "scene-reference-frame": {"crs": {"definition": "EPSG:32633"}, "base_to_canonical": transform},
    }
    items = []
    for kind, content in files.items():
        name = f"application/opf-{kind}+json"
        (folder / f"{kind} 1.json").write_text(json.dumps({"format": name, "version": "1.0", **content}))
        resource = {"uri": f"{kind}%201.json", "format": name}
        items.append({"id": kind, "type": kind.replace("-", "_"), "resources": [resource], "sources": []})
    (folder / "project.opf").write_text(
        json.dumps({"format": "application/opf-project+json", "items": items})
    )


def opensfm(capture: Posed, path: Path, lla=None):
    side = max(WIDTH, HEIGHT)
    camera = {"projection_type": "brown", "width": WIDTH, "height": HEIGHT, "focal_x": capture.fx / side,
              "focal_y": capture.fy / side, "c_x": (capture.cx - WIDTH / 2) / side,
              "c_y": (capture.cy - HEIGHT / 2) / side}  # fmt: skip
    camera |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (*capture.k, *capture.p), strict=True))
    shots = {
        name: {"camera": "v2 dji", "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(),
               "translation": (-rotation @ centre).tolist()}
        for name, rotation, centre in zip(capture.names, capture.rotations, capture.centres, strict=True)
    }  # fmt: skip
    points = {
        str(i): {"color": color.tolist(), "coordinates": point.tolist()}
        for i, (point, color) in enumerate(zip(capture.points, capture.colors, strict=True))
    }
    part = {"cameras": {"v2 dji": camera}, "shots": shots, "points": points}
    if lla is not None:
        part["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), lla, strict=True))
    small = {"cameras": {"v2 dji": camera}, "shots": {"other.JPG": shots[capture.names[0]]}, "points": {}}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([small, part]))
