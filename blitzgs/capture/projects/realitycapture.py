# SPDX-License-Identifier: Apache-2.0
"""Cameras that RealityCapture or RealityScan exports as CSV ("Internal/External camera parameters").

Conventions (the program's export template and its help on camera models):

- f is a 35 mm equivalent: f / 36 times the longer side in pixels. px and py are the principal point minus
  half of the image, as shares of the longer side.
- Heading, pitch and roll are degrees: camera to world is Rz(-heading) Rx(pitch) Ry(roll) with the camera's
  axes right, up and backwards. All 0 looks straight down with north above.
- Brown's model with k1 to k4. t1 belongs to r^2 + 2 x^2, as OpenCV's p2: the program's own OpenCV template
  writes t2 before t1.
- x, y and alt are coordinates of the export's reference system, which the file does not name.
"""

from __future__ import annotations

import csv
import functools
from pathlib import Path

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.lens import Lens
from blitzgs.capture.projects.project import Project, ProjectView, made_lens, number, pose_of, read_text

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
    columns = _columns(lines[first])
    views = []
    rows = csv.reader(lines[first + 1 :], delimiter=_separator(lines[first]))
    for place, row in enumerate(rows, start=first + 2):
        if not row or row[0].startswith("#"):
            continue
        where = f"{path}: line {place}"
        if len(row) != len(columns):
            raise ValueError(f"{where}: {len(row)} values in {len(columns)} columns; export it again")
        cells = dict(zip(columns, row, strict=True))
        values = {key: number(cells[key], f"{where}: {key}") for key in columns if key in _NUMBERS}
        rotation = _rotation(values["heading"], values["pitch"], values["roll"])
        centre = [values["x"], values["y"], values["alt"]]
        lens = functools.partial(_lens, values, where)
        views.append(ProjectView(cells["name"].strip(), lens, pose_of(rotation, centre, where)))
    return Project(views)


_NUMBERS = (*_NEEDED[1:], "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")


def _rotation(heading: float, pitch: float, roll: float) -> Float64:
    """Return camera to world for axes right, down, forward."""
    h, p, r = np.radians([-heading, pitch, roll])
    about_z = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    about_y = np.array([[np.cos(r), 0, np.sin(r)], [0, 1, 0], [-np.sin(r), 0, np.cos(r)]])
    return np.asarray(about_z @ about_x @ about_y * [1, -1, -1])


def _lens(values: dict[str, float], where: str, width: int, height: int) -> Lens:
    side = max(width, height)
    f = values["f"] / 36 * side
    cx = width / 2 + values.get("px", 0) * side
    cy = height / 2 + values.get("py", 0) * side
    k1, k2, k3, k4, t1, t2 = (values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "t1", "t2"))
    return made_lens(where, "BROWN", width, height, f, f, cx, cy, k1, k2, k3, k4, t2, t1, 0)
