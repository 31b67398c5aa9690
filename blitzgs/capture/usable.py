# SPDX-License-Identifier: Apache-2.0
"""Which views and points of a capture are used: what cannot be is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture import transforms
from blitzgs.capture.cameras import Camera, Float64, SourceView, camera_centres, rectify
from blitzgs.capture.layouts import read_layout
from blitzgs.capture.lengths import LEAST_SPREAD, StrayCamera
from blitzgs.capture.lens import Lens, check_lens
from blitzgs.capture.points import SourcePoints
from blitzgs.util.errors import located, warn

# Coordinates from here on are damage; the squares of smaller ones are finite.
_FARTHEST = 1e100
# As many as give a start where the capture has no points.
_RANDOM_POINTS = 100_000


def _is_usable(coordinates: Float64) -> npt.NDArray[np.bool_]:
    return np.asarray(np.abs(coordinates) < _FARTHEST)  # false for NaN


def usable_views(views: list[SourceView]) -> list[SourceView]:
    """Return the views whose pose is finite, by name; warn of the others, and of lenses that are unusual.

    ValueError: no pose is finite, or no camera has one of the lenses.
    """
    _check_lenses(views)
    finite = [view for view in views if _is_usable(view.world_to_camera).all()]
    if not finite:
        raise ValueError(f"none of the {len(views)} views has a pose (a finite rotation and translation)")
    if len(finite) < len(views):
        first = next(v.name for v in views if not _is_usable(v.world_to_camera).all())
        warn(
            f"{len(views) - len(finite)} of {len(views)} views have no finite pose and were dropped "
            f"(first: {first})"
        )
    return sorted(finite, key=lambda view: view.name)


def _check_lenses(views: list[SourceView]) -> None:
    first: dict[Lens, str] = {}
    for view in views:
        first.setdefault(view.lens, view.name)
    unusual = []
    for lens, name in first.items():
        with located(f"the camera of {name}"):
            if doubt := check_lens(lens):
                unusual.append(f"{name}: {doubt}")
    if unusual:
        warn(f"{len(unusual)} of {len(first)} cameras are unusual (first: {unusual[0]})")


def without_strays(
    views: list[SourceView], strays: list[StrayCamera], count: int, keep: bool
) -> list[SourceView]:
    """Return those of `count` views whose pose is right, unless the user keeps the others, and name them."""
    if not strays:
        return views
    shown = ", ".join(f"{s.name} at {s.distance:.6g}" for s in strays[:5]) + ", ..." * (len(strays) > 5)
    done = "kept" if keep else "left out; --data.stray_cameras=keep trains on them"
    warn(
        f"{len(strays)} of {count} cameras lie far from the others, which are within "
        f"{strays[0].others:.6g} of their middle, and show hardly a point: {shown} ({done})"
    )
    names = {stray.name for stray in strays}
    return views if keep else [view for view in views if view.name not in names]


def finite_points(points: SourcePoints) -> SourcePoints:
    """Return the points whose position is finite; warn of the others."""
    finite: npt.NDArray[np.bool_] = np.asarray(_is_usable(points.positions).all(axis=1))
    if finite.all():
        return points
    warn(f"{int((~finite).sum())} of {finite.size} points are not finite and were dropped")
    return replace(points, **{name: column[finite] for name, column in points.columns().items()})


def points_at_random(root: Path, cameras: Sequence[Camera], offset: Float64) -> SourcePoints:
    """Return uniform points of random colours in the region that the cameras look at.

    ValueError: all cameras are in one place.
    """
    warn(
        f"{root}: the capture has no points; {_RANDOM_POINTS:,} random ones take their place. Points of the "
        "reconstruction give a better start"
    )
    poses = np.stack([camera.world_to_camera for camera in cameras])
    centres, axes = camera_centres(poses), poses[:, 2, :3]
    # The point nearest to all optical axes by least squares; the tiny term keeps parallel axes solvable.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    target = np.linalg.solve(
        across.sum(axis=0) + 1e-6 * np.eye(3),
        np.einsum("nij,nj->i", across, centres) + 1e-6 * centres.mean(axis=0),
    )
    half = 0.35 * float(np.linalg.norm(centres - target, axis=1).mean())
    # Files state coordinates of a map, with offsets of millions of metres, to a millimetre.
    if half <= LEAST_SPREAD * (1 + 1e-3 * float(np.abs(offset).max())):
        raise ValueError(
            f"{root}: the capture has no points and all its cameras are in one place, so the position of the "
            "scene is unknown: add points to the capture"
        )
    random, shape = np.random.default_rng(0), (_RANDOM_POINTS, 3)
    positions = target + offset + random.uniform(-half, half, shape)
    return SourcePoints(positions, random.integers(0, 256, shape, dtype=np.uint8))


def read_cameras(path: Path, offset: Float64) -> list[Camera]:
    """Read the cameras of a transforms file of any name, or of a folder with one or with a COLMAP model.

    Lenses with distortion become pinhole cameras, as in a capture; `offset` [3] is subtracted from the
    positions. FileNotFoundError: there is no such file, or no camera in the folder. ValueError: a file is
    damaged, or has no camera.
    """
    if path.is_file():
        views = transforms.read_transforms(path.parent, [path]).frames
    elif path.is_dir():
        views, _, _ = read_layout(path, "images", 1)
    else:
        raise FileNotFoundError(f"{path}: there is no such transforms file or folder of a COLMAP model")
    if not views:
        raise ValueError(f"{path} has no cameras")
    return [_pinhole(view, offset) for view in usable_views(views)]


def _pinhole(view: SourceView, offset: Float64) -> Camera:
    with located(f"the camera of {view.name}"):
        plan = rectify(view.lens, "crop")
    pose = view.pose_from(offset)
    return Camera(view.name, plan.width, plan.height, plan.K, pose, view.path, None, 1, plan)
