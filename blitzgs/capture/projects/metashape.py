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
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from blitzgs.capture.cameras import pose_of
from blitzgs.capture.fields import image_size, number, numbers, read_bytes
from blitzgs.capture.lens import Lens
from blitzgs.capture.projects import Project, ProjectView, made_lens, rotation_of
from blitzgs.capture.world import GEOCENTRIC, WorldFrame
from blitzgs.util.errors import located


def is_metashape(path: Path) -> bool:
    """Tell whether an XML file begins as an export of cameras does."""
    with open(path, "rb") as file:
        begin = file.read(4096)
    return b"<document" in begin and b"<chunk" in begin


def read_metashape(path: Path) -> Project:
    """Read the chunk of an export of cameras; kinds that make no perspective image are refused."""
    chunks = [chunk for chunk in _read_xml(path).iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise ValueError("there is no chunk with cameras: export the cameras of an aligned chunk")
    if len(chunks) > 1:
        raise ValueError(f"there are {len(chunks)} chunks with cameras: export one of them alone")
    chunk = chunks[0]
    lenses: dict[str, Lens] = {}
    sensors = {str(sensor.get("id")): sensor for sensor in chunk.iter("sensor")}
    views: list[ProjectView] = []
    components, others = [], []
    for camera in chunk.iter("camera"):
        if camera.find("transform") is None or camera.get("enabled", "true") in ("false", "0"):
            others.append(camera)
            continue
        label, sensor_id = camera.get("label"), str(camera.get("sensor_id"))
        with located(f"camera {camera.get('id')} ({label})"):
            if not label or sensor_id not in sensors:
                raise ValueError(f"no label, or its sensor {sensor_id} is not there; export it again")
            matrix = numbers(_texts(camera), "transform", 16).reshape(4, 4)
            pose = pose_of(rotation_of(matrix[:3, :3]), matrix[:3, 3])
        if sensor_id not in lenses:
            with located(f"sensor {sensor_id}"):
                lenses[sensor_id] = _lens(sensors[sensor_id])
        views.append(ProjectView(label, lenses[sensor_id], pose))
        components.append(camera.get("component_id"))
    found, rigs = len(views), sum(camera.get("master_id") is not None for camera in others)
    every = sorted({component for component in components if component is not None})
    notes, main = [], max(every, key=components.count, default=None)
    if len(every) > 1:
        views = [view for view, component in zip(views, components, strict=True) if component == main]
        notes.append(f"of {len(every)} components, which have their own coordinates, the largest is used")
    if rigs:
        notes.append(f"{rigs} secondary cameras of a rig have no transform of their own and are left out")
    if any(sensor.find("rolling_shutter") is not None for sensor in sensors.values()):
        notes.append("the rolling shutter is not modelled")
    reference = (chunk.findtext("reference") or "").strip()
    local = reference.upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS"))
    crs = "" if local else reference
    with located("transform"):
        frame = _frame(chunk, main, path, GEOCENTRIC if crs else "")
    return Project(views, None, frame, len(others) + found - len(views), notes, crs)


def _read_xml(path: Path) -> Element:
    """Return the root of an XML file.

    Entities are refused: a few lines of them expand to gigabytes or name other files, and no project has one.
    """
    content, parser = read_bytes(path), expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise ValueError("it defines entities, which no project needs")

    parser.EntityDeclHandler = refuse
    try:
        parser.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, ValueError) as error:
        line = parser.CurrentLineNumber
        raise ValueError(f"line {line}: no readable XML ({error}); export the project again") from error


def _texts(element: Element) -> dict[str, str | None]:
    return {child.tag: child.text for child in element}


def _lens(sensor: Element) -> Lens:
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"type {kind!r:.30} makes no perspective image: export undistorted images instead")
    found = sensor.findall("calibration")
    adjusted = [c for c in found if c.get("class") == "adjusted"] or found
    if not adjusted:
        raise ValueError("there is no calibration: align the photographs, and export again")
    resolution = adjusted[0].find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise ValueError("there is no resolution; export it again")
    width, height = size = image_size(resolution.attrib)
    values = _texts(adjusted[0])
    k1, k2, k3, k4, p1, p2, b1, b2, cx, cy = (
        number(values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2", "cx", "cy")
    )
    if "f" in values:
        fy = number(values, "f")
        fx, cx, cy = fy + b1, cx + width / 2, cy + height / 2
    else:  # an old export
        fx, fy = number(values, "fx"), number(values, "fy")
    if kind == "fisheye":
        if b2 != 0:
            raise ValueError(f"a fisheye with the skew b2 = {b2:g} cannot be read: fix b2 to 0")
        return made_lens("THIN_PRISM_FISHEYE", size, fx, fy, cx, cy, k1, k2, p2, p1, k3, k4, 0, 0)
    return made_lens("BROWN", size, fx, fy, cx, cy, k1, k2, k3, k4, p2, p1, b2 / fx if fx else 0.0)


def _frame(chunk: Element, component: str | None, path: Path, crs: str) -> WorldFrame | None:
    """Return the frame of the component's transform, else the chunk's; None: the chunk has no place."""
    components = list(chunk.iter("component"))
    if component is not None or len(components) > 1:
        components = [c for c in components if c.get("id") == component]
    transform = next(
        (t for owner in (*components, chunk) if (t := owner.find("transform")) is not None), None
    )
    if transform is None or transform.find("rotation") is None:
        return None
    values = {"translation": "0 0 0", **_texts(transform)}
    rotation = rotation_of(numbers(values, "rotation", 9).reshape(3, 3))
    translation = numbers(values, "translation", 3)
    return WorldFrame(crs, number(values, "scale", 1.0), rotation, translation, path.name)
