# SPDX-License-Identifier: Apache-2.0
"""Parameters of a city and its plan: gently bent streets, and the use of each block between them.

Everything is laid out in straight *plan* coordinates (metres, x east, y north) and bent into the world last,
so that blocks stay rectangles for the builders while the streets the cameras see are curved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

# float32 on the way of every sample: numpy's stubs cannot follow the precision through arithmetic.
Floats = NDArray[Any]
Doubles = NDArray[np.float64]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def dot(a: Floats, b: Floats) -> Floats:
    """Return the inner products [R] of columns [3, R], or of one vector [3] with each column."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def transformed(matrix: Floats, columns: Floats) -> Floats:
    """Return the products of a matrix [3, 3] with each column of [3, R], as rows [R, 3].

    NumPy's `@` would use BLAS, which starts a thread for each core. In every process of a generation these
    threads wait for each other in loops, and all processes together are then less than half as fast.
    """
    rows = np.empty((columns.shape[1], 3), np.result_type(matrix, columns))
    for i in range(3):
        rows[:, i] = dot(matrix[i], columns)
    return rows


# Raised whenever the same parameters would give other files, so that cached cities are made anew.
FORMAT_VERSION = 3
# Fields that the first cities of this version did not have.
_LATER = ("built", "grain", "exposure", "altitudes")


def _option(default: float, low: float, high: float, text: str) -> Any:
    return field(default=default, metadata={"limits": (low, high), "help": text})


@dataclass(frozen=True)
class CityOptions:
    """Parameters of a synthetic city, with their limits and texts; the same values give the same files.

    The views that are not oblique look straight down; the oblique ones do so at 45°, in four headings. Each
    altitude is 1.6 times the one below it and has, for the same overlap, 1 / 1.6² of its views.
    """

    extent: float = _option(150.0, 60.0, 20_000.0, "edge of the built-up square, metres")
    views: int = _option(60, 3, 1_000_000, "number of images")
    width: int = _option(480, 32, 16_384, "image width, pixels")
    height: int = _option(320, 32, 16_384, "image height, pixels")
    points_per_view: int = _option(500, 1, 100_000, "number of feature points to search for in each image")
    oblique: float = _option(0.6, 0.0, 1.0, "fraction of oblique views, 0 to 1")
    seed: int = _option(0, 0, 2**63 - 1, "seed of all random choices")
    built: bool = _option(True, False, True, "a city; --no-built: flat farmland")
    grain: float = _option(0.0, 0.0, 64.0, "noise of the photographs, in steps of 8-bit values")
    exposure: float = _option(0.0, 0.0, 1.0, "standard deviation of the logarithm of the photographs' gains")
    altitudes: int = _option(1, 1, 8, "number of heights flown at, 1 to 8")

    def __post_init__(self) -> None:
        for each in fields(self):
            (low, high), value = each.metadata["limits"], getattr(self, each.name)
            if not low <= value <= high:
                raise ValueError(f"synthetic city: {each.name} must be between {low} and {high}, got {value}")

    def manifest(self) -> dict[str, float | int]:
        """Return the parameters that decide the files' content, for a city's manifest.

        Those added later are left out where they change nothing, so that older cities need not be made anew.
        """
        values = {
            each.name: value
            for each in fields(self)
            if (value := getattr(self, each.name)) != each.default or each.name not in _LATER
        }
        return {"format_version": FORMAT_VERSION, **values}


# Extent, views, width and height, and others by their names.
PRESETS = {
    # Takes well under a minute on two cores; the default scene of `make demo`.
    "demo": CityOptions(),
    # A quarter of a square kilometre in as many views as an aerial survey would take.
    "town": CityOptions(500.0, 400, 1368, 912, points_per_view=1000),
    # More than two square kilometres, with the views and the image size of the usual large captures.
    "city": CityOptions(1600.0, 2048, 1368, 912, points_per_view=1200),
    # Four square kilometres from three heights.
    "metropolis": CityOptions(2000.0, 5120, 1368, 912, points_per_view=1200, altitudes=3),
    # Flat crops from straight above, with grain: a capture on which training can lose what it has learnt
    # (docs/decisions.md).
    "farmland": CityOptions(600.0, 166, 800, 600, 450, oblique=0.0, built=False, grain=5.0),
}


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

    def between(self, i: int) -> tuple[float, float]:
        """Return where the sidewalks of street i and the next one end."""
        low, high = self.centres[i] + self.halves[i], self.centres[i + 1] - self.halves[i + 1]
        return float(low) + SIDEWALK, float(high) - SIDEWALK

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
        (x0, x1), (y0, y1) = self.along_y.between(i), self.along_x.between(j)
        return x0, y0, x1, y1

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
