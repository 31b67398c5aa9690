# SPDX-License-Identifier: Apache-2.0
"""Reads cameras without photographs: views that somebody wants to see of a model."""

from __future__ import annotations

from pathlib import Path

from blitzgs.capture import transforms
from blitzgs.capture.cameras import Camera, Float64
from blitzgs.capture.layouts import SourceView, read_layout
from blitzgs.capture.undistort import rectify
from blitzgs.capture.usable import check_lenses, with_finite_poses


def read_cameras(path: Path, offset: Float64) -> list[Camera]:
    """Read the cameras of a transforms file of any name, or of a folder with one or with a COLMAP model.

    Lenses with distortion become pinhole cameras, as in a capture.

    Args:
        path: the file or the folder.
        offset: float64 [3], subtracted from the positions.

    Raises:
        FileNotFoundError: there is no such file, or no camera in the folder.
        ValueError: a file is damaged, or has no camera; the message names it.
    """
    if path.is_file():
        read = transforms.read_transforms(path.parent, [path])
        views = [SourceView(f.name, f.path, None, f.lens, f.world_to_camera) for f in read.frames]
    elif path.is_dir():
        views, _, _ = read_layout(path, "images", 1)
    else:
        raise FileNotFoundError(f"{path}: there is no such transforms file or folder of a COLMAP model")
    if not views:
        raise ValueError(f"{path} has no cameras")
    check_lenses(views)
    views = sorted(with_finite_poses(views), key=lambda view: view.name)
    return [_pinhole(view, offset) for view in views]


def _pinhole(view: SourceView, offset: Float64) -> Camera:
    try:
        plan = rectify(view.lens, "crop")
    except ValueError as error:
        raise ValueError(f"the camera of {view.name}: {error}") from error
    pose = view.world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ offset
    return Camera(view.name, plan.width, plan.height, plan.K, pose, view.path, None, 1, plan)
