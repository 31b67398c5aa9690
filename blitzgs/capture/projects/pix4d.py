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

from blitzgs.capture.cameras import pose_of
from blitzgs.capture.fields import entry, image_size, number, numbers, read_json, read_text
from blitzgs.capture.lens import Lens
from blitzgs.capture.projects import Project, ProjectView, made_lens, rotation_of, turn
from blitzgs.capture.world import WorldFrame, read_offset
from blitzgs.util.errors import located

SUFFIX = "_calibrated_camera_parameters.txt"
# Lines of a camera after the first one, which has its name and size.
_K, _R = ("K, row 1", "K, row 2", "K, row 3"), ("R, row 1", "R, row 2", "R, row 3")
_LINES = (*_K, "radial distortion", "tangential distortion", "camera position", *_R)
_DISTORTION = (("radial", 3), ("tangential", 2))


def read_pix4d(path: Path) -> Project:
    """Read the cameras of a parameter file, with the offset and reference system beside it."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    begin = next((i for i, line in enumerate(lines) if line.startswith("camera model")), None)
    if begin is None:
        raise ValueError("no header that ends in 'camera model ...'; export it again")
    kept = [(place, line) for place, line in enumerate(lines[begin + 1 :], start=begin + 2) if line]
    count = 1 + len(_LINES)
    if len(kept) % count:
        raise ValueError(f"{len(kept)} lines are not {count} for each camera: it is cut off")
    views = []
    for first in range(0, len(kept), count):
        place, head = kept[first]
        with located(f"line {place}"):
            words = head.rsplit(maxsplit=2)
            if len(words) != 3:
                raise ValueError(f"expected a name, a width and a height, got {head!r:.60}")
            rest = zip(_LINES, kept[first + 1 : first + count], strict=True)
            fields = {"width": words[1], "height": words[2], **{name: line for name, (_, line) in rest}}
            (fx, skew, cx), (_, fy, cy), _ = (numbers(fields, row, 3) for row in _K)
            radial, tangential = (numbers(fields, f"{kind} distortion", n) for kind, n in _DISTORTION)
            distortion = (*radial, 0.0, *tangential, skew / fx if fx else 0.0)
            lens = made_lens("BROWN", image_size(fields), fx, fy, cx, cy, *distortion)
            rotation = np.stack([numbers(fields, row, 3) for row in _R])
            pose = pose_of(rotation_of(rotation.T), numbers(fields, "camera position", 3))
        views.append(ProjectView(words[0], lens, pose))
    return Project(views, None, _frame(path))


def _frame(path: Path) -> WorldFrame | None:
    stem = path.name.removesuffix(SUFFIX)
    offset, prj = path.with_name(f"{stem}_offset.xyz"), path.with_name(f"{stem}_wkt.prj")
    return read_offset(offset, [prj] if prj.is_file() else []) if offset.is_file() else None


def read_opf(path: Path) -> Project:
    """Read the calibrated cameras of a project."""
    files = _resources(path)
    for kind in ("calibrated-cameras", "input-cameras", "camera-list"):
        if kind not in files:
            raise ValueError(
                f"the project has no application/opf-{kind}+json: export it after the calibration"
            )
    with located(files["camera-list"].name):
        listed = entry(read_json(files["camera-list"]), "cameras", list)
        names = {entry(camera, "id", int): _photograph(entry(camera, "uri", str)) for camera in listed}
    with located(files["input-cameras"].name):
        given = read_json(files["input-cameras"])
        sizes = {}
        for sensor in entry(given, "sensors", list):
            key = entry(sensor, "id", int)
            with located(f"sensor {key}"):
                side = numbers(sensor, "image_size_px", 2).tolist()
                sizes[key] = image_size({"width": side[0], "height": side[1]})
        shots = sum(len(entry(shot, "cameras", list)) for shot in entry(given, "captures", list))
    with located(files["calibrated-cameras"].name):
        calibrated = read_json(files["calibrated-cameras"])
        lenses = {}
        for sensor in entry(calibrated, "sensors", list):
            key = entry(sensor, "id", int)
            with located(f"sensor {key}"):
                if key not in sizes:
                    raise ValueError(f"it is not in {files['input-cameras'].name}")
                lenses[key] = _lens(sensor, sizes[key])
        views = []
        for camera in entry(calibrated, "cameras", list):
            key = entry(camera, "id", int)
            with located(f"camera {key}"):
                sensor = entry(camera, "sensor_id", int)
                if sensor not in lenses or key not in names:
                    raise ValueError(f"its sensor {sensor} or its photograph is not in the project's lists")
                omega, phi, kappa = numbers(camera, "orientation_deg", 3)
                # Of axes right, up and backwards; ours are right, down and forward.
                rotation = turn("x", omega) @ turn("y", phi) @ turn("z", kappa) * [1, -1, -1]
                pose = pose_of(rotation, numbers(camera, "position", 3))
            views.append(ProjectView(names[key], lenses[sensor], pose))
    rolls = any("rolling_shutter" in camera for camera in calibrated["cameras"])
    notes = ["the rolling shutter is not modelled"] if rolls else []
    return Project(views, None, _opf_frame(files), max(0, shots - len(views)), notes)


def _resources(path: Path) -> dict[str, Path]:
    """Return the first file of each kind that a project names."""
    files: dict[str, Path] = {}
    for item in entry(read_json(path), "items", list):
        for resource in entry(item, "resources", list):
            uri, kind = entry(resource, "uri", str), entry(resource, "format", str)
            name = kind.removeprefix("application/opf-").removesuffix("+json")
            file = path.parent / unquote(urlparse(uri).path)
            if not file.resolve().is_relative_to(path.parent.resolve()):
                raise ValueError(f"{uri!r:.80} leads outside the project: put the file beside it")
            files.setdefault(name, file)
    return files


def _photograph(uri: str) -> str:
    """Return the name of a photograph; only its last part if it is a path of the machine that wrote it."""
    parsed = urlparse(uri)
    name = unquote(parsed.path).replace("\\", "/")
    absolute = bool(parsed.scheme) or name.startswith("/")
    return name.rpartition("/")[2] if absolute else name


def _lens(sensor: Any, size: tuple[int, int]) -> Lens:
    internals = entry(sensor, "internals", dict)
    kind = entry(internals, "type", str)
    if kind != "perspective":
        raise ValueError(f"{kind!r:.20} cameras cannot be read: export undistorted images instead")
    f = number(internals, "focal_length_px")
    cx, cy = numbers(internals, "principal_point_px", 2)
    radial, tangential = (numbers(internals, f"{kind}_distortion", n) for kind, n in _DISTORTION)
    return made_lens("BROWN", size, f, f, cx, cy, *radial, 0.0, *tangential, 0.0)


def _opf_frame(files: Mapping[str, Path]) -> WorldFrame | None:
    """Return the similarity from the processing frame to the project's reference system."""
    if "scene-reference-frame" not in files:
        return None
    file = files["scene-reference-frame"]
    with located(file.name):
        content = read_json(file)
        crs = entry(entry(content, "crs", dict), "definition", str)
        transform = entry(content, "base_to_canonical", dict)
        shift, scale = (numbers(transform, key, 3) for key in ("shift", "scale"))
    if transform.get("swap_xy") or not np.allclose(scale, scale[0], rtol=1e-9):
        # Mirrored axes and heights in another unit are no similarity; the canonical frame is one.
        return WorldFrame(translation=-shift, source=f"{file.name}, with x east and y north in metres")
    return WorldFrame(crs, 1 / scale[0], np.eye(3), -shift / scale[0], file.name)
