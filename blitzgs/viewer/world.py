# SPDX-License-Identifier: Apache-2.0
"""What a page has to know about a model, and its coordinates: trained units times a constant."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.world import WorldFrame
from blitzgs.view.views import CameraLike, Space, up_direction, viewmat

Array = npt.NDArray[np.float64]
# Page units per trained unit. The scene is then 5 to 10 page units wide; the keys move 2 a second.
SCALE = 5.0


@dataclass(frozen=True)
class Stance:
    """A camera of the page: where it is, how it is turned, and its vertical field of view in radians."""

    position: Array  # [3], page units
    rotation: Array  # camera to world, [3, 3]; the axes are right, down and forward
    fov: float  # radians

    def is_near(self, other: Stance, distance: float = 1e-3, angle: float = 0.005) -> bool:
        """Tell whether another stance differs by less than a distance (page units) and an angle (radians)."""
        cosine = (np.trace(self.rotation.T @ other.rotation) - 1) / 2
        near = np.linalg.norm(self.position - other.position) < distance
        return bool(near and math.acos(max(-1.0, min(1.0, cosine))) < angle)


class World:
    """Maps between the page's coordinates, the trained ones and those of the capture."""

    def __init__(
        self,
        space: Space,
        cameras: Sequence[CameraLike],
        box: Array,
        up: tuple[float, float, float] | None = None,
    ) -> None:
        """Find up and the middle of a scene.

        `space`: the trained world. `cameras`: the capture's; may be empty. `box`: corners of a box that holds
        nearly all Gaussians, [2, 3], trained units. `up`: the upward direction; None: the cameras tell.
        """
        self.space = space
        self.poses = [viewmat(camera, space) for camera in cameras]
        self.fovs = [2 * math.atan(camera.height / (2 * camera.K[1, 1])) for camera in cameras]
        self.centres = SCALE * camera_centres(np.stack(self.poses)) if self.poses else np.zeros((0, 3))
        self.up = up_direction(self.poses) if up is None else np.array(up) / np.linalg.norm(up)
        self.middle = SCALE * box.mean(axis=0)

    def viewmat(self, stance: Stance) -> Array:
        """Return the pose [4, 4], trained world to camera."""
        pose = np.eye(4)
        pose[:3, :3] = stance.rotation.T
        pose[:3, 3] = -stance.rotation.T @ (stance.position / SCALE)
        return pose

    def stance(self, pose: Array, fov: float) -> Stance:
        """Return the stance of a pose [4, 4], trained world to camera."""
        rotation = pose[:3, :3].T
        return Stance(-rotation @ pose[:3, 3] * SCALE, rotation.copy(), fov)

    def distance(self, stance: Stance) -> float:
        """Return how far a stance is from the middle, page units."""
        return float(np.linalg.norm(stance.position - self.middle))

    def capture_position(self, position: Array) -> Array:
        """Return a position of the page in the capture's coordinates."""
        return position / SCALE * self.space.unit + np.array(self.space.offset)

    def capture_pose(self, stance: Stance) -> Array:
        """Return the pose of a stance in the capture's coordinates, camera to world [4, 4]."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = stance.rotation, self.capture_position(stance.position)
        return pose

    def page_position(self, position: Array) -> Array:
        """Return a position of the capture in the page's coordinates."""
        return (position - np.array(self.space.offset)) / self.space.unit * SCALE

    def start(self) -> Stance:
        """Return a first stance: slanted from above the middle, from as far as the cameras are."""
        distance = 1.2 * SCALE * self.space.extent
        if self.poses:
            away = float(np.median(np.linalg.norm(self.centres - self.middle, axis=1)))
            distance = 1.3 * min(max(away, 0.2), distance)
        _, north = horizontal(self.up)
        position = self.middle + distance * (0.6 * self.up - 0.8 * north)
        return looking(position, self.middle, self.up, math.radians(50))


def horizontal(up: Array) -> tuple[Array, Array]:
    """Return two directions across `up`, at right angles; for the z axis, x and y."""
    east = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0, 1.0, 0])
    east -= up * (east @ up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def looking(position: Array, target: Array, up: Array, fov: float) -> Stance:
    """Return the stance at a position that looks at a target, with `up` upwards in the image."""
    forward = (target - position) / max(1e-12, float(np.linalg.norm(target - position)))
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(up, 1))
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Stance(position.astype(np.float64), rotation, fov)


@dataclass(frozen=True)
class Exhibit:
    """A model or a training to show."""

    title: str  # shown on the page
    space: Space  # maps the trained world to the capture's
    sh_degree: int  # highest spherical-harmonics degree
    background: tuple[float, float, float]  # RGB in [0, 1]
    levels: bool  # whether the Gaussians have octree levels
    lod: bool  # whether the model has an LOD gate
    smooth: bool  # whether its levels fade
    # Corners of a box that holds nearly all Gaussians, float64 [2, 3], trained units.
    box: npt.NDArray[np.float64]
    cameras: Sequence[CameraLike] = ()  # the capture's cameras
    up: tuple[float, float, float] | None = None  # upward direction; None: the cameras tell
    test: Sequence[int] = ()  # indices of those that are held out
    # Returns the photograph of a camera, uint8 [H, W, 3]; None: there are none.
    photograph: Callable[[int], npt.NDArray[np.uint8]] | None = None
    # Gain and bias of photographs by their cameras, float64 [2, 3]; empty: the model has none.
    exposures: dict[int, npt.NDArray[np.float64]] = field(default_factory=dict)
    paths: Path = field(default_factory=lambda: Path("paths"))  # folder for camera paths and screenshots
    frame: WorldFrame | None = None  # where the capture lies in the world; None: unknown
