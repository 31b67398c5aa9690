# SPDX-License-Identifier: Apache-2.0
"""Writes one posed capture as the files of photogrammetry programs, from their documentation alone.

The capture is the plain camera of OpenCV: x_camera = R x + t, right, down, forward; (0, 0) is the corner of
the first pixel. `cv2.projectPoints` is the reference for its pixels.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.capture.helpers import look_at, smooth_image, write_image

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
        self.rotations = [turn @ look_at(place) for turn, place in zip(turns, places, strict=True)]
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
