# SPDX-License-Identifier: Apache-2.0
"""Cameras of a capture: pinhole views of the re-centred world, and their undistortion.

The camera of an undistorted image keeps the focal lengths and the principal ray, so the resolution at the
centre does not change, and its pixel grid continues the old one. "crop" keeps the largest rectangle found in
which every pixel was seen; "mask" keeps the bounding rectangle of what was seen (at most 70 degrees off the
axis) and marks the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.capture.lens import Array, Lens

MAX_TANGENT = float(np.tan(np.radians(70.0)))
_GRID = 384
_MIN_SIDE = 16
_UNSEEN = (
    "the lens does not see along its own axis, or the image is folded or more than 70 degrees off the axis; "
    "are the parameters right? {}"
)


@dataclass(frozen=True)
class Rectification:
    """How to turn a lens' image into a pinhole image of width x height with the matrix `K` (pixels)."""

    lens: Lens
    width: int
    height: int
    x0: int  # column of the old pixel grid at which the new image begins (negative: left of the old image)
    y0: int
    has_invalid: bool  # whether some pixels of the new image were not seen

    @property
    def is_identity(self) -> bool:
        """Whether the new image is the old one."""
        return self.lens.is_pinhole

    @property
    def K(self) -> Array:  # noqa: N802
        """Return the matrix [3, 3] of the new image."""
        matrix = self.lens.matrix
        matrix[0, 2] -= self.x0
        matrix[1, 2] -= self.y0
        return matrix

    def maps(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Return columns and rows in the old image for cv2.remap [height, width], and which of them it shows.

        cv2 puts the centre of pixel (i, j) at (i, j), hence the half pixel less.
        """
        columns = np.empty((self.height, self.width), dtype=np.float32)
        rows = np.empty_like(columns)
        every = np.arange(self.width)
        for begin in range(0, self.height, 256):  # float64 temporaries of a whole image would be gigabytes
            end = min(begin + 256, self.height)
            x, y = self.source(every[None, :], np.arange(begin, end)[:, None])
            columns[begin:end], rows[begin:end] = x - 0.5, y - 0.5
        if not self.has_invalid:
            return columns, rows, _inside(self.lens, columns + 0.5, rows + 0.5)
        u, v = (a.astype(np.float32) for a in self._directions(every, np.arange(self.height)))
        return columns, rows, _seen(self.lens, u, v, columns + 0.5, rows + 0.5)

    def source(self, columns: npt.ArrayLike, rows: npt.ArrayLike) -> tuple[Array, Array]:
        """Return where the centres of the new image's pixels lie in the old image, (x, y)."""
        return self.lens.project(*np.broadcast_arrays(*self._directions(columns, rows)))

    def _directions(self, columns: npt.ArrayLike, rows: npt.ArrayLike) -> tuple[Array, Array]:
        fx, fy, cx, cy = self.lens.intrinsics
        return (np.asarray(columns) + 0.5 + self.x0 - cx) / fx, (np.asarray(rows) + 0.5 + self.y0 - cy) / fy


@cache
def rectify(lens: Lens, policy: str = "crop") -> Rectification:
    """Choose the pinhole image for a lens; `policy` is "crop" or "mask".

    ValueError: hardly anything of the image can be kept (damaged distortion parameters).
    """
    if lens.is_pinhole:
        return Rectification(lens, lens.width, lens.height, 0, 0, has_invalid=False)
    u, v, seen = _seen_grid(lens)
    top, bottom, left, right = _inner_rectangle(seen) if policy == "crop" else _bounds(seen)
    fx, fy, cx, cy = lens.intrinsics
    # The first and last pixels whose centres lie between the outermost grid points that were seen.
    x0, x1 = int(np.ceil(u[left] * fx + cx - 0.5)), int(np.floor(u[right] * fx + cx - 0.5))
    y0, y1 = int(np.ceil(v[top] * fy + cy - 0.5)), int(np.floor(v[bottom] * fy + cy - 0.5))
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if min(width, height) < _MIN_SIDE:
        raise ValueError(f"undistorting leaves {width} x {height} pixels; are the parameters right? {lens}")
    plan = Rectification(lens, width, height, x0, y0, has_invalid=policy == "mask")
    return _trim(plan) if policy == "crop" else plan


def _seen_grid(lens: Lens) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Return a grid of normalised coordinates that covers the lens' view: columns u, rows v, seen [v, u]."""
    fx, fy, cx, cy = lens.intrinsics
    box = np.array([-cx / fx, (lens.width - cx) / fx, -cy / fy, (lens.height - cy) / fy])
    while True:
        box = np.clip(box, -MAX_TANGENT, MAX_TANGENT)
        u, v = np.linspace(box[0], box[1], _GRID), np.linspace(box[2], box[3], _GRID)
        seen = _seen(lens, u, v, *lens.project(*np.broadcast_arrays(u[None, :], v[:, None])))
        open_sides = np.array([seen[:, 0].any(), seen[:, -1].any(), seen[0].any(), seen[-1].any()])
        open_sides |= not seen.any()  # of a part of a picture that is far from the axis
        open_sides &= np.abs(box) < MAX_TANGENT
        if not open_sides.any():
            if not seen.any():
                raise ValueError(_UNSEEN.format(lens))
            return u, v, seen
        spans = np.repeat([box[1] - box[0], box[3] - box[2]], 2)
        box = np.where(open_sides, box + np.array([-0.08, 0.08, -0.08, 0.08]) * spans, box)


def _inside(lens: Lens, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height))


