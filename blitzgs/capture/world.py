# SPDX-License-Identifier: Apache-2.0
"""Where a capture lies in the world: the similarity from its coordinates to those of a reference system.

All of it is float64: at 5,000,000 m, neighbouring float32 numbers are half a metre apart.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.fields import read_small
from blitzgs.util.errors import WRONG_CONTENT, optional_package, warn

# The file of a run, and of a capture whose world its own files do not say.
GEO = "geo.json"
GEOCENTRIC = "EPSG:4978"
# The smaller spread of points, as a share of the larger, from which a similarity has no free turn left.
_LEAST_WIDTH = 1e-3
# UTM stretches lengths by less even in the zones beside the right one.
_MOST_STRETCH = 0.02
# WGS 84: the major axis in metres, and the square of the eccentricity.
_AXIS, _E2 = 6378137.0, (2 - 1 / 298.257223563) / 298.257223563


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """Maps coordinates of a capture to the world: world = scale * rotation @ capture + translation."""

    crs: str = ""  # the world's reference system, as "EPSG:32633" or WKT; empty: a local one
    scale: float = 1.0  # world units per unit of the capture
    rotation: Float64 = field(default_factory=lambda: np.eye(3))  # [3, 3]
    translation: Float64 = field(default_factory=lambda: np.zeros(3))  # [3], world units
    source: str = ""  # what says so, for messages

    def __post_init__(self) -> None:
        rotation, translation = np.asarray(self.rotation, float), np.asarray(self.translation, float)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"{self.source}: rotation must be 3 x 3 and translation 3 numbers")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError(f"{self.source}: rotation must be a rotation, got {rotation.tolist()}")
        if not (math.isfinite(self.scale) and self.scale > 0 and np.isfinite(translation).all()):
            raise ValueError(
                f"{self.source}: scale must be positive and translation finite, got {self.scale}, "
                f"{translation.tolist()}"
            )

    def to_world(self, positions: Float64) -> Float64:
        """Return positions [..., 3] of the capture in the world."""
        return np.asarray(self.scale * positions @ self.rotation.T + self.translation)

    def from_world(self, positions: Float64) -> Float64:
        """Return positions [..., 3] of the world in the capture."""
        return np.asarray((positions - self.translation) @ self.rotation / self.scale)

    @property
    def name(self) -> str:
        """The reference system in few words."""
        if match := re.match(r'\s*\w+\[\s*"([^"]+)"', self.crs):
            return match[1]
        return self.crs or "local coordinates"

    def label(self, position: Float64) -> str:
        """Return a position [3] of the capture in the world, for people."""
        if self.crs == GEOCENTRIC:
            latitude, longitude, height = geodetic(self.to_world(position))
            return f"{latitude:.7f}\N{DEGREE SIGN} {longitude:.7f}\N{DEGREE SIGN} {height:.2f} m (WGS 84)"
        return "E {:.2f} N {:.2f} h {:.2f}".format(*self.to_world(position)) + f" ({self.name})"

    def as_json(self) -> dict[str, Any]:
        """Return the content of the file `geo.json`."""
        arrays = {name: np.asarray(getattr(self, name)).tolist() for name in ("rotation", "translation")}
        return {"meaning": "world = scale * rotation @ capture + translation", **vars(self), **arrays}


def fit_similarity(capture: Float64, world: Float64, crs: str = "", source: str = "") -> WorldFrame:
    """Return the similarity that maps points of a capture to the world, [N, 3] each, by least squares.

    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
    ValueError: there are fewer than three points, or they lie on a line: a turn around it is free.
    """
    if len(capture) < 3:
        raise ValueError(f"a similarity needs at least 3 points, got {len(capture)}: measure more")
    mean, target = capture.mean(axis=0), world.mean(axis=0)
    a, b = capture - mean, world - target
    for name, points in (("in the capture", a), ("in the world", b)):
        spread = np.linalg.svd(points, compute_uv=False)
        if not spread[1] > _LEAST_WIDTH * spread[0]:  # NaN too
            raise ValueError(
                f"the {len(points)} points lie on a line {name} (spread {spread[0]:.4g} along it and "
                f"{spread[1]:.4g} across), so a turn around it is free: add a point beside it"
            )
    u, singular, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u * sign @ vt
    scale = float((singular * sign).sum() / (a * a).sum())
    return WorldFrame(crs, scale, rotation, target - scale * rotation @ mean, source)


def read_world_frame(path: Path) -> WorldFrame:
    """Read `geo.json` (ValueError: the file is damaged)."""
    try:
        content = json.loads(read_small(path))
        crs, scale = content.get("crs", ""), content.get("scale", 1.0)
        if not isinstance(crs, str) or isinstance(scale, bool) or not isinstance(scale, (int, float)):
            raise TypeError("crs must be text and scale a number")
        rotation, translation = (
            np.asarray(content.get(name, default), dtype=np.float64)
            for name, default in (("rotation", np.eye(3)), ("translation", np.zeros(3)))
        )
        return WorldFrame(crs, float(scale), rotation, translation, str(path.name))
    except WRONG_CONTENT as error:
        raise ValueError(f"{path} is damaged ({error}): write it again with blitzgs align") from error


def frame_beside(root: Path) -> WorldFrame | None:
    """Return the frame that a file in the folder of a capture gives; None: there is no such file.

    It is `geo.json`, or an offset (`offset.xyz`, `*_offset.xyz` or `offset.txt`: three numbers to add), with
    the reference system in a `.prj` beside it, if there is one: of several, that whose name is, or begins as,
    the offset's. ValueError: the file is damaged, or there are several offsets or reference systems.
    """
    if (root / GEO).is_file():
        return read_world_frame(root / GEO)
    paths = sorted({*root.glob("*offset.xyz"), *root.glob("offset.txt")})
    if not paths:
        return None
    every, begin = sorted(root.glob("*.prj")), re.sub(r"_?offset\.\w+$", "", paths[0].name) or "offset"
    # Shapefiles of the site have a .prj of their own.
    systems = [path for path in every if path.stem == begin]
    systems = systems or [path for path in every if path.name.startswith(begin)] or every
    for several, remedy in ((paths, "keep that one"), (systems, f"copy that one to {begin}.prj")):
        if len({read_small(path).strip() for path in several}) > 1:
            shown = ", ".join(path.name for path in several[:5])
            raise ValueError(f"{root}: {shown} differ, and one says where the capture lies: {remedy}")
    return read_offset(paths[0], systems)


def read_offset(path: Path, prj: list[Path]) -> WorldFrame:
    """Read a file of three numbers that are added to a capture's coordinates (else ValueError)."""
    words = re.split(r"[\s,;]+", read_small(path).strip())
    try:
        offset = np.array([float(word) for word in words])
        if offset.shape != (3,):
            raise ValueError(f"{len(words)} values")
    except ValueError as error:
        raise ValueError(
            f"{path} must hold the three numbers of an offset ({error}); correct it, or move it away"
        ) from error
    crs = read_small(prj[0]).strip() if prj else ""
    return WorldFrame(crs, translation=offset, source=path.name)


