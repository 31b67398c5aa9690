# SPDX-License-Identifier: Apache-2.0
"""Colours of the ground: streets and their markings, pavements, gardens, parks, squares and fields."""

from __future__ import annotations

from typing import Final

import numpy as np

from blitzgs_synth.materials import Noise, cell_random, inside, mix, resolved, rgb, stripes
from blitzgs_synth.plan import (
    HOUSES,
    PARK,
    PLAZA,
    RETAIL,
    SIDEWALK,
    TOWERS,
    URBAN,
    Bools,
    Doubles,
    Floats,
    Ints,
    Plan,
    Streets,
)

_SWAY: Final = 0.12  # standard deviation of the movement of crops, metres
_WHITE: Final = (0.74, 0.74, 0.70)
# Red, green and blue of five crops.
_CROPS: Final = np.array([
    [0.13, 0.27, 0.19, 0.15, 0.30], [0.18, 0.235, 0.14, 0.195, 0.28], [0.06, 0.12, 0.09, 0.075, 0.16],
], np.float32)  # fmt: skip


def ground_color(plan: Plan, noise: Noise, position: Floats, footprint: Floats, centre: Doubles) -> Floats:
    """Return linear RGB [3, R] of ground points at world positions [3, R], seen from `centre` [3]."""
    x, y = plan.unbend(position[0], position[1])
    if not plan.options.built:
        return _crops(noise, x, y, footprint, centre)
    color = np.empty((3, len(x)), np.float32)
    dx, i = plan.along_y.nearest(x)
    dy, j = plan.along_x.nearest(y)
    in_city_x = (x > plan.along_y.centres[0] - 8) & (x < plan.along_y.centres[-1] + 8)
    in_city_y = (y > plan.along_x.centres[0] - 8) & (y < plan.along_x.centres[-1] + 8)
    edge_x = np.abs(dx) - plan.along_y.halves[i]  # below 0 on a street along y
    edge_y = np.abs(dy) - plan.along_x.halves[j]
    inside_city = in_city_x & in_city_y
    edge_x = np.where(inside_city | plan.along_y.main[i], edge_x, np.float32(1e3))
    edge_y = np.where(inside_city | plan.along_x.main[j], edge_y, np.float32(1e3))
    edge = np.minimum(edge_x, edge_y)

    def fill(mask: Bools, paint: object, *arguments: object) -> None:
        chosen = np.flatnonzero(mask)
        if len(chosen):
            rows = [a[chosen] if isinstance(a, np.ndarray) else a for a in arguments]
            color[:, chosen] = paint(noise, *rows)  # type: ignore[operator]

    street = edge < 0
    fill(street, _street, plan, x, y, dx, dy, edge_x, edge_y, i, j, footprint)
    fill(~street & inside_city & (edge < SIDEWALK), _pavement, x, y, edge, footprint)
    interior = ~street & inside_city & (edge >= SIDEWALK)
    block_i = np.clip(i - (dx <= 0), 0, plan.kinds.shape[0] - 1)
    block_j = np.clip(j - (dy <= 0), 0, plan.kinds.shape[1] - 1)
    kind = plan.kinds[block_i, block_j]
    beyond = (np.abs(x) > plan.half) | (np.abs(y) > plan.half)
    block = interior & ~beyond
    fill(block & (kind == PARK), _park, plan, x, y, block_i, block_j, footprint)
    fill(block & (kind == HOUSES), _garden, x, y, edge, footprint)
    fill(block & ((kind == PLAZA) | (kind == TOWERS)), _square, x, y, footprint)
    fill(block & (kind == RETAIL), _car_park, plan, x, y, block_i, block_j, footprint)
    fill(block & (kind == URBAN), _courtyard, x, y, footprint)
    fill((interior & beyond) | (~street & ~inside_city), _fields, x, y, footprint)
    return color


def _asphalt(noise: Noise, x: Floats, y: Floats, footprint: Floats) -> Floats:
    tone = noise.layers(x, y, footprint, (11.0, 0.09), (2.3, 0.07), (0.5, 0.07), (0.2, 0.06))
    repair = (cell_random(np.floor(x / 7), np.floor(y / 5), 3) > 0.88) * np.float32(-0.22)
    return rgb(0.155, 0.155, 0.16) * (1 + tone + repair)


