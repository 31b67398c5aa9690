# SPDX-License-Identifier: Apache-2.0
"""The points of a capture: those that its files name, or those that lie beside them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.capture import colmap
from blitzgs.capture.cameras import Float64, camera_centres
from blitzgs.capture.names import unified
from blitzgs.capture.point_files import SUFFIXES, read_points
from blitzgs.capture.transforms import Frame, Transforms
from blitzgs.formats.ply import read_point_cloud

# Points in the world of transforms.json, by the programs that write them beside it: nerfstudio and INRIA's.
_BESIDE = ("sparse_pc.ply", "points3d.ply")
# Centres of cameras that agree, as a share of the distance between cameras.
_SAME_PLACE = 1e-3


@dataclass(eq=False)
class SourcePoints:
    """The points as the capture's file describes them, in its own world; see `Capture` for the columns."""

    positions: Float64
    colors: npt.NDArray[np.uint8]
    track_lengths: npt.NDArray[np.int64] | None = None
    errors: Float64 | None = None
    path: Path | None = None
    """The file or model that has them; None: there are none."""
    colors_from: str = ""
    """What in it gives the colours; empty: nothing."""
    crs: Any = None
    """The reference system that the file names (pyproj's); None: it names none."""


def file_points(path: Path) -> SourcePoints:
    """Read the points of a PLY, LAS, LAZ or E57 file; warn if they have no colours.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: the package that reads the format is not installed.
        ValueError: the file is damaged, or has no points.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: put the file of points there, or correct its name")
    if path.suffix.lower() in SUFFIXES:
        positions, colors, crs = read_points(path)
        if colors is None:
            warnings.warn(f"{path}: the points have no colours and start grey", stacklevel=4)
            colors = np.full(positions.shape, 128, dtype=np.uint8)
            return SourcePoints(positions, colors, path=path, crs=crs)
        return SourcePoints(positions, colors, path=path, colors_from="red, green, blue", crs=crs)
    cloud = read_point_cloud(path)
    if not cloud.colors_from and len(cloud.positions):
        warnings.warn(
            f"{path}: the points have no colours and start grey: the file has {', '.join(cloud.properties)}, "
            "and colours are read from red, green and blue",
            stacklevel=4,
        )
    return SourcePoints(cloud.positions, cloud.colors, path=path, colors_from=cloud.colors_from)


def transforms_points(root: Path, content: Transforms, model: Path | None) -> SourcePoints:
    """Return the points of transforms.json: those that it names, else those beside it in the same world.

    Args:
        root: folder of the capture.
        content: of its transforms.json.
        model: the COLMAP model beside it, if there is one.
    """
    if content.points_path is not None:
        return file_points(content.points_path)
    plys = sorted(path for path in root.iterdir() if path.suffix.lower() == ".ply" and path.is_file())
    for path in plys:
        if path.name.lower() in _BESIDE:
            return file_points(path)
    if model is not None and (found := _model_points(root, content, model)) is not None:
        return found
    if plys:
        warnings.warn(
            f"{content.files[0]} names no points, so {plys[0].name} beside it is not used: if its points are "
            f'in the same world, add "ply_file_path": "{plys[0].name}"',
            stacklevel=4,
        )
    return SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))


def _model_points(root: Path, content: Transforms, folder: Path) -> SourcePoints | None:
    """Return the points of a COLMAP model in the world of transforms.json; None if that is not certain."""
    model = colmap.read_model(folder)
    shown = folder.relative_to(root)
    moved = content.moved(model.points.positions)
    reason = _differs(model, content)
    if reason is not None:
        warnings.warn(
            f"{content.files[0]} names no points, and the {len(moved)} points of {shown} are not used: "
            f"{reason}; name a PLY with ply_file_path",
            stacklevel=5,
        )
        return None
    points = model.points
    if model.points_path is not None and model.points_path.suffix in colmap.POINT_SUFFIXES:
        read = file_points(model.points_path)
        read.positions = content.moved(read.positions)
        return read
    return SourcePoints(moved, points.colors, points.track_lengths, points.errors, folder, "the model")


def _differs(model: colmap.ColmapModel, content: Transforms) -> str | None:
    """Return why the cameras of a model and of transforms.json are not known to be the same."""
    places = {_stem(frame.name): frame for frame in content.frames}
    pairs = [(i, places[stem]) for i, n in enumerate(model.images.names) if (stem := _stem(n)) in places]
    if len(pairs) < 2 or len(places) < len(content.frames):
        return "its images are called otherwise than the frames, so their worlds cannot be compared"
    ours = _centres([frame for _, frame in pairs])
    theirs = content.moved(camera_centres(colmap.world_to_camera(model.images))[[i for i, _ in pairs]])
    apart = float(np.median(np.linalg.norm(ours - theirs, axis=1)))
    spread = float(np.linalg.norm(ours - ours.mean(axis=0), axis=1).max())
    if not apart <= _SAME_PLACE * spread:  # NaN too
        return f"its cameras are elsewhere, {apart:.3g} apart, so its world is another one"
    return None


def _centres(frames: Sequence[Frame]) -> Float64:
    return camera_centres(np.stack([frame.world_to_camera for frame in frames]))


def _stem(name: str) -> str:
    return PurePosixPath(unified(name).casefold()).stem
