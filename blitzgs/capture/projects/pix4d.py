# SPDX-License-Identifier: Apache-2.0
"""Cameras of Pix4D: Pix4Dmapper's parameter files, and projects in the Open Photogrammetry Format (OPF).

Conventions of *_calibrated_camera_parameters.txt in the folder params (Pix4D support, "How are the Internal
and External Camera Parameters defined"; the file's header):

- m = K [R | -R t] X: R is world to camera with x right, y down, z forward; t is the camera's position.
- (0, 0) is the corner of the first pixel. Radial R1 to R3 and tangential T1, T2 are as in OpenCV.
- *_offset.xyz is added to the coordinates to get those of the reference system in *_wkt.prj.

Conventions of project.opf and the JSON files that it names (github.com/Pix4D/opf-spec, version 1.0):

- orientation_deg is omega, phi, kappa: Rx(omega) Ry(phi) Rz(kappa) maps the image's axes right, up and
  backwards to the world.
- Positions are in the processing frame: swapped(base * scale) + shift.
- Pixels and coefficients are as above. A fisheye is a polynomial of all powers of the angle to the axis,
  which no lens here has: it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.lens import Lens
from blitzgs.capture.projects import (
    Project,
    ProjectView,
    entry,
    made_lens,
    number,
    numbers,
    pose_of,
    read_json,
    read_text,
    size_of,
)
from blitzgs.capture.world import WorldFrame, read_offset

SUFFIX = "_calibrated_camera_parameters.txt"
# Lines of a camera: name and size, K, radial, tangential, position, R.
_LINES = 10


def read_pix4d(path: Path) -> Project:
    """Read the cameras of a parameter file, with the offset and reference system beside it."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    begin = next((i for i, line in enumerate(lines) if line.startswith("camera model")), None)
    if begin is None:
        raise ValueError(f"{path}: no header that ends in 'camera model ...'; export it again")
    kept = [(number, line) for number, line in enumerate(lines[begin + 1 :], start=begin + 2) if line]
    if len(kept) % _LINES:
        raise ValueError(f"{path}: {len(kept)} lines are not {_LINES} for each camera: it is cut off")
    views = []
    for first in range(0, len(kept), _LINES):
        place, head = kept[first]
        where = f"{path}: line {place}"
        words = head.rsplit(maxsplit=2)
        if len(words) != 3:
            raise ValueError(f"{where}: expected a name, a width and a height, got {head!r:.60}")
        width, height = size_of(words[1], words[2], where)
        rows = [
            numbers(line, count, f"{path}: line {number}")
            for (number, line), count in zip(
                kept[first + 1 : first + _LINES], (3, 3, 3, 3, 2, 3, 3, 3, 3), strict=True
            )
        ]
        k, radial, tangential, position, rotation = rows[:3], rows[3], rows[4], rows[5], np.stack(rows[6:])
        fx, skew, cx = k[0]
        _, fy, cy = k[1]
        lens = made_lens(
            where, "BROWN", width, height, fx, fy, cx, cy, *radial, 0.0, *tangential, skew / fx if fx else 0.0
        )
        views.append(ProjectView(words[0], lens, pose_of(rotation.T, position, where)))
    return Project(views, None, _frame(path))


def _frame(path: Path) -> WorldFrame | None:
    stem = path.name.removesuffix(SUFFIX)
    offset, prj = path.with_name(f"{stem}_offset.xyz"), path.with_name(f"{stem}_wkt.prj")
    return read_offset(offset, [prj] if prj.is_file() else []) if offset.is_file() else None


