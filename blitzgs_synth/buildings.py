# SPDX-License-Identifier: Apache-2.0
"""Builders of houses, town blocks, towers, a church, shops, trees and cars, in plan coordinates."""

from __future__ import annotations

from typing import Final

import numpy as np

from blitzgs_synth.mesh import (
    CURTAIN,
    FACADE,
    GRAVEL,
    LEAVES,
    METAL,
    PAINT,
    PLAIN,
    SOLAR,
    TILES,
    Color,
    Look,
    MeshBuilder,
    Point,
)
from blitzgs_synth.plan import Rectangle

Rng = np.random.Generator

FLOOR: Final = 3.1  # metres from one floor to the next
# Facade styles that materials.py paints: the first free number of a FACADE look.
PLASTER, BRICK, BANDED = 0.0, 1.0, 2.0

_WALLS: Final[list[Color]] = [
    (0.72, 0.62, 0.45), (0.78, 0.74, 0.66), (0.68, 0.48, 0.33), (0.62, 0.66, 0.62),
    (0.75, 0.55, 0.42), (0.80, 0.70, 0.48), (0.55, 0.57, 0.60), (0.70, 0.42, 0.32),
]  # fmt: skip
_BRICKS: Final[list[Color]] = [(0.42, 0.18, 0.12), (0.50, 0.26, 0.17), (0.36, 0.22, 0.17)]
_CONCRETES: Final[list[Color]] = [(0.55, 0.54, 0.51), (0.66, 0.64, 0.60), (0.44, 0.45, 0.46)]
_ROOF_TILES: Final[list[Color]] = [
    (0.46, 0.17, 0.09), (0.40, 0.20, 0.13), (0.52, 0.24, 0.12), (0.20, 0.20, 0.22),
    (0.30, 0.17, 0.13),
]  # fmt: skip
_ROOF_FLATS: Final[list[Color]] = [
    (0.42, 0.41, 0.39), (0.30, 0.30, 0.31), (0.52, 0.50, 0.46), (0.36, 0.33, 0.30),
]  # fmt: skip
CONCRETE: Final = Look(PLAIN, (0.52, 0.51, 0.48))
STEEL: Final = Look(METAL, (0.56, 0.58, 0.60))


def _pick(colors: list[Color], rng: Rng, darkest: float = 0.88, lightest: float = 1.08) -> Color:
    r, g, b = np.array(colors[int(rng.integers(len(colors)))]) * rng.uniform(darkest, lightest)
    return (float(r), float(g), float(b))


def _seed(rng: Rng) -> float:
    return float(rng.integers(1, 30_000))


def facade(rng: Rng, *, shop: bool = False) -> Look:
    """Draw the look of a wall: style, window pitch in metres, and whether the ground floor is a shop."""
    style = float(rng.choice([PLASTER, BRICK, BANDED], p=[0.6, 0.22, 0.18]))
    palette = {PLASTER: _WALLS, BRICK: _BRICKS, BANDED: _CONCRETES}[style]
    return Look(FACADE, _pick(palette, rng), _seed(rng), style, float(rng.uniform(1.9, 3.0)), float(shop))


def flat_roof(b: MeshBuilder, x0: float, y0: float, x1: float, y1: float, z: float, rng: Rng) -> None:
    """Add a gravelled roof with parapet, machines and perhaps rows of solar panels."""
    gravel = Look(GRAVEL, _pick(_ROOF_FLATS, rng), _seed(rng))
    b.top(x0, y0, x1, y1, z, gravel)
    t, rim = 0.3, z + float(rng.uniform(0.4, 0.9))
    for edge in (
        (x0, y0, x1, y0 + t), (x0, y1 - t, x1, y1), (x0, y0 + t, x0 + t, y1 - t), (x1 - t, y0 + t, x1, y1 - t)
    ):  # fmt: skip
        b.box(*edge, z, rim, CONCRETE, CONCRETE)
    width, depth = x1 - x0 - 2.0, y1 - y0 - 2.0
    if min(width, depth) < 4:
        return
    if rng.random() < 0.3:
        _solar_rows(b, x0 + 1.5, y0 + 1.5, x1 - 1.5, y1 - 1.5, z, rng)
        return
    for _ in range(int(rng.integers(2, 4 + int(width * depth / 90)))):
        w, d = rng.uniform(0.9, 2.6, 2)
        x, y = x0 + 1 + rng.uniform(0, width - w), y0 + 1 + rng.uniform(0, depth - d)
        side = Look(METAL, (0.5, 0.52, 0.53), _seed(rng), 1.0)
        b.box(x, y, x + w, y + d, z, z + float(rng.uniform(0.6, 1.7)), side, STEEL)
    if rng.random() < 0.6:
        x, y = x0 + 1 + rng.uniform(0, width - 3), y0 + 1 + rng.uniform(0, depth - 3.5)
        b.box(x, y, x + 2.8, y + 3.3, z, z + 2.5, CONCRETE, gravel)


