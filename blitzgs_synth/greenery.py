# SPDX-License-Identifier: Apache-2.0
"""Trees, hedges, cars and street furniture, in plan coordinates."""

from __future__ import annotations

from typing import Final

import numpy as np

from blitzgs_synth.mesh import LEAVES, PAINT, PLAIN, TILES, Color, Look, MeshBuilder
from blitzgs_synth.plan import Rectangle

Rng = np.random.Generator

_LEAVES: Final[list[Color]] = [
    (0.075, 0.16, 0.035),
    (0.11, 0.19, 0.045),
    (0.06, 0.13, 0.04),
    (0.15, 0.20, 0.05),
    (0.09, 0.15, 0.06),
]
_BARK: Final = Look(PLAIN, (0.16, 0.11, 0.07))
_PAINTS: Final[list[Color]] = [
    (0.75, 0.75, 0.76),
    (0.42, 0.43, 0.45),
    (0.05, 0.05, 0.06),
    (0.50, 0.04, 0.03),
    (0.05, 0.11, 0.30),
    (0.80, 0.79, 0.74),
    (0.14, 0.15, 0.17),
    (0.10, 0.20, 0.12),
]


def tree(b: MeshBuilder, x: float, y: float, height: float, rng: Rng) -> None:
    """Add a tree: a trunk and a crown of a few bumpy blobs, or a slim conifer now and then."""
    t = 0.03 * height + 0.06
    b.walls(x - t, y - t, x + t, y + t, 0, 0.5 * height, _BARK)
    r, g, blue = np.array(_LEAVES[int(rng.integers(len(_LEAVES)))]) * rng.uniform(0.8, 1.25)
    color = (float(r), float(g), float(blue))

    def look() -> Look:
        return Look(LEAVES, color, float(rng.uniform(0, 6)))

    if rng.random() < 0.15:
        for level, radius in ((0.35, 0.21), (0.58, 0.155), (0.8, 0.09)):
            b.blob((x, y, level * height), (radius * height, radius * height, 0.2 * height), look())
        return
    wide = float(rng.uniform(0.26, 0.36)) * height
    b.blob((x, y, 0.64 * height), (wide, wide, 0.34 * height), look())
    for _ in range(2):
        dx, dy = rng.uniform(-0.55, 0.55, 2) * wide
        small = wide * float(rng.uniform(0.6, 0.75))
        z = height * float(rng.uniform(0.52, 0.78))
        b.blob((x + float(dx), y + float(dy), z), (small, small, 0.85 * small), look())


def trees(
    b: MeshBuilder, area: Rectangle, count: int, heights: tuple[float, float], rng: Rng, apart: float = 3.0
) -> None:
    """Scatter up to `count` trees over a rectangle, at least `apart` metres from each other."""
    x0, y0, x1, y1 = area
    if x1 - x0 < 1 or y1 - y0 < 1:
        return
    placed = np.empty((0, 2))
    for _ in range(3 * count):
        spot = rng.uniform((x0, y0), (x1, y1))
        height = float(rng.uniform(*heights))
        if len(placed) < count and (((placed - spot) ** 2).sum(1) > apart**2).all():
            placed = np.vstack([placed, spot])
            tree(b, float(spot[0]), float(spot[1]), height, rng)


def hedge(b: MeshBuilder, x0: float, y0: float, x1: float, y1: float, rng: Rng) -> None:
    """Add a clipped hedge along an axis-aligned line."""
    look = Look(LEAVES, (0.07, 0.14, 0.04), float(rng.uniform(0, 6)))
    length = max(x1 - x0, y1 - y0)
    for along in np.arange(0.5, length, 1.1):
        x, y = (x0 + along, y0) if x1 > x0 else (x0, y0 + along)
        b.blob((float(x), float(y), 0.55), (0.75, 0.75, 0.8), look)


def car(b: MeshBuilder, x: float, y: float, rng: Rng, *, along_x: bool) -> None:
    """Add a car centred at x, y."""
    r, g, blue = np.array(_PAINTS[int(rng.integers(len(_PAINTS)))])
    paint = Look(PAINT, (float(r), float(g), float(blue)))
    glass = Look(PAINT, (0.03, 0.035, 0.045))
    length, width = float(rng.uniform(3.9, 4.8)), float(rng.uniform(1.7, 1.9))
    ahead = float(rng.choice([-0.2, 0.2]))

    def place(l0: float, l1: float, w: float) -> Rectangle:
        if along_x:
            return (x + l0, y - w, x + l1, y + w)
        return (x - w, y + l0, x + w, y + l1)

    b.box(*place(-length / 2, length / 2, width / 2), 0.12, 0.85, paint, paint)
    b.box(*place(-0.27 * length + ahead, 0.25 * length + ahead, 0.43 * width), 0.85, 1.42, glass, paint)


def kiosk(b: MeshBuilder, x: float, y: float, rng: Rng) -> None:
    """Add a small pavilion with a pyramid roof."""
    wall = Look(PLAIN, (0.75, 0.72, 0.65))
    b.walls(x - 2, y - 2, x + 2, y + 2, 0, 2.8, wall)
    roof = Look(TILES, (0.30, 0.12, 0.08), float(rng.integers(1, 1000)))
    corners = [
        (x - 2.6, y - 2.6, 2.7),
        (x + 2.6, y - 2.6, 2.7),
        (x + 2.6, y + 2.6, 2.7),
        (x - 2.6, y + 2.6, 2.7),
    ]
    for a, c in zip(corners, corners[1:] + corners[:1], strict=True):
        b.quad(a, c, (x, y, 4.6), (x, y, 4.6), roof)
