# SPDX-License-Identifier: Apache-2.0
"""Fills the plan: buildings, trees and cars for every block and street."""

from __future__ import annotations

import itertools

import numpy as np

from blitzgs_synth import buildings
from blitzgs_synth.mesh import GROUND, Look, Mesh, MeshBuilder
from blitzgs_synth.plan import HOUSES, PARK, PLAZA, RETAIL, SIDEWALK, TOWERS, URBAN, Plan, Streets

Rng = np.random.Generator


def build_city(plan: Plan) -> Mesh:
    """Return the mesh of the whole city on its ground, which reaches to the horizon."""
    b = MeshBuilder()
    far = max(20 * plan.options.extent, 6000.0)
    b.top(-far, -far, far, far, 0.0, Look(GROUND, (1, 1, 1)))
    if not plan.options.built:
        return b.build(plan)
    for i, j in np.ndindex(*plan.kinds.shape):
        _fill_block(b, plan, int(i), int(j), np.random.default_rng([plan.options.seed, 2, int(i), int(j)]))
    rng = np.random.default_rng([plan.options.seed, 3])
    _line_streets(b, plan.along_y, plan.along_x, rng, along_x=False)
    _line_streets(b, plan.along_x, plan.along_y, rng, along_x=True)
    _outskirts(b, plan, rng)
    return b.build(plan)


def tower_height(plan: Plan) -> float:
    """Return the greatest height of a tower in metres: taller in larger cities, always below the flight."""
    return float(np.clip(0.16 * plan.options.extent, 22, 58))


def _fill_block(b: MeshBuilder, plan: Plan, i: int, j: int, rng: Rng) -> None:
    block = plan.block(i, j)
    x0, y0, x1, y1 = block
    kind = plan.kinds[i, j]
    middle = np.hypot(x0 + x1, y0 + y1) / 2
    density = float(np.clip(1 - middle / plan.half, 0, 1))
    if kind == URBAN:
        court = buildings.town_block(b, block, density, rng)
        buildings.trees(b, (court[0] + 2, court[1] + 2, court[2] - 2, court[3] - 2), 5, (4, 8), rng)
    elif kind == HOUSES:
        _houses(b, plan, i, j, rng)
    elif kind == PARK:
        _park(b, block, rng)
    elif kind == TOWERS:
        buildings.tower(b, block, tower_height(plan) * float(rng.uniform(0.75, 1)), rng)
        for x in np.arange(x0 + 2, x1 - 1, 7):
            buildings.tree(b, float(x), y0 + 1.2, float(rng.uniform(4, 6)), rng)
    elif kind == PLAZA:
        buildings.church(b, block, rng)
        for x in np.arange(x0 + 3, x1 - 2, 6.5):
            for y in (y0 + 2.5, y1 - 2.5):
                buildings.tree(b, float(x), y, float(rng.uniform(5, 7)), rng)
    elif kind == RETAIL:
        lot = buildings.shops(b, block, rng)
        for y in np.arange(lot[1] + 3.5, lot[3] - 2, 8.0):
            for x in np.arange(lot[0] + 2.25, lot[2] - 1.5, 2.5):
                if rng.random() < 0.55:
                    buildings.car(b, float(x), float(y), rng, along_x=False)


def house_lots(plan: Plan, i: int, j: int) -> list[tuple[float, float, float, float]]:
    """Return the garden lots of a block of houses: two rows."""
    x0, y0, x1, y1 = plan.block(i, j)
    count = max(1, round((x1 - x0) / 15))
    xs = np.linspace(x0, x1, count + 1)
    middle = (y0 + y1) / 2
    rows = ((y0, middle), (middle, y1))
    return [(float(xs[k]), lo, float(xs[k + 1]), hi) for lo, hi in rows for k in range(count)]


