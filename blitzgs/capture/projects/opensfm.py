# SPDX-License-Identifier: Apache-2.0
"""reconstruction.json of OpenSfM and OpenDroneMap.

Conventions (OpenSfM's documentation on geometric models and on reconstructions; ODM's folders):

- rotation is an angle-axis vector, and x_camera = R x + t with x right, y down, z forward.
- Lengths are shares of the longer side; the origin of pixels is the centre of the image, with half a pixel
  accounted for, so c_x = c_y = 0 is the middle of width and height here.
- perspective has k1, k2; brown adds k3, p1, p2 with OpenCV's meaning; fisheye and fisheye_opencv are
  equidistant with k1, k2 (k3, k4).
- The world is x east, y north, z up at reference_lla. OpenDroneMap replaces it by UTM minus the offset of
  odm_georeferencing/coords.txt, through an affine map, and keeps the original in
  reconstruction.topocentric.json, which is read instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blitzgs.capture.fields import entry, image_size, number, numbers, read_json, read_small
from blitzgs.capture.lens import Lens
from blitzgs.capture.points import SourcePoints
from blitzgs.capture.projects import Project, ProjectView, made_lens
from blitzgs.capture.world import WorldFrame, enu_frame, utm_of_text
from blitzgs.util.errors import WRONG_CONTENT, located

NAME, ORIGINAL = "reconstruction.json", "reconstruction.topocentric.json"
_MODELS = {
    "perspective": ("BROWN", ("k1", "k2")),
    "simple_radial": ("BROWN", ("k1",)),
    "radial": ("BROWN", ("k1", "k2")),
    "brown": ("BROWN", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


def read_opensfm(path: Path) -> Project:
    """Read the largest reconstruction of a file."""
    content = read_json(path)
    if not isinstance(content, list) or not all(isinstance(part, Mapping) for part in content) or not content:
        raise ValueError("expected a list of reconstructions; run OpenSfM again")
    counts = [len(entry(part, "shots", dict)) for part in content]
    best = content[int(np.argmax(counts))]
    notes = []
    if len(content) > 1:
        notes.append(
            f"of {len(content)} reconstructions, the largest is used: {max(counts)} of {sum(counts)} shots"
        )
    lenses: dict[str, Lens] = {}
    for key, camera in entry(best, "cameras", dict).items():
        with located(f"camera {key!r:.60}"):
            lenses[key] = _lens(camera)
    views = []
    for name, shot in best["shots"].items():
        with located(f"shot {name!r:.60}"):
            key = entry(shot, "camera", str)
            if key not in lenses:
                raise ValueError(f"its camera {key!r:.60} is not there")
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(numbers(shot, "rotation", 3))[0]
            pose[:3, 3] = numbers(shot, "translation", 3)
        views.append(ProjectView(name, lenses[key], pose))
    return Project(views, _points(best, path), _frame(path, best), sum(counts) - max(counts), notes)


def _lens(camera: Any) -> Lens:
    kind = entry(camera, "projection_type", str)
    if kind not in _MODELS:
        raise ValueError(f"projection_type {kind!r:.30} cannot be read; known: {', '.join(_MODELS)}")
    model, known = _MODELS[kind]
    width, height = size = image_size(camera)
    side = max(width, height)
    fx = number(camera, "focal_x" if "focal_x" in camera else "focal")
    fy = number(camera, "focal_y", fx)
    cx, cy = (number(camera, key, 0.0) for key in ("c_x", "c_y"))
    k = {key: number(camera, key, 0.0) for key in known}
    head = (fx * side, fy * side, width / 2 + cx * side, height / 2 + cy * side)
    last = ("p1", "p2", "skew") if model == "BROWN" else ()
    return made_lens(model, size, *head, *(k.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", *last)))


def _points(part: Mapping[str, Any], path: Path) -> SourcePoints:
    try:
        points = [p for p in (part.get("points") or {}).values() if isinstance(p, Mapping)]
        positions = np.array([p["coordinates"] for p in points], dtype=np.float64).reshape(len(points), 3)
        colors = np.array([p.get("color", (128, 128, 128)) for p in points], dtype=np.float64)
        colors = np.clip(np.nan_to_num(colors.reshape(len(points), 3)), 0, 255)
    except WRONG_CONTENT as error:
        raise ValueError(f"points: expected three coordinates and colours each ({error})") from error
    return SourcePoints(positions, colors.astype(np.uint8), path=path, colors_from="the points' own colours")


def _frame(path: Path, part: Mapping[str, Any]) -> WorldFrame | None:
    coords = path.parent.parent / "odm_georeferencing" / "coords.txt"
    if path.name == NAME and coords.is_file():
        return _odm_offset(coords)
    beside = path.with_name("reference_lla.json")
    source = beside.name if beside.is_file() else path.name
    with located(source):
        reference = read_json(beside) if beside.is_file() else part.get("reference_lla")
        if not isinstance(reference, Mapping):
            return None
        place = [number(reference, key) for key in ("latitude", "longitude", "altitude")]
    return enu_frame(place[0], place[1], place[2], source)


def _odm_offset(path: Path) -> WorldFrame:
    """Read the offset of OpenDroneMap, for example "WGS84 UTM 33N" and "324190 6006088"."""
    lines = read_small(path).splitlines()[:2]
    crs = utm_of_text(lines[0]) if len(lines) == 2 else ""
    if not crs:
        raise ValueError(f"{path}: line 1: expected a zone such as 'WGS84 UTM 33N'; run OpenDroneMap again")
    try:
        east, north = (float(word) for word in lines[1].split()[:2])
    except ValueError as error:
        raise ValueError(f"{path}: line 2: expected east and north, got {lines[1]!r:.40}") from error
    return WorldFrame(crs, translation=np.array([east, north, 0.0]), source="coords.txt of OpenDroneMap")
