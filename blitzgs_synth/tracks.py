# SPDX-License-Identifier: Apache-2.0
"""Imitates structure from motion: matches corners over views and triangulates them with plausible errors.

Corners are detected in the photographs, placed on the surface by a ray, and tracked into every view that
sees them: the corner projects into the image, a ray finds nothing in front of it, and the angle differs
little. Observations are off by a fraction of a pixel. A point has the error that triangulating such
observations gives; along the line of sight it grows with distance squared over baseline. A few points
are off by metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from blitzgs_synth.flight import View
from blitzgs_synth.mesh import LEAVES
from blitzgs_synth.plan import Bools, Bytes, Doubles, Ints, transformed
from blitzgs_synth.render import City

PIXEL_NOISE: Final = 0.35  # standard deviation of an observation, pixels
_MIN_TRACK: Final = 3
_OUTLIERS: Final = 0.004  # fraction of points off by metres
_MISSED: Final = 0.25  # fraction of the possible observations that a matcher does not find
_SAME_PLACE: Final = 0.0015  # relative depth difference below which a ray reached the point
_BORDER: Final = 2.0  # pixels: corners nearer to the edge of the image are not found


@dataclass(frozen=True)
class Corners:
    """Corners of one view that lie on the city."""

    pixels: Doubles  # [N, 2]
    positions: Doubles  # [N, 3] world metres, true
    directions: Doubles  # [N, 3] unit, from the camera
    colors: Bytes  # [N, 3]


@dataclass(frozen=True)
class Cloud:
    """M points with tracks over V views; the observations are sorted by view, then point."""

    positions: Doubles  # [M, 3] as triangulated
    colors: Bytes  # [M, 3]
    views: Ints  # [O]
    points: Ints  # [O]
    pixels: Doubles  # [O, 2]
    loose: list[Doubles]  # per view: corners without a point [*, 2]


def find_corners(city: City, view: View, image: Bytes, count: int, seed: int) -> Corners:
    """Return up to `count` of the strongest corners of a photograph [H, W, 3] (RGB) and where they are."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    apart = 0.45 * np.sqrt(gray.size / count)
    found = cv2.goodFeaturesToTrack(gray, count, qualityLevel=0.004, minDistance=float(max(2.0, apart)))
    # A corner at integer coordinates is at the centre of its pixel.
    pixels = np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5
    rng = np.random.default_rng([seed, 6, len(pixels)])
    pixels = pixels + rng.uniform(-0.5, 0.5, pixels.shape)
    size = np.array([view.width, view.height])
    pixels = pixels[((pixels > _BORDER) & (pixels < size - _BORDER)).all(1)]
    directions = view.directions(pixels)
    hits = city.hit(view, pixels)
    on_city = hits.triangle >= 0
    # Leaves move in the wind and look different from each view, so few of their corners are matched.
    leaves = city.mesh.material[city.mesh.surface[hits.triangle]] == LEAVES
    on_city &= ~leaves | (rng.random(len(pixels)) < 0.3)
    pixels, directions = pixels[on_city], directions[on_city]
    nearest = pixels.astype(np.int64)
    return Corners(
        pixels=pixels,
        positions=view.centre + hits.distance[on_city, None].astype(np.float64) * directions,
        directions=directions,
        colors=image[nearest[:, 1], nearest[:, 0]],
    )


# Returns a function's values at 0, 1, ..., count - 1.
Mapper = Callable[[Callable[[int], Ints], int], Iterable[Ints]]


