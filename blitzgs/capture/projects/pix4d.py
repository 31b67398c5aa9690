# SPDX-License-Identifier: Apache-2.0
"""Cameras of Pix4Dmapper: *_calibrated_camera_parameters.txt of the folder params.

Conventions (Pix4D support, "How are the Internal and External Camera Parameters defined"; the file's header):

- m = K [R | -R t] X: R is world to camera with x right, y down, z forward; t is the camera's position.
- (0, 0) is the corner of the first pixel. Radial R1 to R3 and tangential T1, T2 are as in OpenCV.
- *_offset.xyz is added to the coordinates to get those of the reference system in *_wkt.prj.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blitzgs.capture.projects.project import (
    Project,
    ProjectView,
    made_lens,
    numbers,
    pose_of,
    read_text,
    size_of,
)
from blitzgs.capture.world import WorldFrame, read_offset

SUFFIX = "_calibrated_camera_parameters.txt"
# Lines of a camera: name and size, K, radial, tangential, position, R.
_LINES = 10


def read_pix4d(path: Path) -> Project:
    """Read the cameras of a parameter file, with the offset and reference system beside it.

    Raises:
        ValueError: the file is damaged; names the line.
    """
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
