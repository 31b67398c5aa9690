# SPDX-License-Identifier: Apache-2.0
"""The plan of the city: gently bent streets, and the use of each block between them.

Everything is laid out in straight *plan* coordinates (metres, x east, y north) and bent into the world last,
so that blocks stay rectangles for the builders while the streets the cameras see are curved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from blitzgs_synth.arrays import Bools, Doubles, Floats, Ints
from blitzgs_synth.options import CityOptions

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1

SIDEWALK = 2.6  # metres from the kerb to the block
URBAN, HOUSES, PARK, TOWERS, PLAZA, RETAIL = range(6)
_SHARES = {URBAN: 0.36, HOUSES: 0.30, PARK: 0.10, TOWERS: 0.10, PLAZA: 0.05, RETAIL: 0.09}


@dataclass(frozen=True)
class Streets:
    """Parallel streets, ascending: positions of their centre lines and half widths, in metres."""

    centres: Floats  # [S]
    halves: Floats  # [S]
    main: Bools  # [S] whether a street is wide; wide streets go on beyond the city

    def nearest(self, coordinate: Floats) -> tuple[Floats, Ints]:
        """Return signed distances [R] to the nearest centre line and its index [R]."""
        middles = (self.centres[1:] + self.centres[:-1]) / 2
        index = np.searchsorted(middles, coordinate)
        return coordinate - self.centres[index], index


class Plan:
    """Streets and blocks of one city, and the bend between plan and world."""

    def __init__(self, options: CityOptions) -> None:
        self.options = options
        self.half = options.extent / 2
        rng = np.random.default_rng([options.seed, 1])
        self.along_y = _streets(options.extent, rng)  # centre lines x = constant
        self.along_x = _streets(options.extent, rng)  # centre lines y = constant
        self.kinds = self._choose_kinds(rng)
        self._length = float(np.clip(options.extent, 120, 700)) * rng.uniform(0.9, 1.2, 2)
        self._swing = 0.02 * self._length
        self._phase = rng.uniform(0, 2 * math.pi, 2)

    def _choose_kinds(self, rng: np.random.Generator) -> Ints:
        """Draw a use for each block; every city gets a park, towers, houses and a plaza near its middle."""
        shape = (len(self.along_y.centres) - 1, len(self.along_x.centres) - 1)
        kinds = rng.choice(list(_SHARES), size=shape, p=list(_SHARES.values()))
        centre = (np.array(shape) - 1) / 2
        cells = sorted(np.ndindex(*shape), key=lambda c: float(np.hypot(*(np.array(c) - centre))))
        for cell, kind in zip(cells, (PLAZA, PARK, TOWERS, URBAN, HOUSES, URBAN, RETAIL), strict=False):
            kinds[cell] = kind
        return kinds

    def block(self, i: int, j: int) -> Rectangle:
        """Return block (i, j) inside its sidewalks, in plan metres."""
        x, y = self.along_y, self.along_x
        return (
            float(x.centres[i] + x.halves[i]) + SIDEWALK,
            float(y.centres[j] + y.halves[j]) + SIDEWALK,
            float(x.centres[i + 1] - x.halves[i + 1]) - SIDEWALK,
            float(y.centres[j + 1] - y.halves[j + 1]) - SIDEWALK,
        )

    def bend(self, points: Doubles) -> Doubles:
        """Return plan points [..., 3] moved into the world."""
        k = 2 * math.pi / self._length
        bent = points.copy()
        bent[..., 0] += self._swing[0] * np.sin(k[0] * bent[..., 1] + self._phase[0])
        bent[..., 1] += self._swing[1] * np.sin(k[1] * bent[..., 0] + self._phase[1])
        return bent

    def unbend(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the plan coordinates of world positions; the exact inverse of `bend`."""
        k = (2 * math.pi / self._length).astype(np.float32)
        swing, phase = self._swing.astype(np.float32), self._phase.astype(np.float32)
        y = y - swing[1] * np.sin(k[1] * x + phase[1])
        return x - swing[0] * np.sin(k[0] * y + phase[0]), y


def _streets(extent: float, rng: np.random.Generator) -> Streets:
    count = max(2, round(extent / 48)) + 1
    gaps = rng.uniform(0.8, 1.25, count - 1)
    centres = extent * (np.concatenate([[0], np.cumsum(gaps) / gaps.sum()]) - 0.5)
    main = np.zeros(count, bool)
    main[int(rng.integers(1, min(3, count - 1))) :: 4] = True
    halves = np.where(main, 6.5, rng.uniform(3.6, 4.4, count))
    return Streets(centres.astype(np.float32), halves.astype(np.float32), main)