def _solar_rows(b: MeshBuilder, x0: float, y0: float, x1: float, y1: float, z: float, rng: Rng) -> None:
    look = Look(SOLAR, (0.03, 0.05, 0.12), _seed(rng))
    y = y0
    while y + 1.5 < y1:
        low, high = z + 0.25, z + 0.95
        b.quad((x0, y, low), (x1, y, low), (x1, y + 1.4, high), (x0, y + 1.4, high), look)
        b.quad((x1, y + 1.4, z), (x0, y + 1.4, z), (x0, y + 1.4, high), (x1, y + 1.4, high), STEEL)
        y += 2.3


def gable_roof(
    b: MeshBuilder,
    rectangle: Rectangle,
    z: float,
    rise: float,
    wall: Look,
    rng: Rng,
    *,
    along_x: bool,
    tiles: Look | None = None,
) -> None:
    """Add two tiled slopes with their gables and a chimney; the ridge runs along x or along y."""
    x0, y0, x1, y1 = rectangle
    tiles = tiles or Look(TILES, _pick(_ROOF_TILES, rng), _seed(rng), float(rng.random() < 0.35))
    # u along the ridge and v across it; `at` gives a point in x and y.
    (u0, u1), (v0, v1) = ((x0, x1), (y0, y1)) if along_x else ((y0, y1), (x0, x1))

    def at(u: float, v: float, height: float) -> Point:
        return (u, v, height) if along_x else (v, u, height)

    eave, middle = 0.45, (v0 + v1) / 2
    low, top = z - rise * eave / ((v1 - v0) / 2), z + rise
    gable = Look(PLAIN, wall.color, wall.seed)
    # Swapped axes turn corners round the other way.
    near, far = (u0, u1) if along_x else (u1, u0)
    begin, end = (u0 - eave, u1 + eave) if along_x else (u1 + eave, u0 - eave)
    for v, a, c in ((v0 - eave, begin, end), (v1 + eave, end, begin)):
        b.quad(at(a, v, low), at(c, v, low), at(c, middle, top), at(a, middle, top), tiles)
    for u, va, vb in ((far, v0, v1), (near, v1, v0)):
        b.quad(at(u, va, z), at(u, vb, z), at(u, middle, top), at(u, middle, top), gable)
    cx, cy, _ = at(u0 + (u1 - u0) * rng.uniform(0.25, 0.75), middle + 0.8, 0)
    brick = Look(PLAIN, (0.38, 0.2, 0.14), _seed(rng))
    b.box(cx - 0.4, cy - 0.4, cx + 0.4, cy + 0.4, z + rise * 0.4, top + 0.8, brick, CONCRETE)


def _balconies(b: MeshBuilder, rectangle: Rectangle, floors: int, rng: Rng) -> None:
    x0, y0, x1, y1 = rectangle
    side = Look(PLAIN, (0.6, 0.6, 0.58))
    for x in np.arange(x0 + rng.uniform(0.8, 2.0), x1 - 2.4, rng.uniform(3.4, 5.5)):
        for floor in range(1, floors):
            z = floor * FLOOR - 0.15
            b.box(x, y0 - 1.1, x + 2.2, y0, z, z + 1.0, side, CONCRETE)
            b.box(x, y1, x + 2.2, y1 + 1.1, z, z + 1.0, side, CONCRETE)


def town_house(b: MeshBuilder, rectangle: Rectangle, floors: int, rng: Rng, *, along_x: bool) -> None:
    """Add a house of a closed street front: shop or flats below, flat or tiled roof."""
    x0, y0, x1, y1 = rectangle
    z = floors * FLOOR + 0.6
    wall = facade(rng, shop=rng.random() < 0.6)
    b.walls(x0, y0, x1, y1, 0, z, wall)
    if rng.random() < 0.5:
        flat_roof(b, x0, y0, x1, y1, z, rng)
    else:
        gable_roof(b, rectangle, z, float(rng.uniform(2.4, 4.0)), wall, rng, along_x=along_x)
    if along_x and x1 - x0 > 6 and rng.random() < 0.35:
        _balconies(b, rectangle, floors, rng)