def track(city: City, views: list[View], corners: list[Corners], seed: int, run: Mapper) -> Cloud:
    """Return the cloud of all corners, of each view, that are seen in three views or more.

    `run` applies a function to all view indices and yields the results in order; it may run concurrently.
    """
    positions = np.concatenate([c.positions for c in corners])
    directions = np.concatenate([c.directions for c in corners])
    colors = np.concatenate([c.colors for c in corners])
    starts = np.cumsum([0] + [len(c.pixels) for c in corners])
    source = np.repeat(np.arange(len(views)), np.diff(starts))
    balls = np.stack([ball(c.positions) for c in corners])

    def seen(index: int) -> Ints:
        near = np.flatnonzero(may_see(views[index], balls))
        groups = [np.arange(starts[k], starts[k + 1]) for k in near]
        rows = np.concatenate([np.zeros(0, np.int64), *groups])
        own = source[rows] == index
        found = _observed(city, views[index], positions[rows], directions[rows], own, [seed, 7, index])
        return rows[found]

    lists = list(run(seen, len(views)))
    view_ids = np.repeat(np.arange(len(views)), [len(x) for x in lists])
    point_ids = np.concatenate(lists)
    long_enough = np.bincount(point_ids, minlength=len(positions)) >= _MIN_TRACK
    kept = long_enough[point_ids]
    view_ids, point_ids = view_ids[kept], (np.cumsum(long_enough) - 1)[point_ids[kept]]

    rng = np.random.default_rng([seed, 8])
    positions = positions[long_enough]
    in_view = np.split(point_ids, np.cumsum(np.bincount(view_ids, minlength=len(views)))[:-1])
    pixels = np.concatenate([v.project(positions[ids])[0] for v, ids in zip(views, in_view, strict=True)])
    loose = [c.pixels[~long_enough[a:b]] for c, a, b in zip(corners, starts[:-1], starts[1:], strict=True)]
    return Cloud(
        positions=_triangulated(positions, views, view_ids, point_ids, rng),
        colors=colors[long_enough],
        views=view_ids,
        points=point_ids,
        pixels=pixels + rng.normal(0, PIXEL_NOISE, pixels.shape),
        loose=loose,
    )


def ball(points: Doubles) -> Doubles:
    """Return centre and radius [4] of a ball around points [N, 3]; without points the radius is -inf."""
    if len(points) == 0:
        return np.array([0, 0, 0, -np.inf])
    centre = (points.min(0) + points.max(0)) / 2
    return np.append(centre, np.linalg.norm(points - centre, axis=1).max())


def may_see(view: View, balls: Doubles) -> Bools:
    """Return which balls [B, 4] reach into the pyramid of a view; conservative near its corners."""
    x, y, z = transformed(view.rotation, (balls[:, :3] - view.centre).T).T
    half = np.array([view.width, view.height]) / (2 * view.focal)
    outside = np.stack([np.abs(x) - half[0] * z, np.abs(y) - half[1] * z]) / np.hypot(half, 1)[:, None]
    return np.maximum(outside.max(0), -z) < balls[:, 3]


def _observed(
    city: City, view: View, positions: Doubles, directions: Doubles, own: Bools, seed: list[int]
) -> Ints:
    """Return which points [N] a matcher finds in a view, ascending."""
    pixels, depth = view.project(positions)
    size = np.array([view.width, view.height])
    candidates = np.flatnonzero((depth > 0.1) & ((pixels > _BORDER) & (pixels < size - _BORDER)).all(1))
    offset = positions[candidates] - view.centre
    distance = np.linalg.norm(offset, axis=1)
    # Descriptors tolerate about 40° of change in the line of sight.
    agreement = (offset / distance[:, None] * directions[candidates]).sum(1)
    chance = np.random.default_rng(seed).random(len(positions))[candidates]
    found = (chance > _MISSED) & (agreement > np.cos(np.deg2rad(40)) + 0.1 * chance) | own[candidates]
    candidates, distance = candidates[found], distance[found]
    hits = city.hit(view, pixels[candidates])
    visible = np.abs(hits.distance - distance) < _SAME_PLACE * distance
    return candidates[visible | own[candidates]]


def _triangulated(
    positions: Doubles, views: list[View], view_ids: Ints, point_ids: Ints, rng: np.random.Generator
) -> Doubles:
    """Return positions [M, 3] with the errors of triangulating noisy observations, and a few outliers."""
    count = np.maximum(np.bincount(point_ids, minlength=len(positions)), 1)[:, None]
    centres = np.stack([v.centre for v in views])
    mean, square = np.zeros_like(positions), np.zeros_like(positions)
    np.add.at(mean, point_ids, centres[view_ids])
    np.add.at(square, point_ids, centres[view_ids] ** 2)
    mean, square = mean / count, square / count
    baseline = np.sqrt(np.maximum((square - mean**2).sum(1, keepdims=True), 1e-12))
    sight = positions - mean
    distance = np.linalg.norm(sight, axis=1, keepdims=True)
    sight /= distance
    across = PIXEL_NOISE * distance / views[0].focal / np.sqrt(count)
    along = across * np.clip(distance / baseline, 1, 20)
    noise = across * rng.standard_normal(positions.shape)
    noise += along * rng.standard_normal((len(positions), 1)) * sight
    wrong = rng.random((len(positions), 1)) < _OUTLIERS
    noise += wrong * sight * distance * rng.uniform(-0.25, 0.1, (len(positions), 1))
    return positions + noise