def utm_of_text(text: str) -> str:
    """Return the code of a zone that OpenDroneMap writes as "WGS84 UTM 33N"; empty: it is none."""
    zone = re.fullmatch(r"WGS84 UTM (\d{1,2})([NS])", text.strip())
    return f"EPSG:{(32600 if zone[2] == 'N' else 32700) + int(zone[1])}" if zone else ""


def enu_frame(latitude: float, longitude: float, altitude: float, source: str) -> WorldFrame:
    """Return the frame of a capture whose axes are east, north and up at a place of WGS 84.

    Latitude and longitude are in degrees, the altitude in metres above the ellipsoid.
    """
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and abs(altitude) < 1e6):  # NaN too
        raise ValueError(f"{source}: no place on earth: {latitude}, {longitude}, {altitude}")
    lat, lon = math.radians(latitude), math.radians(longitude)
    n = _AXIS / math.sqrt(1 - _E2 * math.sin(lat) ** 2)
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    origin = (n + altitude) * up - np.array([0, 0, n * _E2 * math.sin(lat)])
    return WorldFrame(GEOCENTRIC, 1.0, np.stack([east, np.cross(up, east), up], axis=1), origin, source)


def geodetic(position: Float64) -> tuple[float, float, float]:
    """Return latitude and longitude in degrees and the height above WGS 84 of a geocentric position [3]."""
    x, y, z = position.tolist()
    across = math.hypot(x, y)
    latitude = math.atan2(z, across * (1 - _E2))
    for _ in range(10):  # converges by a factor of 300 a step near the ground
        n = _AXIS / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z + _E2 * n * math.sin(latitude), across)
    up = across * math.cos(latitude) + z * math.sin(latitude)
    height = up - _AXIS * math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), height


def reference_system(crs: str) -> Any:
    """Return a reference system by its name (ImportError: pyproj is missing; ValueError: it is unknown)."""
    pyproj = optional_package("pyproj", "geo", "this")
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(f"{crs!r:.60} is no reference system: name one such as EPSG:32633") from error


def system_of_lengths(crs: str) -> Any:
    """Return a reference system with one unit, that of lengths; errors as `reference_system`."""
    system = reference_system(crs)
    if system.is_geographic:
        raise ValueError(f"{crs} ({system.name}) has angles: give places in a projected one, as a UTM zone")
    units = [axis.unit_conversion_factor for axis in system.axis_info]
    if max(units) > 1.001 * min(units):  # feet differ by 2e-6
        raise ValueError(
            f"{crs} ({system.name}) has heights in another unit than lengths: use one with both in one unit"
        )
    return system


