# SPDX-License-Identifier: Apache-2.0
"""Points of LAS, LAZ (laspy) and E57 files (pye57) as arrays."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import Float64

SUFFIXES = (".las", ".laz", ".e57")
# A start needs no more: denser clouds are thinned evenly while they are read.
_MOST = 10_000_000
_CHUNK = 2_000_000
_GREY = 128


def read_points(path: Path) -> tuple[Float64, npt.NDArray[np.uint8] | None, Any]:
    """Return positions [M, 3], colours [M, 3] (None: the file has none), and the reference system or None.

    Raises:
        ImportError: the package that reads the format is not installed.
        ValueError: the file is damaged; names it.
    """
    try:
        return _read_e57(path) if path.suffix.lower() == ".e57" else _read_las(path)
    except (ImportError, MemoryError):
        raise
    except Exception as error:  # the packages raise all kinds of errors for damaged files
        raise ValueError(f"{path} cannot be read ({error}): export the points again, or as PLY") from error


def _step(path: Path, count: int) -> int:
    """Return of how many points one is kept, and say it."""
    step = max(1, -(-count // _MOST))
    if step > 1:
        warnings.warn(f"{path}: every {step}th of {count:,} points is used", stacklevel=5)
    return step


def _read_las(path: Path) -> tuple[Float64, npt.NDArray[np.uint8] | None, Any]:
    try:
        import laspy
    except ImportError as error:
        raise ImportError(f'{path}: reading it needs laspy: pip install "blitzgs[geo]"') from error
    with laspy.open(path) as reader:
        header = reader.header
        step, begin = _step(path, header.point_count), 0
        has_color = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
        positions, colors = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.uint16)]
        for chunk in reader.chunk_iterator(_CHUNK):
            kept = slice(-begin % step, None, step)
            begin += len(chunk)
            # Integers times scale plus offset, in float64.
            positions.append(
                np.stack([np.asarray(axis)[kept] for axis in (chunk.x, chunk.y, chunk.z)], axis=1)
            )
            if has_color:
                colors.append(
                    np.stack([np.asarray(c)[kept] for c in (chunk.red, chunk.green, chunk.blue)], axis=1)
                )
        crs = _crs(header)
    found = np.concatenate(colors)
    if not has_color or not found.any():
        return np.concatenate(positions), None, crs
    # The format has 16 bits, but some programs write bytes.
    return np.concatenate(positions), (found >> (8 if found.max() > 255 else 0)).astype(np.uint8), crs


def _crs(header: Any) -> Any:
    try:
        return header.parse_crs()
    except Exception as error:  # pyproj is not installed, or does not know the system
        warnings.warn(f"the reference system of the points is not read ({error})", stacklevel=5)
        return None


def _read_e57(path: Path) -> tuple[Float64, npt.NDArray[np.uint8] | None, None]:
    try:
        import pye57
    except ImportError as error:
        raise ImportError(f'{path}: reading it needs pye57: pip install "blitzgs[geo]"') from error
    file = pye57.E57(str(path))
    try:
        step = _step(path, sum(file.get_header(i).point_count for i in range(file.scan_count)))
        positions, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for index in range(file.scan_count):
            with_color = {"colorRed", "colorGreen", "colorBlue"} <= set(file.get_header(index).point_fields)
            # The pose of each scan is applied.
            scan = file.read_scan(index, colors=with_color, ignore_missing_fields=True)
            xyz = np.stack([scan[f"cartesian{axis}"][::step] for axis in "XYZ"], axis=1).astype(np.float64)
            positions.append(xyz)
            if with_color:
                rgb = np.stack([scan[f"color{c}"][::step] for c in ("Red", "Green", "Blue")], axis=1)
                colors.append(rgb.astype(np.float64))
            else:
                colors.append(np.full(xyz.shape, np.nan))
    finally:
        file.close()
    found = np.concatenate(colors)
    if not len(found) or np.isnan(found).all():
        return np.concatenate(positions), None, None
    white = 255.0 if np.nanmax(found) > 1 else 1.0
    white = 65535.0 if np.nanmax(found) > 255 else white
    scaled = np.where(np.isnan(found), _GREY, found * (255 / white))
    return np.concatenate(positions), np.clip(scaled + 0.5, 0, 255).astype(np.uint8), None