def _line(offset: Floats, width: float, footprint: Floats) -> Floats:
    return inside(offset, -width / 2, width / 2, footprint)


def _street(
    noise: Noise,
    plan: Plan,
    x: Floats,
    y: Floats,
    dx: Floats,
    dy: Floats,
    edge_x: Floats,
    edge_y: Floats,
    i: Ints,
    j: Ints,
    footprint: Floats,
) -> Floats:
    """Return asphalt with lane markings, crossings before junctions and worn wheel tracks."""
    color = _asphalt(noise, x, y, footprint)
    for across, along, edge_other, streets, index, own in (
        (dx, y, edge_y, plan.along_y, i, edge_x < 0),
        (dy, x, edge_x, plan.along_x, j, edge_y < 0),
    ):
        alone = own & (edge_other > 0)
        markings = _markings(across, along, edge_other, streets, index, footprint)
        color = mix(color, _WHITE, 0.85 * markings * alone)
        tracks = np.exp(-((np.abs(np.abs(across) - 1.9) - 0.75) ** 2) / 0.12) * alone
        color = mix(color, color * 0.8, 0.6 * tracks * resolved(1.0, footprint))
    return color


def _markings(
    across: Floats, along: Floats, to_junction: Floats, streets: Streets, index: Ints, footprint: Floats
) -> Floats:
    main, half = streets.main[index], streets.halves[index]
    approach = to_junction < 5.2
    dashes = stripes(along, 4.0, 0.0, 0.5, footprint)
    centre = _line(across, 0.14, footprint) * np.where(main, 1.0, dashes)
    double = _line(np.abs(across) - 0.2, 0.12, footprint)
    lane = np.where(main, double, centre)
    parking = _line(np.abs(across) - (half - 2.2), 0.11, footprint)
    zebra = stripes(across, 1.0, 0.0, 0.5, footprint) * inside(to_junction, 1.0, 3.8, footprint)
    zebra *= np.abs(across) < half - 0.3
    stop = inside(to_junction, 4.5, 4.9, footprint) * (np.abs(across) < half - 0.4)
    return np.clip(np.where(approach, zebra + stop, lane + parking), 0, 1).astype(np.float32)


def _pavement(noise: Noise, x: Floats, y: Floats, edge: Floats, footprint: Floats) -> Floats:
    tone = noise.layers(x, y, footprint, (5.0, 0.06), (1.2, 0.06), (0.3, 0.04))
    slab = (cell_random(np.floor(x / 0.8), np.floor(y / 0.8), 5) - 0.5) * 0.2 * resolved(0.8, footprint)
    color = rgb(0.40, 0.385, 0.36) * (1 + tone + slab)
    joints = stripes(x, 0.8, 0.0, 0.07, footprint) + stripes(y, 0.8, 0.0, 0.07, footprint)
    color = mix(color, color * 0.6, np.clip(joints, 0, 1))
    color = mix(color, (0.56, 0.55, 0.52), inside(edge, 0.0, 0.28, footprint))
    return mix(color, (0.1, 0.1, 0.1), 0.5 * inside(edge, -0.1, 0.06, footprint))


def _grass(noise: Noise, x: Floats, y: Floats, footprint: Floats, mown: float) -> Floats:
    tone = noise.layers(x, y, footprint, (8.0, 0.12), (2.0, 0.12), (0.6, 0.12), (0.22, 0.14))
    bands = (stripes(x + 0.3 * y, 2.4, 0.0, 0.5, footprint) - 0.5) * mown
    color = rgb(0.125, 0.205, 0.055) * np.clip(1 + tone + bands, 0.3, 2)
    dry = np.clip(noise(x / 5.5 + 9, y / 5.5) - 0.5, 0, 1)
    return mix(color, (0.25, 0.22, 0.10), 0.45 * dry)


