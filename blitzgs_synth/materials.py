# SPDX-License-Identifier: Apache-2.0
"""Patterns (noise, stripes), and colours of walls, roofs, trees and cars at points on them.

Colours are linear RGB [3, R] in [0, 1], for the points of one material. All patterns take the sampling
footprint into account (metres covered by one sample), because a pattern finer than its sampling would flicker
from view to view instead of averaging out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from blitzgs_synth.buildings import BANDED, BRICK, FLOOR
from blitzgs_synth.plan import Bools, Floats

_LATTICE = 64  # random values along one period of the noise
_TEXELS = 8  # texels from one random value to the next
_ROW = 4096  # cv2.remap wants two-dimensional maps with short sides


class Noise:
    """Smooth tileable noise with one bump per unit length, mean 0 and standard deviation 1."""

    def __init__(self, seed: int) -> None:
        lattice = np.random.default_rng(seed).standard_normal((_LATTICE, _LATTICE)).astype(np.float32)
        border = 2
        padded = np.pad(lattice, border, mode="wrap")
        texture = cv2.resize(padded, None, fx=_TEXELS, fy=_TEXELS, interpolation=cv2.INTER_CUBIC)
        cut = border * _TEXELS
        texture = texture[cut:-cut, cut:-cut]
        texture = (texture - texture.mean()) / texture.std()
        # One more row and column, so that interpolation at the seam needs no wrapping.
        self._texture = np.ascontiguousarray(np.pad(texture, (0, 1), mode="wrap"))

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Return the noise at positions x, y [R] in units of its wavelength."""
        count = len(x)
        if count == 0:  # cv2 has no empty images
            return np.zeros(0, np.float32)
        rows = -(-count // _ROW)
        maps = np.zeros((2, rows * _ROW), np.float32)
        for plane, coordinate in zip(maps, (x, y), strict=True):
            periods = np.multiply(coordinate, np.float32(1 / _LATTICE), out=plane[:count])
            periods -= np.floor(periods)
            periods *= np.float32(_LATTICE * _TEXELS)
        u, v = maps.reshape(2, rows, _ROW)
        sampled = cv2.remap(self._texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return sampled.reshape(-1)[:count]

    def layers(self, x: Floats, y: Floats, footprint: Floats, *bands: tuple[float, float]) -> Floats:
        """Return a sum of bands (wavelength in metres, amplitude), each faded out where it is unresolved."""
        total = np.zeros_like(x)
        for index, (wavelength, amplitude) in enumerate(bands):
            # Each band is turned by another angle, so that their lattices do not line up.
            c, s = np.cos(0.6 + 1.9 * index) / wavelength, np.sin(0.6 + 1.9 * index) / wavelength
            band = self(np.float32(c) * x - np.float32(s) * y, np.float32(s) * x + np.float32(c) * y)
            total += np.float32(amplitude) * resolved(wavelength, footprint) * band
        return total


def resolved(size: float, footprint: Floats) -> Floats:
    """Return the share of a pattern of that size (metres) that survives sampling: 0 to 1, [R]."""
    return np.clip(np.float32(1.6) - np.float32(1.6 / size) * footprint, 0, 1)


def cell_random(ix: Floats, iy: Floats, salt: Floats | int) -> Floats:
    """Return one uniform number in [0, 1) per integer cell (ix, iy) and salt, [R]."""
    h = ix.astype(np.int32).view(np.uint32) * np.uint32(0x9E3779B1)
    h ^= iy.astype(np.int32).view(np.uint32) * np.uint32(0x85EBCA77)
    extra = np.asarray(salt, dtype=np.float32).astype(np.int32).view(np.uint32)
    h ^= extra * np.uint32(0xC2B2AE3D)
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def stripes(
    x: Floats, period: float | Floats, low: float | Floats, high: float | Floats, footprint: Floats
) -> Floats:
    """Return the coverage of the stripes low <= frac(x / period) < high, box-filtered, [R]."""
    scaled = (x / period).astype(np.float32)
    half = np.maximum(footprint / period, 1e-3).astype(np.float32) * np.float32(0.5)

    def integral(t: Floats) -> Floats:
        whole = np.floor(t)
        return whole * (high - low) + np.clip(t - whole - low, 0, high - low)

    covered: Floats = (integral(scaled + half) - integral(scaled - half)) / (2 * half)
    return covered.astype(np.float32)


def inside(x: Floats, low: float | Floats, high: float | Floats, footprint: Floats) -> Floats:
    """Return the coverage of the interval low <= x <= high by a sample of that footprint, [R]."""
    width = np.maximum(footprint, 1e-3)
    begin = np.maximum(x - width / 2, low)
    end = np.minimum(x + width / 2, high)
    return np.clip((end - begin) / width, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class Points:
    """R points on surfaces of one material."""

    u: Floats  # [R] metres along the surface's first axis
    v: Floats  # [R] metres along its second axis (up, on a wall)
    size: Floats  # [2, R] of the surface, metres
    position: Floats  # [3, R] world metres
    normal: Floats  # [3, R]
    footprint: Floats  # [R] metres covered by a sample
    color: Floats  # [3, R] of the look
    numbers: Floats  # [4, R] of the look


def mix(a: Floats, b: Floats | tuple[float, float, float], amount: Floats) -> Floats:
    """Blend colours a [3, R] to b by amount [R]."""
    blended: Floats = (b if isinstance(b, np.ndarray) else rgb(*b)) - a
    blended *= amount
    blended += a
    return blended


def rgb(red: float, green: float, blue: float) -> Floats:
    """Return one colour for any number of points, [3, 1]."""
    return np.array([[red], [green], [blue]], np.float32)


def facade(p: Points, noise: Noise) -> Floats:
    """Return plaster, brick or banded concrete with windows, and with a shop front if the look has one."""
    seed, style, pitch, shop = p.numbers
    stains = noise.layers(p.u + 7 * seed, p.v, p.footprint, (9.0, 0.05), (2.0, 0.04), (0.5, 0.035))
    streaks = noise((p.u + seed) / 0.7, p.v / 6) * resolved(0.7, p.footprint)
    wall = p.color * (1 + stains + 0.03 * streaks)
    wall *= 0.86 + 0.14 * np.clip(p.v / 1.5, 0, 1)  # splashed and darker at the foot
    courses = stripes(p.v, 0.24, 0.0, 0.16, p.footprint)
    joints = stripes(p.u + 0.25 * np.floor(p.v / 0.24), 0.5, 0.0, 0.06, p.footprint)
    brick = np.clip(courses + joints, 0, 1) * (style == BRICK)
    wall = mix(wall, (0.55, 0.50, 0.45), 0.45 * brick)
    bands = stripes(p.v, FLOOR, 0.0, 0.12, p.footprint) * (style == BANDED)
    wall = mix(wall, wall * 1.35, bands)

    columns = np.maximum(np.floor((p.size[0] - 0.6) / pitch), 1)
    step = p.size[0] / columns
    column, row = np.floor(p.u / step), np.floor(p.v / FLOOR)
    du, dv = p.u - (column + 0.5) * step, p.v - row * FLOOR
    below_roof = p.size[1] - row * FLOOR > 2.9
    kind = np.floor(cell_random(seed, seed, 1) * 3)
    half_width = np.float32(0.46) + np.float32(0.11) * kind + np.float32(0.25) * (style == BANDED)
    is_shop = (row == 0) & (shop > 0)
    half_width = np.where(is_shop, 0.42 * step, half_width)
    sill = np.where(is_shop, np.float32(0.35), np.float32(0.85))
    head = np.where(is_shop, np.float32(2.65), np.float32(2.3))
    wide_enough = (half_width < 0.47 * step) & below_roof

    def cover(grow: float) -> Floats:
        across = inside(du, -half_width - grow, half_width + grow, p.footprint)
        return across * inside(dv, sill - grow, head + grow, p.footprint) * wide_enough

    frame = np.where(style == BRICK, np.float32(0.8), np.float32(0.85))
    wall = mix(wall, frame, 0.8 * cover(0.11))
    ledge = inside(du, -half_width - 0.2, half_width + 0.2, p.footprint) * wide_enough
    wall = mix(wall, wall * 0.6, ledge * inside(dv, sill - 0.3, sill - 0.12, p.footprint))
    return mix(wall, _panes(p, column, row, du, dv, is_shop), cover(0.0))


def _panes(p: Points, column: Floats, row: Floats, du: Floats, dv: Floats, shop: Bools) -> Floats:
    """Return the colours of the windows: dark rooms, curtains, displays, glazing bars."""
    seed = p.numbers[0]
    chance = cell_random(column, row, seed)
    room = rgb(0.05, 0.065, 0.085) * (0.6 + 0.9 * cell_random(column, row, seed + 5))
    room += 0.05 * np.clip(dv - 1.2, 0, 1)
    curtain = (chance > 0.72) & (dv > 0.85 + 1.2 * cell_random(column, row, seed + 9))
    room = mix(room, (0.62, 0.58, 0.5), np.float32(0.75) * curtain)
    display = np.stack([cell_random(column, row, seed + k) for k in (2, 3, 4)]) * 0.35 + 0.08
    room = mix(room, display, np.float32(0.7) * (shop & (dv < 1.7)))
    bars = inside(du, -0.035, 0.035, p.footprint)
    return mix(room, (0.75, 0.75, 0.73), 0.8 * bars * ~shop)


def curtain_wall(p: Points, noise: Noise) -> Floats:
    """Return glass panels between mullions and floor slabs; panels differ a little in tint."""
    seed, pitch = p.numbers[:2]
    column, row = np.floor(p.u / pitch), np.floor(p.v / FLOOR)
    tint = 0.75 + 0.5 * cell_random(column, row, seed)
    blind = cell_random(column, row, seed + 3) > 0.85
    glass = mix(p.color * tint, (0.5, 0.5, 0.46), np.float32(0.6) * blind)
    slab = stripes(p.v, FLOOR, 0.0, 0.2, p.footprint)
    glass = mix(glass, p.color * 0.45, slab)
    mullions = stripes(p.u, pitch, 0.0, 0.09, p.footprint)
    shade = noise.layers(p.u + seed, p.v, p.footprint, (14.0, 0.08))
    return mix(glass, (0.62, 0.64, 0.65), 0.8 * mullions) * (1 + shade)


def gravel(p: Points, noise: Noise) -> Floats:
    """Return gravelled or felted roofs: stones, weathered patches, seams and the odd puddle stain."""
    x, y = p.position[:2]
    seed = p.numbers[0]
    tone = noise.layers(x + seed, y, p.footprint, (6.0, 0.10), (1.7, 0.09), (0.45, 0.12), (0.2, 0.12))
    felt = cell_random(seed, seed, 2) > 0.5
    seams = stripes(p.u, 1.4, 0.0, 0.07, p.footprint) * felt
    panel = (cell_random(np.floor(p.u / 1.4), seed, 7) - 0.5) * 0.16 * felt
    stain = np.clip(noise((x + 3 * seed) / 4.5, y / 4.5) - 1.0, 0, 1)
    color = p.color * (1 + tone + panel)
    return mix(mix(color, color * 0.55, seams), (0.16, 0.16, 0.15), 0.5 * stain)


def tiles(p: Points, noise: Noise) -> Floats:
    """Return rows of roof tiles, each of its own shade, with moss, a ridge and perhaps skylights."""
    seed, skylights = p.numbers[:2]
    course, across = 0.38, 0.34
    row = np.floor(p.v / course)
    column = np.floor(p.u / across + 0.5 * (row % 2))
    single = (cell_random(column, row, seed) - 0.5) * resolved(0.36, p.footprint)
    patch = noise.layers(p.u + seed, p.v, p.footprint, (5.0, 0.09), (1.1, 0.07))
    color = p.color * (1 + 0.45 * single + patch)
    color = mix(color, color * 0.45, 0.8 * stripes(p.v, course, 0.0, 0.2, p.footprint))
    joints = stripes(p.u + 0.5 * across * (row % 2), across, 0.0, 0.15, p.footprint)
    color = mix(color, color * 0.65, 0.6 * joints)
    moss = np.clip(noise((p.u + seed) / 2.6, p.v / 2.6) - 0.9, 0, 0.8) * (1.1 - p.v / p.size[1])
    color = mix(color, (0.17, 0.18, 0.09), 0.6 * np.clip(moss, 0, 1))
    cell_u, cell_v = np.floor(p.u / 3.2), np.floor(p.v / 2.6)
    there = (skylights > 0) & (cell_random(cell_u, cell_v, seed) > 0.45) & (cell_v == 0)
    du, dv = p.u - (cell_u + 0.5) * 3.2, p.v - 1.7
    frame = inside(du, -0.5, 0.5, p.footprint) * inside(dv, -0.7, 0.7, p.footprint) * there
    pane = inside(du, -0.4, 0.4, p.footprint) * inside(dv, -0.6, 0.6, p.footprint) * there
    color = mix(mix(color, (0.35, 0.35, 0.36), frame), (0.10, 0.13, 0.17), pane)
    ridge = inside(p.v, p.size[1] - 0.22, p.size[1] + 1, p.footprint)
    return mix(color, p.color * 0.75, 0.8 * ridge)


def metal(p: Points, noise: Noise) -> Floats:
    """Return sheet metal with standing seams; machines (first number 1) have louvres and a fan grille."""
    louvre = stripes(p.v, 0.3, 0.0, 0.35, p.footprint) * (p.numbers[1] > 0)
    seam = stripes(p.u, 0.6, 0.0, 0.1, p.footprint) * (p.numbers[1] == 0)
    centre = np.hypot(p.u - p.size[0] / 2, p.v - p.size[1] / 2)
    fan = inside(centre, 0.0, 0.38 * p.size.min(0), p.footprint) * (p.normal[2] > 0.9)
    tone = noise.layers(p.u + p.position[0], p.v + p.position[1], p.footprint, (1.5, 0.06), (0.4, 0.05))
    color = p.color * (1 + tone)
    color = mix(mix(color, color * 0.45, louvre), color * 0.7, seam)
    return mix(color, (0.09, 0.09, 0.1), 0.85 * fan)


def plain(p: Points, noise: Noise) -> Floats:
    """Return concrete, plaster, painted boards: the colour with weathering."""
    x = p.u + p.position[0] + p.numbers[0]
    tone = noise.layers(x, p.v + p.position[1], p.footprint, (3.0, 0.07), (0.7, 0.07), (0.25, 0.05))
    return p.color * (1 + tone)


def solar(p: Points, noise: Noise) -> Floats:
    """Return dark panels of 1 m by 1.6 m with bright frames."""
    frames = stripes(p.u, 1.0, 0.0, 0.06, p.footprint) + stripes(p.v, p.size[1], 0.0, 0.05, p.footprint)
    tint = 0.8 + 0.4 * cell_random(np.floor(p.u), np.floor(p.v), p.numbers[0])
    return mix(p.color * tint, (0.45, 0.46, 0.48), np.clip(frames, 0, 1))


def leaves(p: Points, noise: Noise) -> Floats:
    """Return foliage: clumps of light and dark, lighter towards the top of the crown."""
    x, y, z = p.position
    tone = noise.layers(x + 0.7 * z, y + 0.9 * z, p.footprint, (1.3, 0.22), (0.5, 0.25), (0.22, 0.2))
    lift = 0.25 * p.normal[2]
    color: Floats = p.color * np.clip(1.05 + tone + lift, 0.25, 2)
    return mix(color, (0.24, 0.24, 0.05), 0.25 * np.clip(tone, 0, 1))


def paint(p: Points, noise: Noise) -> Floats:
    """Return car paint: the colour, with the bright sky on surfaces that face up."""
    return mix(p.color, (0.6, 0.65, 0.7), 0.12 * np.clip(p.normal[2], 0, 1))