def _seen(
    lens: Lens, u: npt.NDArray[Any], v: npt.NDArray[Any], x: npt.NDArray[Any], y: npt.NDArray[Any]
) -> npt.NDArray[np.bool_]:
    """Return which directions of a grid fall inside the image, without those that are folded back into it.

    u, v are the directions of the grid's columns and rows, x, y their pixels, [rows, columns]. Beyond a fold
    the image would be mirrored, so only directions that are connected to the axis without crossing a fold
    count as seen. The axis itself may lie outside the image, as in a part of a picture.
    """
    seen = _inside(lens, x, y)
    with np.errstate(invalid="ignore"):
        dx_dv, dx_du = np.gradient(x)
        dy_dv, dy_du = np.gradient(y)
        seen &= dx_du * dy_dv > dx_dv * dy_du
    if not seen.any():
        return seen
    distances = np.where(seen, u[None, :] ** 2 + v[:, None] ** 2, np.inf)
    row, column = np.unravel_index(distances.argmin(), seen.shape)
    if is_folded(lens, float(u[column]), float(v[row])):
        raise ValueError(_UNSEEN.format(lens))
    _, labels = cv2.connectedComponents(seen.astype(np.uint8), connectivity=4)
    return np.asarray(labels == labels[row, column])


def is_folded(lens: Lens, u: float, v: float) -> bool:
    """Tell whether the lens mirrors the image or sees nothing somewhere between its axis and a direction."""
    share, step = np.linspace(0, 1, _GRID), 1e-5
    right, left = (lens.project(share * u + d, share * v) for d in (step, -step))
    below, above = (lens.project(share * u, share * v + d) for d in (step, -step))
    turned = (right[0] - left[0]) * (below[1] - above[1]) - (right[1] - left[1]) * (below[0] - above[0])
    return not bool((turned > 0).all())  # NaN too


def _bounds(seen: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    return int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])


