# SPDX-License-Identifier: Apache-2.0
"""Photographs of the city: primary and shadow rays, materials, sun and sky light, haze."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from blitzgs.util.errors import optional_package
from blitzgs_synth import materials, mesh
from blitzgs_synth.city import build_city
from blitzgs_synth.flight import View
from blitzgs_synth.ground import ground_color
from blitzgs_synth.materials import Noise, Points, rgb
from blitzgs_synth.plan import Bools, Bytes, Doubles, Floats, Ints, Plan, dot


@dataclass(frozen=True)
class Hits:
    """First intersection of R rays."""

    triangle: Ints  # [R] index of the triangle, -1 for a ray that leaves the scene
    distance: Floats  # [R] metres along the unit direction; large where nothing is hit


class RayCaster:
    """A triangle mesh that several threads may cast rays at."""

    def __init__(self, triangles: Floats) -> None:
        """Build the acceleration structure of `triangles` [T, 3, 3] (metres)."""
        scenes, meshes = (
            optional_package(f"embreex.{name}", "synth", "generating a synthetic city")
            for name in ("rtcore_scene", "mesh_construction")
        )
        # Watertight intersection (`robust`) would take a sixth longer and changes a few rays in a million.
        self._scene = scenes.EmbreeScene(robust=False)
        self._mesh = meshes.TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))
        # The first query commits the scene; later ones only read it and may run concurrently.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, -1]], np.float32))

    def hit(self, origins: Floats, directions: Floats) -> Hits:
        """Return what R rays hit first; origins [R, 3] in metres, unit directions [R, 3]."""
        result = self._scene.run(origins, directions, output=True)
        return Hits(result["primID"], result["tfar"])

    def occluded(self, origins: Floats, directions: Floats) -> Bools:
        """Return whether anything lies on R rays, at any distance: bool [R]."""
        if len(origins) == 0:
            return np.zeros(0, bool)
        found: Ints = self._scene.run(origins, directions, query="OCCLUDED")
        return found >= 0


# Four samples per pixel on a rotated grid: every row and column of the 4 x 4 subpixels is met once.
SAMPLES: Final = np.array([[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]], np.float32)
# So many that numpy's calls cost little beside their work; more gain nothing and take memory.
_RAYS_AT_ONCE: Final = 240_000
_OFFSET: Final = 0.02  # distance from the surface, in metres, at which a shadow ray starts

_SUN: Final = np.array([-0.52, -0.42, 0.74], np.float32) / np.float32(np.linalg.norm([-0.52, -0.42, 0.74]))
_SUNLIGHT: Final = rgb(2.35, 2.16, 1.82)
_SKYLIGHT: Final = rgb(0.50, 0.60, 0.76)
_BOUNCE: Final = rgb(0.24, 0.22, 0.19)
_HAZE: Final = rgb(0.66, 0.73, 0.80)
_ZENITH: Final = rgb(0.22, 0.42, 0.80)
# Surface of a ray that meets nothing: shaded as the last surface, then painted over.
_SKY: Final = -1
_SKY_DISTANCE: Final = np.float32(1e6)  # metres, beyond the horizon

_PAINTERS: Final = {
    mesh.FACADE: materials.facade,
    mesh.CURTAIN: materials.curtain_wall,
    mesh.GRAVEL: materials.gravel,
    mesh.TILES: materials.tiles,
    mesh.METAL: materials.metal,
    mesh.PLAIN: materials.plain,
    mesh.SOLAR: materials.solar,
    mesh.LEAVES: materials.leaves,
    mesh.PAINT: materials.paint,
}


class City:
    """A city prepared for photographs; several processes may call its methods at once."""

    def __init__(self, plan: Plan) -> None:
        """Build the geometry and the skylight of `plan`: seconds for a square kilometre."""
        self.plan = plan
        self.mesh = build_city(plan)
        self.caster = RayCaster(self.mesh.triangles)
        self.noise = Noise(plan.options.seed)
        self._haze_length = 30 * max(plan.options.extent, 150.0)
        self._open_sky = self._bake_open_sky()

    def render(self, view: View) -> Bytes:
        """Return the photograph of a view: sRGB uint8 [height, width, 3]."""
        image = np.empty((view.height, view.width, 3), np.uint8)
        rows = max(1, _RAYS_AT_ONCE // (view.width * len(SAMPLES)))
        for top in range(0, view.height, rows):
            bottom = min(top + rows, view.height)
            pixels = np.empty((len(SAMPLES), bottom - top, view.width, 2), np.float32)
            pixels[..., 0] = np.arange(view.width) + SAMPLES[:, None, None, 0]
            pixels[..., 1] = np.arange(top, bottom)[:, None] + SAMPLES[:, None, None, 1]
            display = self.shade(view, pixels.reshape(-1, 2))
            image[top:bottom] = (display * 255 + 0.5).T.reshape(bottom - top, view.width, 3)
        return image

    def hit(self, view: View, pixels: Doubles) -> Hits:
        """Return what the view sees at pixel positions [R, 2]."""
        directions = view.directions(pixels).astype(np.float32)
        return self.caster.hit(np.broadcast_to(view.centre.astype(np.float32), directions.shape), directions)

    def shade(self, view: View, pixels: Floats) -> Floats:
        """Return display values [3, P] of P pixels from the positions of their samples [4 P, 2], P by P.

        Samples of a pixel that meet the same surface are shaded once, at their mean and for the area
        that they cover, because materials filter their own patterns. Shadows have edges within a surface, so
        every sample casts a shadow ray.
        """
        samples = view.directions(pixels)
        centre = view.centre.astype(np.float32)
        hits = self.caster.hit(np.broadcast_to(centre, samples.shape), samples)
        surface = self.mesh.surface[hits.triangle]
        surface[hits.triangle < 0] = _SKY
        distance = np.minimum(hits.distance, _SKY_DISTANCE)
        for k in range(3):  # one column at a time: numpy is slow along an axis of three
            samples[:, k] *= distance
            samples[:, k] += centre[k]
        first, group = self._share(surface)
        count = np.bincount(group, minlength=len(first)).astype(np.float32)
        # Tone mapping each group keeps edges against bright surfaces smooth.
        display = _tone(self._color(view, surface[first], samples, group, count))
        display *= count / np.float32(len(SAMPLES))
        size = len(pixels) // len(SAMPLES)
        return np.stack([np.bincount(first % size, channel, size) for channel in display])

    def _share(self, surface: Ints) -> tuple[Ints, Ints]:
        """Return a sample for each group, [G], and the group of each sample, [4 P]; sorted by material.

        A group has the samples of a pixel that see the same surface; surfaces [4 P]. The ground
        is one surface with hard edges between its parts, so its upper and lower two samples stay apart.
        """
        keys = surface.reshape(len(SAMPLES), -1).copy()
        lower = keys[2:]
        lower[self.mesh.material[lower] == mesh.GROUND] = -2
        leader = np.arange(keys.size, dtype=np.int32).reshape(keys.shape)
        for k in range(1, len(SAMPLES)):
            for earlier in reversed(range(k)):
                np.copyto(leader[k], leader[earlier], where=keys[k] == keys[earlier])
        leaders = leader.ravel()
        first = np.flatnonzero(leaders == np.arange(keys.size, dtype=np.int32))
        first = first[np.argsort(self.mesh.material[surface[first]], kind="stable")]
        number = np.empty(keys.size, np.intp)
        number[first] = np.arange(len(first))
        return first, number[leaders]

    def _color(self, view: View, surface: Ints, samples: Floats, group: Ints, count: Floats) -> Floats:
        """Return the scene-linear RGB [3, G] of groups of samples at positions [S, 3].

        `surface`: of each of G groups, sorted by material. `group`: of each sample [S]. `count`: samples of
        each group [G].
        """
        sums = np.stack([np.bincount(group, channel) for channel in samples.T])
        position = (sums / count).astype(np.float32)
        direction = position - view.centre.astype(np.float32)[:, None]
        distance = np.sqrt(dot(direction, direction))
        direction /= distance
        # A sample covers half a pixel's width.
        pixel = distance * np.float32(0.5 / view.focal) * np.sqrt(count)
        material = self.mesh.material[surface]
        edges = np.searchsorted(material, np.arange(mesh.MATERIALS + 1, dtype=material.dtype))
        parts = [slice(a, b) for a, b in itertools.pairwise(edges)]
        normal = self.mesh.normal.take(surface, 1)
        crowns = parts[mesh.LEAVES]
        outward = position[:, crowns] - self.mesh.origin.take(surface[crowns], 1)
        outward /= np.square(self.mesh.size.take(surface[crowns], 1)[[0, 0, 1]])
        outward /= np.sqrt(dot(outward, outward))
        outward += self._ruffle(position[:, crowns], pixel[crowns])
        normal[:, crowns] = outward / np.sqrt(dot(outward, outward))
        slant = dot(normal, direction)
        normal *= np.where(slant > 0, np.float32(-1), np.float32(1))
        # On a slanted surface the footprint is longer one way, taken as the mean of both axes.
        footprint = pixel / np.sqrt(np.maximum(np.abs(slant), 0.15))

        albedo = self._albedo(view, surface, parts, position, normal, footprint)
        sunny = self._sunny(samples, group, count, normal, material)
        lit = self._light(position, normal, sunny)
        lit *= albedo
        for part in (parts[mesh.CURTAIN], parts[mesh.SOLAR]):
            self._reflect(lit[:, part], albedo[:, part], direction[:, part], normal[:, part])
        lit -= _HAZE
        lit *= np.exp(-distance / np.float32(self._haze_length))
        lit += _HAZE
        sky = np.flatnonzero(surface == _SKY)
        lit[:, sky] = self._sky(direction[:, sky])
        return lit

    def _ruffle(self, position: Floats, footprint: Floats) -> Floats:
        """Return offsets for the smooth normals of foliage [3, R], which make crowns look like leaves."""
        x, y, z = position
        bands = ((1.1, 0.30), (0.45, 0.30))
        turns = [
            self.noise.layers(a, b, footprint, *bands)
            for a, b in ((x + z, y - z), (y + z, z - x), (z + y, x + y))
        ]
        return np.stack(turns)

    def _albedo(
        self,
        view: View,
        surface: Ints,
        parts: list[slice],
        position: Floats,
        normal: Floats,
        footprint: Floats,
    ) -> Floats:
        albedo = np.empty((3, len(surface)), np.float32)
        for kind, part in enumerate(parts):
            s = surface[part]
            if len(s) == 0:
                continue
            if kind == mesh.GROUND:
                where = position[:, part]
                albedo[:, part] = ground_color(self.plan, self.noise, where, footprint[part], view.centre)
                continue
            offset = position[:, part] - self.mesh.origin.take(s, 1)
            points = Points(
                u=dot(offset, self.mesh.axis_u.take(s, 1)),
                v=dot(offset, self.mesh.axis_v.take(s, 1)),
                size=self.mesh.size.take(s, 1),
                position=position[:, part],
                normal=normal[:, part],
                footprint=footprint[part],
                color=self.mesh.color.take(s, 1),
                numbers=self.mesh.numbers.take(s, 1),
            )
            albedo[:, part] = _PAINTERS[kind](points, self.noise)
        return np.clip(albedo, 0.005, 0.92, out=albedo)

    def _sunny(self, samples: Floats, group: Ints, count: Floats, normal: Floats, material: Ints) -> Floats:
        """Return the cosine at which the sun shines on each group, times its samples without shadow, [G]."""
        facing = dot(_SUN, normal)
        # Light passes through leaves, so crowns are lit a little past their terminator.
        facing = np.where(material == mesh.LEAVES, 0.75 * facing + 0.25, facing)
        towards = np.flatnonzero((facing > 0)[group])
        lit = group[towards]
        # Rays of foliage start further out; otherwise each crown would shade itself.
        lift = normal * np.where(material == mesh.LEAVES, np.float32(0.35), np.float32(_OFFSET))
        origins = samples.take(towards, 0)
        origins += np.ascontiguousarray(lift.T).take(lit, 0)
        dark = self.caster.occluded(origins, np.broadcast_to(_SUN, origins.shape))
        share = np.bincount(lit[dark], minlength=len(count)).astype(np.float32) / count
        return np.clip(facing, 0, 1) * (1 - share)

    def _light(self, position: Floats, normal: Floats, sunny: Floats) -> Floats:
        """Return the irradiance [3, G]: sun outside shadows, sky by openness, light from the ground."""
        openness = self._openness(position + np.float32(1.5) * normal)
        sky = openness * (0.55 + 0.45 * normal[2])
        bounce = (0.5 - 0.5 * normal[2]) * (0.4 + 0.6 * openness)
        light: Floats = sunny * _SUNLIGHT
        light += sky * _SKYLIGHT
        light += bounce * _BOUNCE
        return light

    def _reflect(self, lit: Floats, albedo: Floats, direction: Floats, normal: Floats) -> None:
        """Add to `lit` the sky mirrored in glass (Schlick's approximation)."""
        cosine = np.clip(-dot(direction, normal), 0, 1)
        fresnel = 0.08 + 0.92 * (1 - cosine) ** 5
        mirrored = direction + 2 * cosine * normal
        # A mirrored ray that points down meets other buildings.
        seen = np.where(mirrored[2] > 0, self._sky(mirrored), np.float32(0.22))
        glass = albedo.max(0) < 0.45
        lit += fresnel * glass * (seen - lit)

    def _sky(self, direction: Floats) -> Floats:
        up = np.clip(direction[2], 0, 1)
        color: Floats = _HAZE + (_ZENITH - _HAZE) * (1 - (1 - up) ** 3)
        x, y = direction[:2] / np.maximum(up, 0.03)
        cloud = np.clip(0.7 * self.noise(x * 0.9, y * 0.9) + 0.4 * self.noise(x * 2.3, y * 2.3) - 0.2, 0, 1)
        cloud *= np.clip(up * 6, 0, 1)
        return color + 0.6 * cloud * (np.float32(0.95) - color)

    def _bake_open_sky(self) -> Floats:
        """Return a square map of the sky seen from the ground (cosine-weighted, 0 to 1) over the city."""
        side = 384
        self._map_half = np.float32(self.plan.half + 25)
        line = (np.arange(side, dtype=np.float32) + 0.5) / side * 2 - 1
        x, y = (a.ravel() * self._map_half for a in np.meshgrid(line, line))
        origins = np.stack([x, y, np.full_like(x, 0.05)], 1)
        rng = np.random.default_rng(5)
        blocked = np.zeros(len(origins), np.float32)
        rays = 24
        for k in range(rays):
            # Cosine-weighted directions on a golden-angle spiral, turned at random per point.
            radius = np.sqrt((k + 0.5) / rays)
            angle = 2.399963 * k + rng.uniform(0, 2 * np.pi, len(origins))
            z = np.full(len(origins), np.sqrt(1 - radius**2))
            directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1).astype(np.float32)
            blocked += self.caster.occluded(origins, directions)
        return cv2.GaussianBlur((1 - blocked / rays).reshape(side, side), (0, 0), 1.3)

    def _openness(self, position: Floats) -> Floats:
        """Return how much sky is seen [R]: the baked map near the ground, more with height."""
        side = len(self._open_sky)
        scale = np.float32(side / 2) / self._map_half
        x, y = ((position[:2] + self._map_half) * scale).astype(np.int32)
        inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
        low = np.where(inside, self._open_sky.take(y * side + x, mode="clip"), np.float32(1))
        raised = np.clip(position[2] / 16, 0, 1)
        return np.maximum(low, 0.35) * (1 - raised) + raised


def _tone(linear: Floats) -> Floats:
    """Return display values [0, 1] of scene-linear colours: a filmic shoulder, then the sRGB curve."""
    x = np.float32(0.54) * linear
    filmic = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return np.where(
        filmic < 0.0031308, 12.92 * filmic, 1.055 * np.power(np.maximum(filmic, 1e-6), 1 / 2.4) - 0.055
    ).astype(np.float32)