def _park(noise: Noise, plan: Plan, x: Floats, y: Floats, i: Ints, j: Ints, footprint: Floats) -> Floats:
    """Return mown lawn around a pond, with gravel paths: a ring and a cross."""
    a, b = plan.along_y.centres, plan.along_x.centres
    cx, cy = (a[i] + a[i + 1]) / 2, (b[j] + b[j + 1]) / 2
    reach = np.minimum(a[i + 1] - a[i], b[j + 1] - b[j])
    px, py = x - cx, y - cy
    wobble = noise(x / 9, y / 9)
    distance = np.hypot(px, py) + 0.5 * wobble
    color = _grass(noise, x, y, footprint, 0.12)
    beds = inside(distance, 0.215 * reach, 0.245 * reach, footprint) * (noise(x / 2, y / 2) > 0)
    hue = cell_random(np.floor(x / 0.9), np.floor(y / 0.9), 11)
    flowers = np.stack([0.35 + 0.4 * hue, 0.12 + 0.3 * hue**2, 0.15 + 0.2 * (1 - hue)])
    color = mix(color, flowers, 0.7 * beds)
    ring = inside(distance, 0.255 * reach, 0.255 * reach + 2.0, footprint)
    crossing = np.maximum(_line(px + 0.8 * wobble, 2.0, footprint), _line(py + 0.8 * wobble, 2.0, footprint))
    path = np.maximum(ring, crossing * (distance > 0.255 * reach))
    pebbles = noise.layers(x, y, footprint, (2.0, 0.05), (0.4, 0.09))
    color = mix(color, rgb(0.50, 0.43, 0.32) * (1 + pebbles), path)
    pond = distance - 0.14 * reach * (1 + 0.12 * noise(px / 6 + 40, py / 6))
    water = rgb(0.045, 0.085, 0.095) * (1 + 0.2 * noise(x / 3, y / 3))
    color = mix(color, (0.42, 0.40, 0.36), inside(pond, -0.2, 0.5, footprint))
    return mix(color, water, inside(pond, -1e3, 0.0, footprint))


def _garden(noise: Noise, x: Floats, y: Floats, edge: Floats, footprint: Floats) -> Floats:
    color = _grass(noise, x, y, footprint, 0.06)
    cell_x, cell_y = np.floor(x / 7.3), np.floor(y / 6.1)
    chance = cell_random(cell_x, cell_y, 17)
    du, dv = x - (cell_x + 0.5) * 7.3, y - (cell_y + 0.5) * 6.1
    patch = inside(du, -1.9, 1.9, footprint) * inside(dv, -1.5, 1.5, footprint)
    joints = np.clip(stripes(x, 0.5, 0, 0.1, footprint) + stripes(y, 0.5, 0, 0.1, footprint), 0, 1)
    slabs = rgb(0.42, 0.37, 0.31) * (1 - 0.3 * joints)
    soil = rgb(0.17, 0.115, 0.07) * (1 - 0.45 * stripes(x, 0.6, 0, 0.5, footprint))
    color = mix(color, slabs, patch * (chance > 0.72))
    color = mix(color, soil, patch * (chance < 0.12))
    drive = stripes(x, 7.5, 0.25, 0.62, footprint) * (edge < SIDEWALK + 5)
    pebbles = noise.layers(x, y, footprint, (1.5, 0.06), (0.35, 0.1))
    return mix(color, rgb(0.40, 0.37, 0.33) * (1 + pebbles), 0.85 * drive)


def _square(noise: Noise, x: Floats, y: Floats, footprint: Floats) -> Floats:
    """Return a paved square: bands of light stone every 5 m and slabs laid in two tones."""
    slab = cell_random(np.floor(x / 1.25), np.floor(y / 1.25), 23)
    tone = noise.layers(x, y, footprint, (7.0, 0.06), (1.0, 0.05), (0.3, 0.05))
    shade = (slab - 0.5) * 0.3 * resolved(1.25, footprint)
    color = rgb(0.44, 0.39, 0.33) * (1 + tone + shade)
    joints = np.clip(stripes(x, 1.25, 0, 0.06, footprint) + stripes(y, 1.25, 0, 0.06, footprint), 0, 1)
    color = mix(color, color * 0.6, joints)
    bands = np.clip(stripes(x, 5.0, 0, 0.1, footprint) + stripes(y, 5.0, 0, 0.1, footprint), 0, 1)
    return mix(color, (0.60, 0.57, 0.52), 0.7 * bands)