def town_block(b: MeshBuilder, block: Rectangle, density: float, rng: Rng) -> Rectangle:
    """Line the edges of a block with houses; returns the courtyard left in the middle."""
    x0, y0, x1, y1 = block
    depth = float(min(rng.uniform(9.5, 12.5), 0.36 * min(x1 - x0, y1 - y0)))

    def floors() -> int:
        return int(np.clip(round(rng.normal(2.6 + 2.8 * density, 0.9)), 2, 7))

    for lo_y, hi_y in ((y0, y0 + depth), (y1 - depth, y1)):
        for a, c in _lots(x0, x1, rng):
            setback = float(rng.choice([0.0, 0.0, 0.6, 1.4]))
            south = (a, lo_y + (setback if lo_y == y0 else 0), c, hi_y - (setback if hi_y == y1 else 0))
            town_house(b, south, floors(), rng, along_x=True)
    for lo_x, hi_x in ((x0, x0 + depth), (x1 - depth, x1)):
        for a, c in _lots(y0 + depth, y1 - depth, rng):
            if rng.random() < 0.85:
                town_house(b, (lo_x, a, hi_x, c), floors(), rng, along_x=False)
    return (x0 + depth, y0 + depth, x1 - depth, y1 - depth)


def _lots(low: float, high: float, rng: Rng) -> list[tuple[float, float]]:
    count = max(1, round((high - low) / rng.uniform(10, 14)))
    gaps = rng.uniform(0.75, 1.3, count)
    edges = low + (high - low) * np.concatenate([[0], np.cumsum(gaps) / gaps.sum()])
    return [(float(a), float(c)) for a, c in zip(edges[:-1], edges[1:], strict=True)]


def family_house(b: MeshBuilder, lot: Rectangle, rng: Rng) -> Rectangle:
    """Add a detached house, perhaps with a side wing; returns its footprint."""
    x0, y0, x1, y1 = lot
    w, d = float(min(rng.uniform(8, 11), x1 - x0 - 3)), float(min(rng.uniform(7.5, 10), y1 - y0 - 3))
    x, y = x0 + rng.uniform(1.2, x1 - x0 - w - 1.2), y0 + rng.uniform(1.2, y1 - y0 - d - 1.2)
    along_x = bool(rng.random() < 0.5)
    wall = facade(rng)
    z = FLOOR * float(rng.choice([1, 2], p=[0.4, 0.6])) + 0.5
    body = (float(x), float(y), float(x + w), float(y + d))
    tiles = Look(TILES, _pick(_ROOF_TILES, rng), _seed(rng), float(rng.random() < 0.5))
    b.walls(*body, 0, z, wall)
    gable_roof(b, body, z, float(rng.uniform(2.4, 3.6)), wall, rng, along_x=along_x, tiles=tiles)
    if x1 - body[2] > 4.5:
        garage = (body[2], body[1] + 1, min(body[2] + 3.6, x1 - 0.5), body[1] + 6.5)
        b.walls(*garage, 0, 2.8, Look(PLAIN, wall.color, wall.seed))
        b.top(*garage, 2.8, Look(GRAVEL, (0.4, 0.39, 0.37), _seed(rng)))
    return body


def tower(b: MeshBuilder, block: Rectangle, height: float, rng: Rng) -> None:
    """Add a podium and a tower that steps back once or twice as it rises."""
    x0, y0, x1, y1 = block
    m = 3.0
    podium = facade(rng, shop=True)
    b.walls(x0 + m, y0 + m, x1 - m, y1 - m, 0, 2 * FLOOR, podium)
    flat_roof(b, x0 + m, y0 + m, x1 - m, y1 - m, 2 * FLOOR, rng)
    w, d = float(min(rng.uniform(15, 22), x1 - x0 - 12)), float(min(rng.uniform(13, 18), y1 - y0 - 12))
    cx, cy = (x0 + x1) / 2 + rng.uniform(-2, 2), (y0 + y1) / 2 + rng.uniform(-2, 2)
    tint = _pick([(0.16, 0.24, 0.30), (0.20, 0.26, 0.26), (0.26, 0.24, 0.22)], rng)
    glass = Look(CURTAIN, tint, _seed(rng), float(rng.uniform(1.2, 1.8)))
    wall = glass if rng.random() < 0.65 else facade(rng)
    z, tiers = 2 * FLOOR, int(rng.integers(2, 4))
    for tier in range(tiers):
        top = 2 * FLOOR + (height - 2 * FLOOR) * (tier + 1) / tiers
        top = FLOOR * round(top / FLOOR)
        body = (cx - w / 2, cy - d / 2, cx + w / 2, cy + d / 2)
        b.walls(*body, z, top, wall)
        flat_roof(b, *body, top, rng)
        z, w, d = top, w * 0.8, d * 0.8


