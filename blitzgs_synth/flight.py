# SPDX-License-Identifier: Apache-2.0
"""Flight lines: lawn-mower patterns of nadir and oblique photographs over the city."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from blitzgs_synth.plan import CityOptions, Doubles, Floats, dot, transformed

FIELD_OF_VIEW = math.radians(62)  # horizontal
TILT = math.radians(45)  # of the oblique views, from straight down
OVERLAP = 0.68  # of neighbouring nadir images, along and across the line of flight
CLIMB = 1.6  # ratio of two neighbouring altitudes
_MIN_HEIGHT, _MAX_HEIGHT = 75.0, 260.0  # metres above ground


@dataclass(frozen=True)
class View:
    """A pinhole camera: pixel = K (R x + t), x right, y down, z forward, pixel centres at half integers."""

    name: str
    width: int
    height: int
    focal: float  # pixels, the same in x and y; the principal point is the image centre
    rotation: Doubles  # [3, 3] world to camera
    centre: Doubles  # [3] metres

    @property
    def translation(self) -> Doubles:
        """Return t = -R c, [3]."""
        return -self.rotation @ self.centre

    def project(self, points: Doubles) -> tuple[Doubles, Doubles]:
        """Return pixels [N, 2] and depths [N] of world points [N, 3]; pixels mean nothing at depth <= 0."""
        camera = transformed(self.rotation, (points - self.centre).T)
        depth = camera[:, 2]
        safe = np.where(depth > 1e-6, depth, 1.0)
        pixels = camera[:, :2] / safe[:, None] * self.focal + np.array([self.width, self.height]) / 2
        return pixels, depth

    def directions(self, pixels: Floats) -> Floats:
        """Return unit world directions [N, 3] through pixel positions [N, 2], in the precision of these."""
        camera = np.ones((3, len(pixels)), pixels.dtype)
        camera[0] = (pixels[:, 0] - self.width / 2) / self.focal
        camera[1] = (pixels[:, 1] - self.height / 2) / self.focal
        camera /= np.sqrt(dot(camera, camera))
        return transformed(self.rotation.T.astype(pixels.dtype), camera)


def flight_height(options: CityOptions) -> float:
    """Return the lowest height above ground, in metres, at which nadir images have the wanted overlap."""
    nadir = max(_shares(options.views - round(options.oblique * options.views), options.altitudes)[0], 1)
    spacing = options.extent / math.sqrt(nadir)
    footprint = spacing / (1 - OVERLAP)
    side = math.sqrt(options.width * options.height) / options.width  # of the image, mean of both edges
    return float(np.clip(footprint / (2 * math.tan(FIELD_OF_VIEW / 2) * side), _MIN_HEIGHT, _MAX_HEIGHT))


def plan_flight(options: CityOptions) -> list[View]:
    """Return the views of a capture in flying order: nadir lines, then oblique lines in four headings.

    With several altitudes each of these is flown at the lowest first.
    """
    rng = np.random.default_rng([options.seed, 4])
    lowest, focal = flight_height(options), 0.5 * options.width / math.tan(FIELD_OF_VIEW / 2)
    oblique = round(options.oblique * options.views)
    per_heading = [oblique // 4 + (k < oblique % 4) for k in range(4)]
    passes = [("nadir", 0.0, 0.0, options.views - oblique)]
    passes += [(f"oblique_{'nesw'[k]}", k * math.pi / 2, TILT, n) for k, n in enumerate(per_heading)]
    views: list[View] = []
    for label, heading, tilt, total in passes:
        forward = np.array([math.sin(heading), math.cos(heading)])
        for level, count in enumerate(_shares(total, options.altitudes)):
            height = lowest * CLIMB**level
            # The outermost images reach half a footprint past their centre: up to the edge of the city.
            flown = max(options.extent - 0.6 * height, 0.5 * options.extent)
            # Oblique cameras fly behind the point that they look at.
            back = height * math.tan(tilt)
            for position in _lawn_mower(count, flown):
                ground = position + rng.normal(0, 0.01 * height, 2)
                centre = np.array([*(ground - back * forward), height * (1 + rng.normal(0, 0.01))])
                angles = np.array([heading, tilt, 0.0]) + rng.normal(0, math.radians(1.2), 3)
                name = f"{len(views):05d}_{label}.jpg"
                rotation = _rotation(*angles.tolist())
                views.append(View(name, options.width, options.height, focal, rotation, centre))
    return views


def _shares(count: int, altitudes: int) -> list[int]:
    weights = CLIMB ** (-2.0 * np.arange(altitudes))
    ends = np.rint(count * np.cumsum(weights) / weights.sum()).astype(int)
    return [int(share) for share in np.diff(ends, prepend=0)]


def _lawn_mower(count: int, extent: float) -> list[Doubles]:
    """Return `count` positions [2] over a square, line by line, every other line flown backwards."""
    if count == 0:
        return []
    lines = max(1, round(math.sqrt(count)))
    per_line = [count // lines + (k < count % lines) for k in range(lines)]
    positions = []
    for line, stops in enumerate(per_line):
        y = extent * ((line + 0.5) / lines - 0.5)
        along = extent * ((np.arange(stops) + 0.5) / stops - 0.5)
        positions += [np.array([x, y]) for x in (along if line % 2 == 0 else along[::-1])]
    return positions


def _rotation(yaw: float, tilt: float, roll: float) -> Doubles:
    """Return world-to-camera of a camera heading `yaw` clockwise from north, tilted up from straight down."""
    heading = np.array([math.sin(yaw), math.cos(yaw), 0.0])
    right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    forward = math.sin(tilt) * heading - math.cos(tilt) * np.array([0.0, 0.0, 1.0])
    down = np.cross(forward, right)
    c, s = math.cos(roll), math.sin(roll)
    return np.stack([c * right + s * down, -s * right + c * down, forward])