def _with_heights(crs: str) -> Any:
    """Return a reference system that has heights, above the ellipsoid and in the unit of its lengths."""
    flat = reference_system(crs)
    system = flat.to_3d()
    if not flat.is_projected or len(flat.axis_info) > 2:
        return system
    content = system.to_json_dict()
    axes = content.get("source_crs", content)["coordinate_system"]["axis"]  # TOWGS84 binds a system
    axes[2]["unit"] = axes[0]["unit"]
    return type(system).from_json_dict(content)


def converted(positions: Float64, source: Any, target: Any) -> Float64:
    """Return positions [N, 3] of one reference system in another one, x east and y north.

    A system of two axes has heights above the ellipsoid, in its own unit. Warns if grids are missing.
    ImportError: pyproj is not installed. ValueError: a system is unknown, or a position has no coordinates in
    it.
    """
    pyproj = optional_package("pyproj", "geo", "this")
    systems = [_with_heights(system) for system in (source, target)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ours says what to do
            ways = pyproj.transformer.TransformerGroup(*systems, always_xy=True)
        transformer = pyproj.Transformer.from_crs(*systems, always_xy=True)
        moved = np.stack(transformer.transform(*positions.T, errcheck=True), axis=1)
    except pyproj.exceptions.ProjError as error:
        raise ValueError(f"from {source} to {target}: {error}") from error
    if not np.isfinite(moved).all():
        raise ValueError(f"{positions[0].tolist()} of {source} has no coordinates in {target}")
    if not ways.best_available:
        grids = ", ".join(grid.short_name for grid in ways.unavailable_operations[0].grids)
        accuracy = ways.transformers[0].accuracy
        within = (
            f"are right to {accuracy:g} m" if accuracy >= 0 else "may be wrong by 100 m, above all in height"
        )
        warn(
            f"from {systems[0].name} to {systems[1].name}, places {within}, as grids of the exact conversion "
            f"are missing ({grids}): fetch them with pyproj sync --file NAME"
        )
    return moved


def frame_in(frame: WorldFrame, crs: str, places: Float64) -> tuple[WorldFrame, float]:
    """Return a frame in another reference system with lengths ("EPSG:32633"), and its largest error.

    A map projection is no similarity of space: the error is what the earth's curvature and the projection's
    scale make of the difference at the places of the capture, [N, 3]. ImportError: pyproj is not installed.
    ValueError: the reference system is unknown or has angles, or the places are too few.
    """
    wanted = system_of_lengths(crs)
    if not (wanted.is_projected or wanted.is_geocentric):
        raise ValueError(f"{crs} ({wanted.name}) has no place on earth: use a projected one, as a UTM zone")
    if not frame.crs:
        raise ValueError("the present world has no reference system, so it cannot be converted: use --gcp")
    around = places.mean(axis=0) + np.ptp(places, axis=0).max() * 0.1 * np.concatenate(
        [np.eye(3), -np.eye(3)]
    )
    every = np.concatenate([places, around])
    target = converted(frame.to_world(every), frame.crs, crs)
    found = fit_similarity(every, target, crs, f"{frame.source}, converted from {frame.name}")
    largest = np.linalg.norm(found.to_world(places) - target[: len(places)], axis=1).max()
    units = [reference_system(name).axis_info[0].unit_conversion_factor for name in (frame.crs, crs)]
    stretch = found.scale * units[1] / (frame.scale * units[0])
    if abs(stretch - 1) > _MOST_STRETCH:
        warn(
            f"lengths in {crs} ({wanted.name}) are {stretch:.3g} times those on the ground at this place: "
            "name a system that is made for it, such as its UTM zone"
        )
    return found, float(largest)


# Tags of EXIF 2.32, section 4.6.6.
_GPS = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)


def gps_positions(paths: Sequence[Path]) -> list[tuple[float, float, float] | None]:
    """Return longitude, latitude (degrees) and height (metres) of each photograph; None: it has none.

    The height is the receiver's: above the ellipsoid or above sea level, as EXIF does not say. ImportError:
    Pillow, which reads the tags, is not installed.
    """
    images = optional_package("PIL.Image", "geo", "reading EXIF")
    found = []
    for path in paths:
        try:
            with images.open(path) as image:
                found.append(_position(image.getexif().get_ifd(_GPS)))
        except (OSError, ValueError, SyntaxError):  # damaged, or a format without EXIF
            found.append(None)
    return found


def _position(tags: Any) -> tuple[float, float, float] | None:
    try:
        latitude = _degrees(tags[_LATITUDE]) * (-1 if tags[_LATITUDE_REF] == "S" else 1)
        longitude = _degrees(tags[_LONGITUDE]) * (-1 if tags[_LONGITUDE_REF] == "W" else 1)
        altitude = float(tags[_ALTITUDE]) * (-1 if tags.get(_ALTITUDE_REF) in (1, b"\x01") else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    on_earth = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 1e5  # false for NaN
    return (longitude, latitude, altitude) if on_earth and (latitude, longitude) != (0, 0) else None


def _degrees(parts: Any) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600