def church(b: MeshBuilder, block: Rectangle, rng: Rng) -> None:
    """Add a church with a spire: the landmark of the plaza."""
    cx, cy = (block[0] + block[2]) / 2, (block[1] + block[3]) / 2
    stone = Look(FACADE, (0.66, 0.60, 0.50), _seed(rng), PLASTER, 3.4, 0.0)
    slate = Look(TILES, (0.20, 0.21, 0.24), _seed(rng))
    nave = (cx - 10.0, cy - 5.0, cx + 9.0, cy + 5.0)
    b.walls(*nave, 0, 8.0, stone)
    gable_roof(b, nave, 8.0, 5.0, stone, rng, along_x=True, tiles=slate)
    x, s, z = cx - 12.0, 3.0, 19.0
    b.walls(x - s, cy - s, x + s, cy + s, 0, z, stone)
    b.pyramid(x, cy, s + 0.4, z, z + 11.0, Look(METAL, (0.26, 0.42, 0.36), _seed(rng)))


def shops(b: MeshBuilder, block: Rectangle, rng: Rng) -> Rectangle:
    """Add a low retail hall on the north half of the block; returns the car park in front of it."""
    x0, y0, x1, y1 = block
    split = y0 + 0.52 * (y1 - y0)
    wall = Look(FACADE, _pick(_CONCRETES, rng), _seed(rng), BANDED, 3.0, 1.0)
    b.walls(x0 + 1, split, x1 - 1, y1 - 1, 0, 6.5, wall)
    flat_roof(b, x0 + 1, split, x1 - 1, y1 - 1, 6.5, rng)
    sign = Look(PLAIN, _pick([(0.7, 0.1, 0.08), (0.1, 0.25, 0.6), (0.85, 0.6, 0.05)], rng))
    b.box(x0 + 4, split - 1.6, x1 - 4, split, 3.2, 4.2, sign, STEEL)
    return (x0, y0, x1, split - 2)


_LEAVES: Final[list[Color]] = [
    (0.075, 0.16, 0.035), (0.11, 0.19, 0.045), (0.06, 0.13, 0.04), (0.15, 0.20, 0.05),
    (0.09, 0.15, 0.06),
]  # fmt: skip
_BARK: Final = Look(PLAIN, (0.16, 0.11, 0.07))
_PAINTS: Final[list[Color]] = [
    (0.75, 0.75, 0.76), (0.42, 0.43, 0.45), (0.05, 0.05, 0.06), (0.50, 0.04, 0.03),
    (0.05, 0.11, 0.30), (0.80, 0.79, 0.74), (0.14, 0.15, 0.17), (0.10, 0.20, 0.12),
]  # fmt: skip


def tree(b: MeshBuilder, x: float, y: float, height: float, rng: Rng) -> None:
    """Add a tree: a trunk and a crown of a few bumpy blobs, or a slim conifer now and then."""
    t = 0.03 * height + 0.06
    b.walls(x - t, y - t, x + t, y + t, 0, 0.5 * height, _BARK)
    color = _pick(_LEAVES, rng, 0.8, 1.25)

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
    paint = Look(PAINT, _PAINTS[int(rng.integers(len(_PAINTS)))])
    glass = Look(PAINT, (0.03, 0.035, 0.045))
    length, width = float(rng.uniform(3.9, 4.8)), float(rng.uniform(1.7, 1.9))
    ahead = float(rng.choice([-0.2, 0.2]))

    def place(l0: float, l1: float, w: float) -> Rectangle:
        return (x + l0, y - w, x + l1, y + w) if along_x else (x - w, y + l0, x + w, y + l1)

    b.box(*place(-length / 2, length / 2, width / 2), 0.12, 0.85, paint, paint)
    b.box(*place(-0.27 * length + ahead, 0.25 * length + ahead, 0.43 * width), 0.85, 1.42, glass, paint)


def kiosk(b: MeshBuilder, x: float, y: float, rng: Rng) -> None:
    """Add a small pavilion with a pyramid roof."""
    wall = Look(PLAIN, (0.75, 0.72, 0.65))
    b.walls(x - 2, y - 2, x + 2, y + 2, 0, 2.8, wall)
    b.pyramid(x, y, 2.6, 2.7, 4.6, Look(TILES, (0.30, 0.12, 0.08), float(rng.integers(1, 1000))))
