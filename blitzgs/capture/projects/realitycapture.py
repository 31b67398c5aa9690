# SPDX-License-Identifier: Apache-2.0
"""Cameras and points that RealityCapture or RealityScan exports, as CSV and as Bundler's reconstruction.

CSV ("Internal/External camera parameters"; the program's export template and its help on camera models):

- f is a 35 mm equivalent: f / 36 times the longer side in pixels. px and py are the principal point minus
  half of the image, as shares of the longer side.
- Heading, pitch and roll are degrees: camera to world is Rz(-heading) Rx(pitch) Ry(roll) with the camera's
  axes right, up and backwards. All 0 looks straight down with north above.
- Brown's model with k1 to k4. t1 belongs to r^2 + 2 x^2, as OpenCV's p2: the program's own OpenCV template
  writes t2 before t1.
- x, y and alt are coordinates of the export's reference system, which the file does not name; one of degrees
  is refused.

Bundler's bundle.out, version 0.3, which Metashape and others export too (N. Snavely, Bundler v0.4 User's
Manual):

- R and t map world to camera with x right, y up, z backwards.
- The principal point is the centre of the image; f is in pixels, and y points up in the image.
- (1 + k1 r^2 + k2 r^4) scales a point before f.
- The photographs' names, in the order of the cameras, are in list.txt or the file's own name with .list.txt.
"""

from __future__ import annotations

import csv
import functools
import re
from pathlib import Path

import numpy as np

from blitzgs.capture.cameras import Float64, pose_of
from blitzgs.capture.fields import number, read_bytes, read_text
from blitzgs.capture.lens import Lens
from blitzgs.capture.points import SourcePoints
from blitzgs.capture.projects import Project, ProjectView, made_lens, rotation_of, turn
from blitzgs.util.errors import WRONG_CONTENT, located

_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
# Newer versions write these names.
_SAME = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py", "z": "alt"}


def _separator(line: str) -> str:
    return ";" if ";" in line else ","  # spreadsheets of many countries write semicolons


def _columns(line: str) -> list[str]:
    names = [name.strip().lstrip("#").lower() for name in line.split(_separator(line))]
    return [_SAME.get(name, name) for name in names]


def is_realitycapture(path: Path) -> bool:
    """Tell whether a CSV file has the columns of internal and external camera parameters."""
    with open(path, "rb") as file:
        begin = file.read(4096).decode("utf-8-sig", errors="replace")
    return any(set(_NEEDED) <= set(_columns(line)) for line in begin.splitlines()[:2])


def read_realitycapture(path: Path) -> Project:
    """Read the cameras of a CSV file."""
    lines = read_text(path).splitlines()
    first = next(i for i, line in enumerate(lines[:2]) if set(_NEEDED) <= set(_columns(line)))
    columns, separator = _columns(lines[first]), _separator(lines[first])
    views, centres = [], []
    rows = csv.reader(lines[first + 1 :], delimiter=separator)
    for place, row in enumerate(rows, start=first + 2):
        if not row or row[0].startswith("#"):
            continue
        with located(f"line {place}"):
            if len(row) != len(columns):
                raise ValueError(f"{len(row)} values in {len(columns)} columns; export it again")
            cells = dict(zip(columns, row, strict=True))
            texts = {key: cells[key] for key in columns if key in _NUMBERS}
            if separator == ";":  # where a comma is the decimal mark
                texts = {key: text.replace(",", ".") for key, text in texts.items()}
            values = {key: number(texts, key) for key in texts}
            # Of axes right, up and backwards; ours are right, down and forward.
            rotation = turn("z", -values["heading"]) @ turn("x", values["pitch"]) @ turn("y", values["roll"])
            centre = [values["x"], values["y"], values["alt"]]
            pose = pose_of(rotation * [1, -1, -1], centre)
        centres.append(centre)
        views.append(ProjectView(cells["name"].strip(), functools.partial(_lens, values), pose))
    _check_metres(np.array(centres).reshape(-1, 3))
    return Project(views)


