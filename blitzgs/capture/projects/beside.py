# SPDX-License-Identifier: Apache-2.0
"""The points beside a project, moved into the world of its cameras."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.lens import Lens
from blitzgs.capture.point_files import SUFFIXES
from blitzgs.capture.points import SourcePoints, file_points
from blitzgs.capture.world import WorldFrame, converted

# Points and views that are compared to find out in which coordinates points are.
_SAMPLE, _VIEWS = 2000, 100


def points_beside(
    root: Path, own: SourcePoints | None, frame: WorldFrame | None, cameras: Sequence[tuple[Lens, Float64]]
) -> SourcePoints:
    """Return the points in the folder of a project, in the world of its cameras.

    Programs export cameras in coordinates of their own and points in those of a reference system, or both in
    one of the two: the coordinates in which the views see the points are taken.

    Args:
        root: folder of the capture.
        own: points that the project itself brings; None: a file of points is searched.
        frame: where the cameras lie in the world.
        cameras: lenses and poses [4, 4] of the views.

    Raises:
        ImportError, ValueError: see `file_points`.
    """
    points = own
    if points is None:
        files = sorted(
            path for path in root.iterdir() if path.suffix.lower() in (".ply", *SUFFIXES) and path.is_file()
        )
        named = [path for path in files if path.stem.lower() in ("points3d", "sparse_pc", "points")] or files
        if len(named) != 1:
            if named:
                shown = ", ".join(path.name for path in named[:5])
                warnings.warn(
                    f"{root} has {len(named)} files of points ({shown}), and none is used: call one of them "
                    f"points{named[0].suffix.lower()}",
                    stacklevel=5,
                )
            return SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
        points = file_points(named[0])
    choices = {"the project's own coordinates": points.positions}
    if frame is not None:
        choices[f"coordinates of {frame.name}"] = frame.from_world(points.positions)
        if points.crs is not None and frame.crs:
            moved = converted(points.positions, points.crs, frame.crs)
            choices[f"coordinates of {points.crs.name}"] = frame.from_world(moved)
    seen = {name: seen_share(positions, cameras) for name, positions in choices.items()}
    best = max(seen, key=seen.__getitem__)
    if best != next(iter(choices)):
        warnings.warn(f"{points.path}: the points are in {best}, and are moved to the cameras'", stacklevel=5)
    points.positions = choices[best]
    return points


def seen_share(positions: Float64, cameras: Sequence[tuple[Lens, Float64]]) -> float:
    """Return the share of views that see a point, of a sample of both."""
    sample = positions[:: max(1, len(positions) // _SAMPLE)]
    some = cameras[:: max(1, len(cameras) // _VIEWS)]
    return sum(_sees(lens, pose, sample) for lens, pose in some) / max(1, len(some))


def _sees(lens: Lens, pose: Float64, positions: Float64) -> bool:
    with np.errstate(all="ignore"):
        x, y, depth = pose[:3, :3] @ positions.T + pose[:3, 3:]
        front = depth > 0
        u, v = lens.project(x[front] / depth[front], y[front] / depth[front])
        return bool(((u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)).any())
