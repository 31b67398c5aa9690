# SPDX-License-Identifier: Apache-2.0
"""The lengths of a capture, measured so that one wrong camera or point does not decide on them.

Every comparison is between lengths of the capture, and every share is of a rank, so a capture scaled by a
power of two has the same lengths, scaled exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import Camera, Float64, SourceView, camera_centres
from blitzgs.util.errors import warn

# Cameras whose distance is below this share of the points' distance count as being in one place: the parallax
# between them is far below a pixel.
LEAST_SPREAD = 1e-6
# A camera is apart from the others if it is so many times farther from their middle than the farthest of
# them, and than the points are. Without points, nothing tells an overview from a pose that is wrong.
_GAP, _GAP_WITHOUT_POINTS = 5.0, 20.0
# A camera that is apart and shows the points on less than this share of its image's sides has a wrong pose:
# its photograph would teach the model nothing but the colour of a few pixels.
_LEAST_SHOWN = 0.05
# An overview from afar is no wrong pose, but does not decide on lengths where it is one of few.
_MAX_APART = 0.1
# A fraction of the depth of the nearest points that views see. Gaussians grow between the points and the
# cameras, and what is so near to a camera is a defect of the model.
_NEAR_OF_DEPTH = 0.25
# The near plane is at most this share of the extent, as with model.near = 0.01.
NEAR_OF_EXTENT = 0.01
# The points in front of a view that are skipped, and the views, as shares: some points are wrong.
_SKIPPED_POINTS, _SKIPPED_VIEWS = 0.02, 0.01
# Pairs of a view and a point that are projected, and the least number of points.
_PAIRS, _LEAST_POINTS = 10_000_000, 2000


@dataclass(frozen=True)
class StrayCamera:
    """A camera that lies apart from all others and hardly shows a point: its pose is wrong."""

    name: str
    distance: float  # from the middle of all cameras, in world units
    others: float  # largest such distance of the cameras that are together


def sampled(points: npt.NDArray[Any], views: int) -> npt.NDArray[Any]:
    """Return so many of the points [M, 3], or colours, that all views can be compared with them quickly."""
    count = max(_LEAST_POINTS, _PAIRS // max(1, views))
    return points[:: max(1, -(-len(points) // count))]


def find_apart(
    views: Sequence[SourceView], points: Float64
) -> tuple[npt.NDArray[np.bool_], list[StrayCamera]]:
    """Find the cameras that must not decide on lengths, and those of them whose pose is wrong.

    Poses are finite, and points [M, 3] are in the same world. Returns whether each view must not decide on
    lengths [V], and the cameras whose pose is wrong.
    """
    centres = camera_centres(np.stack([view.world_to_camera for view in views]))
    middle = np.median(centres, axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    sample = sampled(points, len(views))
    scene = float(np.median(np.linalg.norm(sample - middle, axis=1))) if len(sample) else 0.0
    order = np.argsort(distances, kind="stable")
    ranked = distances[order]
    begin = (len(views) + 1) // 2  # at least half of the cameras are together
    before = np.maximum(ranked[begin - 1 : -1], scene)
    gap = _GAP if len(sample) else _GAP_WITHOUT_POINTS
    gaps = np.flatnonzero((ranked[begin:] > gap * before) & (before > 0))
    apart = np.zeros(len(views), dtype=bool)
    if len(gaps) == 0:
        return apart, []
    first = begin + int(gaps[0])
    strays = [
        StrayCamera(views[i].name, float(distances[i]), float(ranked[first - 1]))
        for i in sorted(order[first:].tolist())
        if len(sample) == 0 or _shown(views[i], sample) < _LEAST_SHOWN
    ]
    names = {stray.name for stray in strays}
    apart[[i for i in order[first:] if views[i].name in names]] = True
    overviews = [i for i in order[first:] if views[i].name not in names]
    if len(overviews) <= _MAX_APART * len(views):
        apart[overviews] = True
    return apart, strays


def _shown(view: SourceView, points: Float64) -> float:
    """Return the share of an image's sides on which a view shows the inner 90 % of what it sees."""
    pixels = view.pixels_of(points)
    if len(pixels) < 2:
        return 0.0
    spans = np.subtract(*np.quantile(pixels, [0.95, 0.05], axis=0)) / [view.lens.width, view.lens.height]
    return float(spans.max())