def _check_metres(centres: Float64) -> None:
    """Refuse longitudes and latitudes beside heights in metres [N, 3]: such cameras are above each other."""
    if len(centres) < 2:
        return
    east, north, up = np.ptp(centres, axis=0)
    # Cameras of a mast or a shaft are above each other, too: about zero where coordinates are local.
    if (np.abs(centres[:, :2].mean(axis=0)) < 1).all():
        return
    if (np.abs(centres[:, :2]) <= [180, 90]).all() and up > _ABOVE * max(east, north):
        raise ValueError(
            f"x and y are longitudes and latitudes, as they differ by {max(east, north):.3g} and alt by "
            f"{up:.3g}: export in local coordinates or a projected system, such as a UTM zone"
        )


# So many times more do cameras differ in alt than in x and y where these are degrees.
_ABOVE = 50
_NUMBERS = (*_NEEDED[1:], "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")


def _lens(values: dict[str, float], width: int, height: int) -> Lens:
    side = max(width, height)
    f = values["f"] / 36 * side
    cx = width / 2 + values.get("px", 0) * side
    cy = height / 2 + values.get("py", 0) * side
    coefficients = (values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "t2", "t1"))
    return made_lens("BROWN", (width, height), f, f, cx, cy, *coefficients, 0.0)


_SIGN = b"# Bundle file v0.3"


def is_bundler(path: Path) -> bool:
    """Tell whether a file begins as a reconstruction of Bundler does."""
    with open(path, "rb") as file:
        return file.read(len(_SIGN)) == _SIGN


def read_bundler(path: Path) -> Project:
    """Read cameras and points."""
    _, head, *lines = read_bytes(path).split(b"\n")
    try:
        cameras, points = (int(word) for word in head.split())
        if not (0 <= cameras <= len(lines) and 0 <= points <= len(lines)):
            raise ValueError
    except ValueError as error:
        raise ValueError("line 2: expected the numbers of cameras and points") from error
    if len(lines) < 5 * cameras + 3 * points:
        raise ValueError(
            f"{len(lines) + 2} lines are too few for {cameras} cameras and {points} points: the file is cut "
            "off; export it again"
        )
    try:
        rows = np.array(b" ".join(lines[: 5 * cameras]).split(), dtype=np.float64).reshape(cameras, 15)
    except ValueError as error:
        raise ValueError(f"the cameras are not 15 numbers each ({error}); export it again") from error
    names = _names(path, cameras)
    views = []
    for index, row in enumerate(rows):
        if row[0] == 0:  # not registered
            continue
        with located(f"camera {index} ({names[index]})"):
            rotation = rotation_of(row[3:12].reshape(3, 3).T)
            pose = pose_of(rotation * [1, -1, -1], -rotation @ row[12:15])
        views.append(ProjectView(names[index], functools.partial(_bundle_lens, row[:3]), pose))
    return Project(views, _points(path, lines[5 * cameras :], points), lost=cameras - len(views))


def _bundle_lens(values: Float64, width: int, height: int) -> Lens:
    f, k1, k2 = values
    return made_lens("RADIAL", (width, height), f, width / 2, height / 2, k1, k2)


def _names(path: Path, count: int) -> list[str]:
    beside = [path.with_suffix(".list.txt"), path.with_suffix(".txt"), path.with_name("list.txt")]
    beside += sorted(path.parent.glob("*list*.txt"))
    found = next((file for file in beside if file.is_file()), None)
    if found is None:
        raise ValueError("it has no list of its photographs: put list.txt, one name a line, beside it")
    # A line may have a focal length after the name.
    lines = (line.strip() for line in read_text(found).splitlines())
    names = [re.sub(r"\s+0\s+[\d.eE+-]+$", "", line) for line in lines if line]
    if len(names) != count:
        raise ValueError(f"{found} has {len(names)} names for its {count} cameras: they must agree")
    return names


def _points(path: Path, lines: list[bytes], count: int) -> SourcePoints:
    try:
        positions = np.array(b" ".join(lines[: 3 * count : 3]).split(), dtype=np.float64).reshape(count, 3)
        colors = np.array(b" ".join(lines[1 : 3 * count : 3]).split(), dtype=np.float64).reshape(count, 3)
        tracks = np.array([int(line.split(None, 1)[0]) for line in lines[2 : 3 * count : 3]], dtype=np.int64)
    except WRONG_CONTENT as error:
        raise ValueError(f"a point has not three lines of numbers ({error}); export it again") from error
    return SourcePoints(
        positions,
        np.clip(colors, 0, 255).astype(np.uint8),
        tracks,
        path=path,
        colors_from="the points' own colours",
    )
