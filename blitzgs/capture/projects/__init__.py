# SPDX-License-Identifier: Apache-2.0
"""Projects of photogrammetry programs as captures, one file for each program.

Here is what their readers have in common. All raise ValueError for what is damaged, missing or not supported;
it names the place in the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from blitzgs.capture.cameras import Float64, nearest_rotation
from blitzgs.capture.lens import Lens
from blitzgs.capture.points import SourcePoints
from blitzgs.capture.world import WorldFrame

# A lens, or a function of the image's width and height if the file gives lengths as shares of them.
LensOf = Lens | Callable[[int, int], Lens]


@dataclass(frozen=True, eq=False)
class ProjectView:
    """A photograph with a pose: its name as the project writes it, lens, and world to camera [4, 4].

    The camera looks along +z, with x right and y down, and the centre of pixel (i, j) is (i + 0.5, j + 0.5).
    """

    name: str
    lens: LensOf
    world_to_camera: Float64


@dataclass(eq=False)
class Project:
    """The content of a project; `lost` counts photographs without a pose, `notes` say what has no effect.

    `crs` is the reference system of points that are exported beside it, if that is not the frame's.
    """

    views: list[ProjectView]
    points: SourcePoints | None = None
    frame: WorldFrame | None = None
    lost: int = 0
    notes: list[str] = field(default_factory=list)
    crs: str = ""


def rotation_of(matrix: Float64) -> Float64:
    """Return the rotation that a matrix [3, 3] is to rounding (else ValueError); NaN stays."""
    is_one = np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4) and np.linalg.det(matrix) > 0
    if not is_one and not np.isnan(matrix).any():
        raise ValueError(f"no rotation: {np.round(matrix, 6).tolist()}; export the project again")
    return nearest_rotation(matrix)


def turn(axis: str, degrees: float) -> Float64:
    """Return the rotation [3, 3] about an axis, "x", "y" or "z"."""
    about = np.eye(3)["xyz".index(axis)]
    return np.asarray(cv2.Rodrigues(np.radians(degrees) * about)[0])


def made_lens(model: str, size: tuple[int, int], *params: float) -> Lens:
    """Return a lens for images of a width and height."""
    return Lens(model, *size, tuple(map(float, params)))