def read_opf(path: Path) -> Project:
    """Read the calibrated cameras of a project."""
    files = _resources(path)
    content = {
        kind: _content(path, files, kind) for kind in ("calibrated-cameras", "input-cameras", "camera-list")
    }
    calibrated = content["calibrated-cameras"]
    where = str(files["calibrated-cameras"])
    listed = content["camera-list"]
    names = {entry(c, "id", int, str(files["camera-list"])): c for c in _list(listed, "cameras", path)}
    sizes = {
        entry(sensor, "id", int, str(files["input-cameras"])): sensor
        for sensor in _list(content["input-cameras"], "sensors", path)
    }
    lenses: dict[int, Lens] = {}
    for sensor in _list(calibrated, "sensors", path):
        key = entry(sensor, "id", int, where)
        if key not in sizes:
            raise ValueError(f"{where}: the sensor {key} is not in {files['input-cameras'].name}")
        size = numbers(
            sizes[key].get("image_size_px"), 2, f"{files['input-cameras']}: sensor {key}: image_size_px"
        )
        lenses[key] = _lens(sensor, *size_of(size[0], size[1], where), f"{where}: sensor {key}")
    views = []
    for camera in _list(calibrated, "cameras", path):
        key = entry(camera, "id", int, where)
        at = f"{where}: camera {key}"
        sensor_id = entry(camera, "sensor_id", int, at)
        if sensor_id not in lenses or key not in names:
            raise ValueError(f"{at}: its sensor {sensor_id} or its photograph is not in the project's lists")
        rotation = _rotation(numbers(camera.get("orientation_deg"), 3, f"{at}: orientation_deg"))
        position = numbers(camera.get("position"), 3, f"{at}: position")
        name = _photograph(entry(names[key], "uri", str, at))
        views.append(ProjectView(name, lenses[sensor_id], pose_of(rotation, position, at)))
    rolls = any("rolling_shutter" in camera for camera in calibrated["cameras"])
    notes = ["the rolling shutter is not modelled"] if rolls else []
    lost = sum(len(_list(c, "cameras", path)) for c in _list(content["input-cameras"], "captures", path))
    return Project(views, None, _opf_frame(path, files), max(0, lost - len(views)), notes)


def _resources(path: Path) -> dict[str, Path]:
    """Return the first file of each kind that a project names."""
    files: dict[str, Path] = {}
    for item in _list(read_json(path), "items", path):
        for resource in _list(item, "resources", path):
            uri, kind = entry(resource, "uri", str, str(path)), entry(resource, "format", str, str(path))
            name = kind.removeprefix("application/opf-").removesuffix("+json")
            file = path.parent / unquote(urlparse(uri).path)
            if not file.resolve().is_relative_to(path.parent.resolve()):
                raise ValueError(f"{path}: {uri!r:.80} leads outside the project: put the file beside it")
            files.setdefault(name, file)
    return files


def _content(path: Path, files: Mapping[str, Path], kind: str) -> Any:
    if kind not in files:
        raise ValueError(
            f"{path}: the project has no application/opf-{kind}+json: export it after the calibration"
        )
    return read_json(files[kind])


def _list(content: Any, key: str, path: Path) -> list[Any]:
    found: list[Any] = entry(content, key, list, str(path))
    return found


def _photograph(uri: str) -> str:
    """Return the name of a photograph; only its last part if it is a path of the machine that wrote it."""
    parsed = urlparse(uri)
    name = unquote(parsed.path).replace("\\", "/")
    absolute = bool(parsed.scheme) or name.startswith("/")
    return name.rpartition("/")[2] if absolute else name


def _rotation(degrees: Float64) -> Float64:
    """Return camera to world for axes right, down, forward."""
    (so, sp, sk), (co, cp, ck) = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z * [1, -1, -1])


def _lens(sensor: Any, width: int, height: int, where: str) -> Lens:
    internals = entry(sensor, "internals", dict, where)
    kind = entry(internals, "type", str, where)
    if kind != "perspective":
        raise ValueError(f"{where}: {kind!r:.20} cameras cannot be read: export undistorted images instead")
    f = number(internals.get("focal_length_px"), f"{where}: focal_length_px")
    cx, cy = numbers(internals.get("principal_point_px"), 2, f"{where}: principal_point_px")
    radial = numbers(internals.get("radial_distortion"), 3, f"{where}: radial_distortion")
    tangential = numbers(internals.get("tangential_distortion"), 2, f"{where}: tangential_distortion")
    return made_lens(where, "BROWN", width, height, f, f, cx, cy, *radial, 0.0, *tangential, 0.0)


def _opf_frame(path: Path, files: Mapping[str, Path]) -> WorldFrame | None:
    """Return the similarity from the processing frame to the project's reference system."""
    if "scene-reference-frame" not in files:
        return None
    file = files["scene-reference-frame"]
    content = read_json(file)
    crs = entry(entry(content, "crs", dict, str(file)), "definition", str, str(file))
    transform = entry(content, "base_to_canonical", dict, str(file))
    shift, scale = (numbers(transform.get(key), 3, f"{file}: {key}") for key in ("shift", "scale"))
    if transform.get("swap_xy") or not np.allclose(scale, scale[0], rtol=1e-9):
        # Mirrored axes and heights in another unit are no similarity; the canonical frame is one.
        return WorldFrame(translation=-shift, source=f"{file.name}, with x east and y north in metres")
    return WorldFrame(crs, 1 / scale[0], np.eye(3), -shift / scale[0], file.name)