def _houses(b: MeshBuilder, plan: Plan, i: int, j: int, rng: Rng) -> None:
    for lot in house_lots(plan, i, j):
        x0, y0, x1, y1 = lot
        south = y0 == plan.block(i, j)[1]
        front = (x0, y0, x1, y0 + 0.62 * (y1 - y0)) if south else (x0, y1 - 0.62 * (y1 - y0), x1, y1)
        body = buildings.family_house(b, front, rng)
        low, high = (body[3] + 2, y1 - 1.5) if south else (y0 + 1.5, body[1] - 2)
        garden = (x0 + 1.5, low, x1 - 1.5, high)
        buildings.trees(b, garden, int(rng.integers(1, 4)), (3.5, 7.5), rng)
        if rng.random() < 0.7:
            buildings.hedge(b, x0, y0 + 1, x0, y1 - 1, rng)
        if rng.random() < 0.5:
            buildings.car(b, x0 + 2.2, y0 + 3.2 if south else y1 - 3.2, rng, along_x=False)


def _park(b: MeshBuilder, block: tuple[float, float, float, float], rng: Rng) -> None:
    x0, y0, x1, y1 = block
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    radius = 0.3 * min(x1 - x0, y1 - y0)  # the lawn and pond in the middle stay open
    buildings.kiosk(b, cx + 1.25 * radius, cy, rng)
    for x_low, y_low, x_high, y_high in ((x0, y0, x1, cy - radius), (x0, cy + radius, x1, y1)):
        count = int((x_high - x_low) * (y_high - y_low) / 28)
        buildings.trees(b, (x_low + 1.5, y_low + 1.5, x_high - 1.5, y_high - 1.5), count, (5, 11), rng, 4.2)


def _line_streets(b: MeshBuilder, streets: Streets, across: Streets, rng: Rng, *, along_x: bool) -> None:
    """Put parked and moving cars on the streets of one direction, and trees along the wide ones."""

    def place(across: float, along: float) -> tuple[float, float]:
        return (float(along), across) if along_x else (across, float(along))

    crossings = list(zip(across.centres.tolist(), across.halves.tolist(), strict=True))
    columns = (column.tolist() for column in (streets.centres, streets.halves, streets.main))
    for centre, half, main in zip(*columns, strict=True):
        for (low, low_half), (high, high_half) in itertools.pairwise(crossings):
            begin, end = low + low_half + 6, high - high_half - 6
            for side in (-1, 1):
                for along in np.arange(begin, end, 5.6):
                    if rng.random() < 0.42:
                        buildings.car(b, *place(centre + side * (half - 1.15), along), rng, along_x=along_x)
                if not main:
                    continue
                if rng.random() < 0.8:
                    along = rng.uniform(begin, end)
                    buildings.car(b, *place(centre + side * 1.9, along), rng, along_x=along_x)
                for along in np.arange(begin, end, 8.5):
                    spot = place(centre + side * (half + 0.45 * SIDEWALK), along)
                    buildings.tree(b, *spot, float(rng.uniform(5, 7.5)), rng)


def _outskirts(b: MeshBuilder, plan: Plan, rng: Rng) -> None:
    """Scatter groups of trees and a few farms around the built-up square, off the roads that leave it."""
    edge, reach = plan.half + 12, plan.half + 0.5 * plan.options.extent
    for _ in range(int(np.clip(plan.options.extent / 2.5, 40, 1500))):
        x, y = rng.uniform(-reach, reach, 2).tolist()
        if max(abs(x), abs(y)) < edge or not _off_roads(plan, x, y, 12):
            continue
        if rng.random() < 0.08:
            buildings.family_house(b, (x - 8, y - 8, x + 8, y + 8), rng)
            continue
        buildings.trees(b, (x - 5, y - 5, x + 5, y + 5), int(rng.integers(1, 6)), (4, 9), rng)


def _off_roads(plan: Plan, x: float, y: float, margin: float) -> bool:
    return not any(
        ((np.abs(streets.centres - value) < streets.halves + margin) & streets.main).any()
        for streets, value in ((plan.along_y, x), (plan.along_x, y))
    )
