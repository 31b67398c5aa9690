# SPDX-License-Identifier: Apache-2.0
"""Cameras of a capture: pinhole views of the re-centred world, and the steps from a file to its image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.lens import Lens
from blitzgs.capture.undistort import Rectification

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