def _courtyard(noise: Noise, x: Floats, y: Floats, footprint: Floats) -> Floats:
    tone = noise.layers(x, y, footprint, (4.0, 0.12), (1.0, 0.08), (0.3, 0.08))
    cobble = (cell_random(np.floor(x / 0.5), np.floor(y / 0.5), 29) - 0.5) * 0.35 * resolved(0.5, footprint)
    color = rgb(0.31, 0.29, 0.26) * (1 + tone + cobble)
    green = np.clip(2.5 * noise(x / 6.5, y / 6.5) - 0.4, 0, 1)
    return mix(color, _grass(noise, x, y, footprint, 0.0), green)


def _car_park(noise: Noise, plan: Plan, x: Floats, y: Floats, i: Ints, j: Ints, footprint: Floats) -> Floats:
    """Return asphalt with rows of stalls, aligned with the cars that `city.py` parks there."""
    a, b = plan.along_y, plan.along_x
    u = x - (a.centres[i] + a.halves[i] + SIDEWALK)
    v = y - (b.centres[j] + b.halves[j] + SIDEWALK)
    color = _asphalt(noise, x, y, footprint) * np.float32(1.25)
    row = (v - 3.5) / 8.0
    in_row = np.abs(v - 3.5 - 8.0 * np.round(row)) < 2.4
    stalls = stripes(u - 0.94, 2.5, 0.0, 0.05, footprint) * in_row * (v > 0.8)
    return mix(color, _WHITE, 0.8 * stalls)


def _fields(noise: Noise, x: Floats, y: Floats, footprint: Floats) -> Floats:
    """Return farmland around the city: parcels of crop, meadow and soil, each with its own furrows."""
    c, s = np.float32(np.cos(0.35)), np.float32(np.sin(0.35))
    u, v = c * x - s * y, s * x + c * y
    row = np.floor(v / 62 + 0.15 * noise(u / 300, v / 300))
    column = np.floor(u / 95 + cell_random(row, row, 31))
    crop = cell_random(column, row, 37)
    color: Floats = _CROPS.take(np.minimum((crop * 5).astype(np.int64), 4), axis=1)
    turned = cell_random(column, row, 41) > 0.5
    furrows = (stripes(np.where(turned, u, v), 2.6, 0.0, 0.5, footprint) - 0.5) * 0.22
    tone = noise.layers(x, y, footprint, (40.0, 0.08), (9.0, 0.09), (2.0, 0.09), (0.6, 0.10))
    color = color * (1 + furrows + tone)
    border = np.abs(v / 62 - np.round(v / 62)) < 0.03
    return mix(color, _grass(noise, x, y, footprint, 0.0), border * np.float32(1))


def _crops(noise: Noise, x: Floats, y: Floats, footprint: Floats, centre: Doubles) -> Floats:
    """Return fields whose crops have as fine a texture as photographs can show: rows, leaves and soil.

    Crops sway in the wind, so no two photographs show quite the same.
    """
    color = _fields(noise, x, y, footprint)
    gust = centre.astype(np.float32)
    sway_x = np.float32(_SWAY) * noise(x / 3 + gust[0], y / 3 + gust[1])
    sway_y = np.float32(_SWAY) * noise(x / 3 - gust[1], y / 3 + gust[0])
    x, y = x + sway_x, y + sway_y
    rows = (stripes(x + 0.4 * y, 0.75, 0.0, 0.55, footprint) - 0.55) * 0.35
    leaves = noise.layers(x, y, footprint, (1.4, 0.16), (0.7, 0.22), (0.36, 0.30), (0.2, 0.30))
    shade: Floats = np.clip(1 + rows + leaves, 0.15, 2.2)
    soil = np.clip(noise(x / 0.8 + 13, y / 0.8) - 0.4, 0, 1) * resolved(0.8, footprint)
    return mix(color * shade, (0.21, 0.155, 0.105), 0.7 * soil)
