# SPDX-License-Identifier: Apache-2.0
"""Camera paths that are made from a scene: a circle, a flight over it, a way along its cameras."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from blitzgs.capture.cameras import camera_centres
from blitzgs.viewer.paths import CameraPath, Keyframe
from blitzgs.viewer.world import SCALE, Array, Stance, World, horizontal, looking

Tour = Literal["orbit", "flight", "spline"]
TOURS: tuple[Tour, ...] = get_args(Tour)
# Keyframes of a circle and of a spline.
_CIRCLE, _STATIONS = 48, 24
# A flight looks at most so steeply down, so that the horizon's side of the scene is in the picture.
_STEEPEST = math.radians(35)
# Cameras that look down less than this look at no point on the ground nearby.
_FLAT = math.radians(10)


def tour(kind: Tour, world: World, fovs: list[float]) -> CameraPath:
    """Make a path.

    - "orbit": once around the scene's middle, as high and as far as the median camera.
    - "flight": straight across the middle, along the longest extent of the cameras, at their median height;
      looks ahead, as far down as the cameras do, but at most 35 degrees.
    - "spline": a smooth way through up to 24 cameras, in the order of their names.

    Args:
        kind: which one.
        world: of the scene; its poses are those of the cameras.
        fovs: vertical fields of view of these cameras, radians.

    Raises:
        ValueError: a flight or a spline needs two cameras.
    """
    if kind != "orbit" and len(world.poses) < 2:
        raise ValueError(f"--path {kind} needs the cameras of a capture: use orbit, or the file of a path")
    fov = float(np.median(fovs)) if fovs else world.start().fov
    if kind == "orbit":
        stances = _orbit(world, fov)
    elif kind == "flight":
        stances = _flight(world, fov)
    else:
        chosen = np.unique(np.linspace(0, len(world.poses) - 1, _STATIONS).round().astype(int))
        stances = [world.stance(world.poses[index], fovs[index]) for index in chosen]
    return CameraPath([_key(world, stance) for stance in stances], seconds=10.0, is_cycle=kind == "orbit")


def _key(world: World, stance: Stance) -> Keyframe:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = stance.rotation, world.capture_position(stance.position)
    return Keyframe(pose, math.degrees(stance.fov), 16 / 9)


def _centres(world: World) -> Array:
    return SCALE * camera_centres(np.stack(world.poses))


def _orbit(world: World, fov: float) -> list[Stance]:
    arms = _centres(world) - world.middle if world.poses else (world.start().position - world.middle)[None]
    heights = arms @ world.up
    flat = np.linalg.norm(arms - heights[:, None] * world.up, axis=1)
    height = float(np.median(heights))
    # Cameras straight above the middle would leave no circle.
    radius = max(float(np.median(flat)), 0.7 * abs(height))
    east, north = horizontal(world.up)
    angles = np.arange(_CIRCLE) * 2 * math.pi / _CIRCLE
    places = [
        world.middle + radius * (math.cos(angle) * east + math.sin(angle) * north) + height * world.up
        for angle in angles
    ]
    return [looking(place, world.middle, world.up, fov) for place in places]


def _flight(world: World, fov: float) -> list[Stance]:
    arms = _centres(world) - world.middle
    heights = arms @ world.up
    flat = arms - heights[:, None] * world.up
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    ahead = axes[0] - world.up * (axes[0] @ world.up)
    ahead /= np.linalg.norm(ahead)
    ends = np.quantile(flat @ ahead, (0.1, 0.9))
    height = float(np.median(heights))
    slopes = [math.asin(float(np.clip(pose[2, :3] @ world.up, -1, 1))) for pose in world.poses]
    slope = max(-_STEEPEST, min(0.0, float(np.median(slopes))))
    view = ahead * math.cos(slope) + world.up * math.sin(slope)
    # The point on the ground that the camera looks at goes from end to end.
    behind = height / math.tan(-slope) if height > 0 and slope < -_FLAT else 0.0
    places = [world.middle + (along - behind) * ahead + height * world.up for along in ends]
    return [looking(place, place + view, world.up, fov) for place in places]