def _inner_rectangle(seen: npt.NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Shrink the bounds until every pixel is seen, each time at the side with the largest unseen share."""
    top, bottom, left, right = _bounds(seen)
    while True:
        part = seen[top : bottom + 1, left : right + 1]
        if part.size == 0 or part.all():
            return top, bottom, left, right
        unseen = [1 - side.mean() for side in (part[0], part[-1], part[:, 0], part[:, -1])]
        worst = int(np.argmax(unseen))
        if unseen[worst] == 0:  # there is a hole inside, so shrink all sides
            top, bottom, left, right = top + 1, bottom - 1, left + 1, right - 1
            continue
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)


def _trim(plan: Rectification) -> Rectification:
    """Drop border pixels that were not seen, which the coarse grid did not find."""
    x0, y0, width, height = plan.x0, plan.y0, plan.width, plan.height
    while min(width, height) >= _MIN_SIDE:
        plan = Rectification(plan.lens, width, height, x0, y0, has_invalid=False)
        every_row, every_column = np.arange(height), np.arange(width)
        sides = ((every_column, 0), (every_column, height - 1), (0, every_row), (width - 1, every_row))
        unseen = [1 - _inside(plan.lens, *plan.source(*side)).mean() for side in sides]
        worst = int(np.argmax(unseen))
        if unseen[worst] == 0:
            return plan
        x0, width = x0 + (worst == 2), width - (worst >= 2)
        y0, height = y0 + (worst == 0), height - (worst < 2)
    raise ValueError(f"undistorting leaves hardly a pixel; are the parameters right? {plan.lens}")


# Longest side of an image in pixels, of which the kernels make tiles (checked_tile_grid of csrc/common/op.h).
MAX_SIDE = 1 << 20

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """One view; image sizes and intrinsics are in pixels after undistortion and downscaling."""

    name: str
    width: int
    height: int
    K: Float64
    """[3, 3]; pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""
    world_to_camera: Float64
    """[4, 4], rigid, of the world whose origin was moved to `Capture.offset`."""
    image_path: Path
    mask_path: Path | None
    orientation: int
    """EXIF orientation (1 to 8) to apply to the decoded file; 1: do not turn it."""
    rectification: Rectification
    """Maps the file's pixels to a pinhole image, before downscaling."""


@dataclass(frozen=True, eq=False)
class SourceView:
    """A view as the capture's file describes it: lens at the size that the file states, pose [4, 4]."""

    name: str
    path: Path
    mask_path: Path | None
    lens: Lens
    world_to_camera: Float64
    # "train" or "test" (held out) by the files, "unused" if it is in none of their lists, "both" if it is in
    # two that exclude each other; None if they do not say.
    part: str | None = None

    def pose_from(self, origin: Float64) -> Float64:
        """Return the pose [4, 4] in the world whose origin was moved to `origin` [3]."""
        pose = self.world_to_camera.copy()
        pose[:3, 3] += pose[:3, :3] @ origin
        return pose

    def pixels_of(self, points: Float64) -> Float64:
        """Return the pixels [S, 2] at which the view shows points [M, 3], occluded ones too; others not."""
        x, y, depth = self.world_to_camera[:3, :3] @ points.T + self.world_to_camera[:3, 3:]
        front = depth > 0
        with np.errstate(all="ignore"):
            pixels = np.stack(self.lens.project(x[front] / depth[front], y[front] / depth[front]), axis=1)
            inside = (pixels >= 0) & (pixels < [self.lens.width, self.lens.height])
        return np.asarray(pixels[inside.all(axis=1)])


def pose_of(camera_to_world: Float64, centre: Float64 | Sequence[float]) -> Float64:
    """Return world to camera [4, 4] of a camera's axes in the world (columns of [3, 3]) and its centre."""
    pose = np.eye(4)
    pose[:3, :3] = camera_to_world.T
    pose[:3, 3] = -camera_to_world.T @ np.asarray(centre)
    return pose


def nearest_rotation(matrix: Float64) -> Float64:
    """Return the rotation [3, 3] that a file rounded to a few digits; a matrix that is not finite as it is.

    Of coordinates of millions of metres, what is lacking to a rotation would move camera centres by metres.
    """
    if not np.isfinite(matrix).all():
        return matrix
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


def camera_centres(world_to_camera: Float64) -> Float64:
    """Return the positions [N, 3] of rigid poses [N, 4, 4]."""
    return np.asarray(-np.einsum("nji,nj->ni", world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]))


def scaled_matrix(K: Float64, old: tuple[int, int], new: tuple[int, int]) -> Float64:
    """Return K of an image resized from old to new (width, height), each axis by its own ratio.

    With pixel centres at halves the image covers [0, width], so every entry of a row scales alike.
    """
    return np.asarray(np.diag([new[0] / old[0], new[1] / old[1], 1.0]) @ K)


def downscaled_size(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return the size of an image downscaled by `factor`, each side rounded to a pixel, at least 1."""
    return max(1, int(width / factor + 0.5)), max(1, int(height / factor + 0.5))


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Tell whether two sizes (width, height) have the same ratio of sides, to rounding by two pixels."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= 2 * max(*size, *other)