def points_seen(camera: Camera, points: Float64) -> tuple[npt.NDArray[np.int64], Float64]:
    """Return which re-centred points [M, 3] a camera sees, occluded ones too, and x, y, depth [3, S]."""
    x, y, depth = camera.world_to_camera[:3, :3] @ points.T + camera.world_to_camera[:3, 3:]
    front = np.flatnonzero(depth > 0)
    x, y, depth = x[front], y[front], depth[front]
    x = camera.K[0, 0] * x / depth + camera.K[0, 2]
    y = camera.K[1, 1] * y / depth + camera.K[1, 2]
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return front[inside], np.stack([x, y, depth])[:, inside]


def depths_seen(camera: Camera, points: Float64) -> Float64:
    """Return the depths of the re-centred points [M, 3] that a camera sees, occluded ones too, unordered."""
    return np.asarray(points_seen(camera, points)[1][2])


def nearest_depths(cameras: Sequence[Camera], points: Float64) -> Float64:
    """Return the depth [V] of the nearest re-centred points [M, 3] that each view sees, by a sample of them.

    The nearest 2 % are skipped; infinite for a view that sees none.
    """
    sample = sampled(points, len(cameras))
    nearest = np.full(len(cameras), np.inf)
    for index, camera in enumerate(cameras):
        depths = depths_seen(camera, sample)
        if len(depths):
            # At least one point is skipped where there are several.
            rank = min(len(depths) - 1, max(1, int(_SKIPPED_POINTS * len(depths))))
            nearest[index] = np.partition(depths, rank)[rank]
    return nearest


def blind_views(nearest: Float64, cameras: Sequence[Camera], points: Float64) -> int:
    """Return how many views see none of the points; warn if most do, and name the first."""
    blind = [camera.name for camera, depth in zip(cameras, nearest, strict=True) if np.isinf(depth)]
    if 2 * len(blind) > len(cameras):
        warn(
            f"{len(blind)} of {len(cameras)} views (first: {blind[0]}) see none of the points: do the poses "
            "and the points belong together, and do the cameras look along +z?"
        )
    if len(blind) == len(cameras):  # a view may see points that are not in the sample
        some = cameras[:: max(1, len(cameras) // 64)]
        return len(blind) - sum(len(depths_seen(camera, points)) > 0 for camera in some)
    return len(blind)


def near_plane(nearest: Float64, extent: float) -> float:
    """Return a near plane: less than the depths that views see, and at most 0.01 x the extent."""
    most = NEAR_OF_EXTENT * extent
    depths = np.sort(nearest[np.isfinite(nearest)])
    if len(depths) == 0:
        return most
    near = min(most, _NEAR_OF_DEPTH * float(depths[int(_SKIPPED_VIEWS * len(depths))]))
    lost = int((depths <= most).sum())
    if 2 * lost > len(depths):
        # The cameras are spread over far more than they are away from what they show, as along a street.
        warn(
            f"{lost} of {len(depths)} views begin to see points at less than {NEAR_OF_EXTENT:g} x the extent "
            f"({most:.4g}), so the near plane is at {near:.4g}; model.near sets another"
        )
    return near


def measured_extent(centres: Float64, points: Float64) -> float:
    """Return a scene's extent (`Capture.extent`) by its training cameras [V, 3] and points [M, 3]."""
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    distance = float(np.median(np.linalg.norm(sampled(points, len(centres)) - centres[0], axis=1)))
    if extent > LEAST_SPREAD * distance:
        return extent
    extent = distance
    warn(f"all training cameras are in one place: extent is the points' median distance, {extent:g}")
    return extent or 1.0
