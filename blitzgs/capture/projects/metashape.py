# SPDX-License-Identifier: Apache-2.0
"""Cameras that Agisoft Metashape exports as XML (File, Export, Export Cameras).

Conventions (Metashape User Manual, appendix on camera models; the format's own fields):

- The transform of a camera is camera to chunk, row by row; x right, y down, z forward.
- Pixels: the corner of the image is (0, 0), the centre of the first pixel (0.5, 0.5).
- cx and cy are the principal point minus half of the image; fx = f + b1, fy = f, and b2 is the skew.
- x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y: p1 and p2 are swapped against
  OpenCV's. A fisheye applies the same to the equidistant projection.
- world = scale * rotation @ chunk + translation, of the component or the chunk: geocentric coordinates of the
  chunk's ellipsoid, or local ones if its reference system is local.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from blitzgs.capture.lens import Lens
from blitzgs.capture.projects import (
    Project,
    ProjectView,
    check_rotation,
    made_lens,
    number,
    numbers,
    pose_of,
    read_xml,
    size_of,
)
from blitzgs.capture.world import GEOCENTRIC, WorldFrame

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")


def is_metashape(path: Path) -> bool:
    """Tell whether an XML file begins as an export of cameras does."""
    with open(path, "rb") as file:
        begin = file.read(4096)
    return b"<document" in begin and b"<chunk" in begin


def read_metashape(path: Path) -> Project:
    """Read the chunk of an export of cameras; kinds that make no perspective image are refused."""
    root = read_xml(path)
    chunks = [chunk for chunk in root.iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise ValueError(f"{path}: there is no chunk with cameras: export the cameras of an aligned chunk")
    if len(chunks) > 1:
        raise ValueError(f"{path}: there are {len(chunks)} chunks with cameras: export one of them alone")
    chunk = chunks[0]
    lenses: dict[str, Lens] = {}
    sensors = {str(sensor.get("id")): sensor for sensor in chunk.iter("sensor")}
    views: list[ProjectView] = []
    components = []
    cameras = [
        camera
        for camera in chunk.iter("camera")
        if camera.find("transform") is not None and camera.get("enabled", "true") not in ("false", "0")
    ]
    for camera in cameras:
        where = f"{path}: camera {camera.get('id')} ({camera.get('label')})"
        label, sensor_id = camera.get("label"), str(camera.get("sensor_id"))
        if not label or sensor_id not in sensors:
            raise ValueError(f"{where}: no label, or its sensor {sensor_id} is not there; export it again")
        if sensor_id not in lenses:
            lenses[sensor_id] = _lens(sensors[sensor_id], f"{path}: sensor {sensor_id}")
        matrix = numbers(camera.findtext("transform"), 16, f"{where}: transform").reshape(4, 4)
        views.append(ProjectView(label, lenses[sensor_id], pose_of(matrix[:3, :3], matrix[:3, 3], where)))
        components.append(camera.get("component_id"))
    used = set(cameras)
    others = [camera for camera in chunk.iter("camera") if camera not in used]
    rigs = sum(camera.get("master_id") is not None for camera in others)
    every = sorted({component for component in components if component is not None})
    notes, main = [], max(every, key=components.count, default=None)
    if len(every) > 1:
        views = [view for view, component in zip(views, components, strict=True) if component == main]
        notes.append(f"of {len(every)} components, which have their own coordinates, the largest is used")
    if rigs:
        notes.append(f"{rigs} secondary cameras of a rig have no transform of their own and are left out")
    if any(sensor.find("rolling_shutter") is not None for sensor in sensors.values()):
        notes.append("the rolling shutter is not modelled")
    lost = len(others) + len(cameras) - len(views)
    return Project(views, None, _frame(chunk, main, path), lost, notes)


def _lens(sensor: Element, where: str) -> Lens:
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise ValueError(
            f"{where}: type {kind!r:.30} makes no perspective image: export undistorted images instead"
        )
    found = sensor.findall("calibration")
    adjusted = [c for c in found if c.get("class") == "adjusted"] or found
    if not adjusted:
        raise ValueError(f"{where}: there is no calibration: align the photographs, and export again")
    calibration = adjusted[0]
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise ValueError(f"{where}: there is no resolution; export it again")
    width, height = size_of(resolution.get("width"), resolution.get("height"), f"{where}: resolution")

    def value(name: str, default: str | None = "0") -> float:
        text = calibration.findtext(name, default)
        if text is None:
            raise ValueError(f"{where}: calibration has no {name}; export it again")
        return number(text, f"{where}: {name}")

    k1, k2, k3, k4, p1, p2, b1, b2 = (value(name) for name in _COEFFICIENTS)
    # Old exports have fx and fy instead of f.
    fy = value("f", None) if calibration.find("f") is not None else value("fy", None)
    fx = fy + b1 if calibration.find("f") is not None else value("fx", None)
    cx, cy = value("cx"), value("cy")
    if calibration.find("f") is not None:
        cx, cy = cx + width / 2, cy + height / 2
    if kind == "fisheye":
        if b2 != 0:
            raise ValueError(f"{where}: a fisheye with the skew b2 = {b2:g} cannot be read: fix b2 to 0")
        params = (fx, fy, cx, cy, k1, k2, p2, p1, k3, k4, 0.0, 0.0)
        return made_lens(where, "THIN_PRISM_FISHEYE", width, height, *params)
    return made_lens(where, "BROWN", width, height, fx, fy, cx, cy, k1, k2, k3, k4, p2, p1, b2 / fx)


def _frame(chunk: Element, component: str | None, path: Path) -> WorldFrame | None:
    """Return the frame of the component's transform, else the chunk's; None: the chunk has no place."""
    components = list(chunk.iter("component"))
    if component is not None or len(components) > 1:
        components = [c for c in components if c.get("id") == component]
    owners = [*components, chunk]
    transform = next((t for owner in owners if (t := owner.find("transform")) is not None), None)
    if transform is None or transform.find("rotation") is None:
        return None
    where = f"{path}: transform"
    rotation = numbers(transform.findtext("rotation"), 9, f"{where}: rotation").reshape(3, 3)
    check_rotation(rotation, where)
    translation = numbers(transform.findtext("translation", "0 0 0"), 3, f"{where}: translation")
    scale = number(transform.findtext("scale", "1"), f"{where}: scale")
    reference = (chunk.findtext("reference") or "").strip()
    local = not reference or reference.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS"))
    # Rounded numbers of the file make the rotation one to about 1e-7 only.
    u, _, vt = np.linalg.svd(rotation)
    return WorldFrame("" if local else GEOCENTRIC, scale, u @ vt, translation, path.name)
