# SPDX-License-Identifier: Apache-2.0
"""Bundler's reconstruction (bundle.out, version 0.3), which RealityCapture, Metashape and others export.

Conventions (N. Snavely, Bundler v0.4 User's Manual):

- R and t map world to camera with x right, y up, z backwards.
- The principal point is the centre of the image; f is in pixels, and y points up in the image.
- (1 + k1 r^2 + k2 r^4) scales a point before f.
- The photographs' names, in the order of the cameras, are in list.txt or the file's own name with .list.txt.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.lens import Lens
from blitzgs.capture.points import SourcePoints
from blitzgs.capture.projects.project import Project, ProjectView, check_size, made_lens, pose_of, read_text

_SIGN = b"# Bundle file v0.3"


def is_bundler(path: Path) -> bool:
    """Tell whether a file begins as a reconstruction of Bundler does."""
    with open(path, "rb") as file:
        return file.read(len(_SIGN)) == _SIGN


def read_bundler(path: Path) -> Project:
    """Read cameras and points."""
    check_size(path)
    with open(path, "rb") as file:
        file.readline()
        counts = file.readline().split()
        body = file.read()
    try:
        cameras, points = (int(word) for word in counts)
        if not (0 <= cameras <= len(body) and 0 <= points <= len(body)):
            raise ValueError
    except ValueError as error:
        raise ValueError(f"{path}: line 2: expected the numbers of cameras and points") from error
    lines = body.splitlines()
    if len(lines) < 5 * cameras + 3 * points:
        raise ValueError(
            f"{path}: {len(lines) + 2} lines are too few for {cameras} cameras and {points} points: the file "
            "is cut off; export it again"
        )
    try:
        rows = np.array(b" ".join(lines[: 5 * cameras]).split(), dtype=np.float64).reshape(cameras, 15)
    except ValueError as error:
        raise ValueError(f"{path}: the cameras are not 15 numbers each ({error}); export it again") from error
    names = _names(path, cameras)
    views = []
    for index, row in enumerate(rows):
        if row[0] == 0:  # not registered
            continue
        where = f"{path}: camera {index} ({names[index]})"
        rotation = row[3:12].reshape(3, 3)
        centre = -rotation.T @ row[12:15]
        lens = functools.partial(_lens, row[:3], where)
        views.append(ProjectView(names[index], lens, pose_of(rotation.T * [1, -1, -1], centre, where)))
    return Project(views, _points(path, lines[5 * cameras :], points), lost=cameras - len(views))


def _lens(values: Float64, where: str, width: int, height: int) -> Lens:
    f, k1, k2 = values
    return made_lens(where, "RADIAL", width, height, f, width / 2, height / 2, k1, k2)


def _names(path: Path, count: int) -> list[str]:
    beside = [path.with_suffix(".list.txt"), path.with_suffix(".txt"), path.with_name("list.txt")]
    beside += sorted(path.parent.glob("*list*.txt"))
    found = next((file for file in beside if file.is_file()), None)
    if found is None:
        raise ValueError(f"{path} has no list of its photographs: put list.txt, one name a line, beside it")
    # A line may have a focal length after the name.
    names = [line.strip() for line in read_text(found).splitlines() if line.strip()]
    names = [
        name if len(words := name.rsplit(maxsplit=2)) < 3 or words[1] != "0" else words[0] for name in names
    ]
    if len(names) != count:
        raise ValueError(f"{found} has {len(names)} names for the {count} cameras of {path}: they must agree")
    return names


def _points(path: Path, lines: list[bytes], count: int) -> SourcePoints:
    try:
        positions = np.array(b" ".join(lines[: 3 * count : 3]).split(), dtype=np.float64).reshape(count, 3)
        colors = np.array(b" ".join(lines[1 : 3 * count : 3]).split(), dtype=np.float64).reshape(count, 3)
        tracks = np.array([int(line.split(None, 1)[0]) for line in lines[2 : 3 * count : 3]], dtype=np.int64)
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"{path}: a point has not three lines of numbers ({error}); export it again"
        ) from error
    return SourcePoints(
        positions,
        np.clip(colors, 0, 255).astype(np.uint8),
        tracks,
        path=path,
        colors_from="the points' own colours",
    )
