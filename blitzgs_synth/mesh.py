# SPDX-License-Identifier: Apache-2.0
"""Collects the surfaces of a city and turns them into triangles with material frames."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from blitzgs_synth.plan import Doubles, Floats, Ints, Plan

Point = tuple[float, float, float]
Color = tuple[float, float, float]

GROUND, FACADE, CURTAIN, GRAVEL, TILES, METAL, PLAIN, LEAVES, PAINT, SOLAR = range(10)
MATERIALS = SOLAR + 1
_MAX_DETAILED_BLOBS = 6000


@dataclass(frozen=True)
class Look:
    """A material with its colour (linear RGB) and four numbers whose meaning is the material's own."""

    material: int
    color: Color
    seed: float = 0.0
    a: float = 0.0
    b: float = 0.0
    c: float = 0.0


@dataclass(frozen=True)
class Mesh:
    """Triangles and the flat or round surfaces they belong to."""

    triangles: Floats  # [T, 3, 3] world metres
    surface: Ints  # [T] row of the tables below
    origin: Floats  # [3, S] first corner, or centre of a round surface
    axis_u: Floats  # [3, S] unit, along the first edge
    axis_v: Floats  # [3, S] unit, at a right angle to it in the surface
    normal: Floats  # [3, S] unit, outwards; meaningless for a round surface
    size: Floats  # [2, S] metres along u and v
    material: Ints  # [S]
    color: Floats  # [3, S] linear RGB
    numbers: Floats  # [4, S] seed, a, b, c of the look


class MeshBuilder:
    """Collects quads and blobs in plan coordinates."""

    def __init__(self) -> None:
        self._quads: list[tuple[tuple[Point, Point, Point, Point], Look]] = []
        self._blobs: list[tuple[tuple[float, ...], Look]] = []  # centre and radii

    def quad(self, a: Point, b: Point, c: Point, d: Point, look: Look) -> None:
        """Add a quad, counter-clockwise from outside; u runs from a to b. c = d makes a triangle."""
        self._quads.append(((a, b, c, d), look))

    def walls(self, x0: float, y0: float, x1: float, y1: float, z0: float, z1: float, look: Look) -> None:
        """Add the four walls of a box."""
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        for (ax, ay), (bx, by) in pairwise([*corners, corners[0]]):
            self.quad((ax, ay, z0), (bx, by, z0), (bx, by, z1), (ax, ay, z1), look)

    def top(self, x0: float, y0: float, x1: float, y1: float, z: float, look: Look) -> None:
        """Add a level rectangle facing up."""
        self.quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z), look)

    def box(
        self, x0: float, y0: float, x1: float, y1: float, z0: float, z1: float, side: Look, top: Look
    ) -> None:
        """Add a box without its underside."""
        self.walls(x0, y0, x1, y1, z0, z1, side)
        self.top(x0, y0, x1, y1, z1, top)

    def pyramid(self, x: float, y: float, half: float, z0: float, z1: float, look: Look) -> None:
        """Add the four sides of a roof over a square, `half` to each side of its middle."""
        corners = [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
        for (ax, ay), (bx, by) in pairwise([*corners, corners[0]]):
            self.quad((ax, ay, z0), (bx, by, z0), (x, y, z1), (x, y, z1), look)

    def blob(self, centre: Point, radii: Point, look: Look) -> None:
        """Add a bumpy ellipsoid (the crown of a tree, a bush)."""
        self._blobs.append(((*centre, *radii), look))

    def build(self, plan: Plan) -> Mesh:
        """Bend everything into the world and return the mesh."""
        corners = plan.bend(np.array([quad for quad, _ in self._quads], np.float64).reshape(-1, 4, 3))
        edge_u = corners[:, 1] - corners[:, 0]
        size_u = np.linalg.norm(edge_u, axis=1)
        axis_u = edge_u / size_u[:, None]
        edge_v = corners[:, 3] - corners[:, 0]
        edge_v -= (edge_v * axis_u).sum(1, keepdims=True) * axis_u
        size_v = np.linalg.norm(edge_v, axis=1)
        axis_v = edge_v / size_v[:, None]
        quad_triangles = corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)

        blobs = np.array([blob for blob, _ in self._blobs], np.float64).reshape(-1, 6)
        centres = plan.bend(blobs[:, :3])
        seeds = [look.seed for _, look in self._blobs]
        blob_triangles, per_blob = _blob_triangles(centres, blobs[:, 3:], seeds)

        count, round_count = len(corners), len(blobs)
        looks = [look for _, look in (*self._quads, *self._blobs)]
        unit = np.tile(np.eye(3)[None], (round_count, 1, 1))
        of_blobs = count + np.repeat(np.arange(round_count), per_blob)
        surface = np.concatenate([np.repeat(np.arange(count), 2), of_blobs])
        return Mesh(
            triangles=np.concatenate([quad_triangles, blob_triangles]).astype(np.float32),
            surface=surface.astype(np.int32),
            origin=_columns(np.concatenate([corners[:, 0], centres])),
            axis_u=_columns(np.concatenate([axis_u, unit[:, 0]])),
            axis_v=_columns(np.concatenate([axis_v, unit[:, 1]])),
            normal=_columns(np.concatenate([np.cross(axis_u, axis_v), unit[:, 2]])),
            size=_columns(np.concatenate([np.stack([size_u, size_v], 1), blobs[:, 3:5]])),
            material=np.array([x.material for x in looks], np.int8),
            color=_columns(np.array([x.color for x in looks])),
            numbers=_columns(np.array([(x.seed, x.a, x.b, x.c) for x in looks])),
        )


def _columns(rows: Doubles) -> Floats:
    """Return rows [S, K] as contiguous columns [K, S]: numpy is several times faster along long axes."""
    return np.ascontiguousarray(rows.T, dtype=np.float32)


def _blob_triangles(centres: Doubles, radii: Doubles, seeds: list[float]) -> tuple[Doubles, int]:
    """Return the triangles [B * F, 3, 3] of B bumpy ellipsoids and F."""
    vertices, faces = _sphere(3 if len(centres) <= _MAX_DETAILED_BLOBS else 2)
    phase = np.array(seeds).reshape(-1, 1)
    x, y, z = vertices.T
    bumps = np.sin(3.1 * x + phase) * np.sin(2.7 * y + 2.3 * phase) + np.sin(4.3 * z + 1.7 * phase + 2 * x)
    shape = vertices[None] * (1 + 0.14 * bumps)[:, :, None]
    points = centres[:, None] + radii[:, None] * shape
    return points[:, faces].reshape(-1, 3, 3), len(faces)


def _sphere(subdivisions: int) -> tuple[Doubles, Ints]:
    """Return unit vertices [V, 3] and faces [F, 3] of an octahedron refined that often."""
    vertices = [(1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0, 0, 1.0), (0, 0, -1.0)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(subdivisions):
        middles: dict[tuple[int, int], int] = {}

        def middle(i: int, j: int, middles: dict[tuple[int, int], int] = middles) -> int:
            key = (min(i, j), max(i, j))
            if key not in middles:
                point = np.add(vertices[i], vertices[j])
                vertices.append(tuple(point / np.linalg.norm(point)))
                middles[key] = len(vertices) - 1
            return middles[key]

        refined = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            refined += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = refined
    return np.array(vertices), np.array(faces)
