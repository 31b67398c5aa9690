# SPDX-License-Identifier: Apache-2.0
"""Ground control points: surveyed places marked in photographs, and the similarity that they give."""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from blitzgs.capture.cameras import Camera, Float64, camera_centres, is_folded
from blitzgs.capture.fields import number, read_small
from blitzgs.capture.lens import Lens
from blitzgs.capture.names import any_case, by_parts
from blitzgs.capture.world import WorldFrame, fit_similarity, utm_of_text
from blitzgs.util.errors import located

T = TypeVar("T")
# The least angle between two rays to a point, in degrees: below it, its distance is unknown.
_LEAST_ANGLE = 1.0
_COLUMNS = ("name", "e", "n", "h", "image", "x", "y")
_NUMBERS = ("e", "n", "h", "x", "y")
_SAME = {"east": "e", "easting": "e", "north": "n", "northing": "n", "height": "h", "up": "h", "z": "h",
         "alt": "h", "gcp": "name", "label": "name", "photo": "image", "px": "x", "py": "y"}  # fmt: skip
# Of so many triples of points the best is searched.
_TRIPLES = 500


@dataclass
class ControlPoint:
    """A surveyed place and its marks; the fields from `problem` on are those of `place` and `align`."""

    name: str  # of the point
    world: Float64  # east, north, height
    # photograph's name, x and y in its pixels; the corner of the first pixel is (0, 0).
    marks: list[tuple[str, float, float]] = field(default_factory=list)
    problem: str = ""  # why it is not used; empty: it is
    position: Float64 | None = None  # [3] in the capture's own world; None: `problem` says why there is none
    seen: list[tuple[Camera, float, float]] = field(
        default_factory=list
    )  # marks in the capture's photographs
    # [3] in world units, the fitted place minus the surveyed one.
    offset: Float64 = field(default_factory=lambda: np.full(3, math.nan))
    reprojection: float = math.nan  # root mean square distance in pixels of the surveyed place from the marks


def read_control_points(path: Path) -> tuple[list[ControlPoint], str]:
    """Read points from CSV (name, E, N, h, image, x, y; a row a mark) or OpenDroneMap's gcp_list.txt.

    Returns the points, and the reference system that gcp_list.txt names (empty: none). ValueError: the file
    is damaged, or a point has two places; names the line.
    """
    lines = read_small(path).splitlines()
    head = next((line for line in lines if line.strip()), "")
    separator = next((s for s in (",", ";", "\t") if s in head), None)
    columns = [word.strip().lower() for word in head.split(separator)] if separator else []
    columns = [_SAME.get(column, column) for column in columns]
    if not set(_COLUMNS) <= set(columns):
        if separator is not None and not utm_of_text(head):
            lost = ", ".join(sorted(set(_COLUMNS) - set(columns)))
            raise ValueError(f"{path}: line 1: the columns {lost} are missing; expected {','.join(_COLUMNS)}")
        return _gcp_list(path, lines)
    points: dict[str, ControlPoint] = {}
    begin = lines.index(head) + 1
    for place, row in enumerate(csv.reader(lines[begin:], delimiter=separator or ","), start=begin + 1):
        if not any(cell.strip() for cell in row):
            continue
        with located(f"{path}: line {place}"):
            if len(row) < len(columns):
                raise ValueError(f"{len(row)} values in {len(columns)} columns")
            cells = dict(zip(columns, (cell.strip() for cell in row), strict=False))
            if separator == ";":  # where a comma is the decimal mark
                cells |= {key: cells[key].replace(",", ".") for key in _NUMBERS}
            _add(points, cells)
    return list(points.values()), ""


def _gcp_list(path: Path, lines: Sequence[str]) -> tuple[list[ControlPoint], str]:
    """Read OpenDroneMap's list: the reference system, then `E N h x y image [name]`."""
    crs = lines[0].strip() if lines else ""
    points: dict[str, ControlPoint] = {}
    for place, line in enumerate(lines[1:], start=2):
        line = line.strip()
        # Names may have blanks where tabs separate, as in lists of WebODM.
        words = re.split(r"\s*\t\s*", line) if line.count("\t") >= len(_NUMBERS) else line.split()
        if not words or words[0].startswith("#"):
            continue
        with located(f"{path}: line {place}"):
            if len(words) < 6:
                raise ValueError(f"expected E, N, h, x, y and an image, got {line!r:.60}")
            words += [" ".join(words[:3])]  # of a point without a name
            _add(points, dict(zip((*_NUMBERS, "image", "name"), words, strict=False)))
    if not points:
        raise ValueError(f"{path}: no points: expected the columns {','.join(_COLUMNS)}, or a gcp_list.txt")
    return list(points.values()), utm_of_text(crs) or crs


def _add(points: dict[str, ControlPoint], cells: Mapping[str, str]) -> None:
    e, n, h, x, y = (number(cells, key) for key in _NUMBERS)
    name, image = cells["name"], cells["image"]
    if not name or not image:
        raise ValueError("a name or an image is missing")
    point = points.setdefault(name, ControlPoint(name, np.array([e, n, h])))
    if not np.array_equal(point.world, [e, n, h]):
        raise ValueError(f"{name} has another place on a line above: correct one of them")
    point.marks.append((image, x, y))


def place(points: Sequence[ControlPoint], cameras: Sequence[Camera], origin: Float64) -> list[ControlPoint]:
    """Return points with their places in the capture, by the rays through their marks in the photographs.

    The cameras are those of a capture that was loaded without downscaling, `origin` is its `Capture.offset`.
    """
    names = {any_case(mark[0]) for point in points for mark in point.marks}
    by_name, found = _cameras_of(names, cameras), []
    for point in points:
        marks = [(by_name.get(any_case(mark[0])), *mark) for mark in point.marks]
        placed = replace(point, seen=[(camera, x, y) for camera, _, x, y in marks if camera is not None])
        found.append(placed)
        if len({camera.name for camera, _, _ in placed.seen}) < 2:
            lost = [image for camera, image, _, _ in marks if camera is None]
            placed.problem = "marked in fewer than 2 views"
            if lost:
                placed.problem += f" ({lost[0]} is none, or several that only their folders tell apart)"
            continue
        try:
            rays = [normalised(camera.rectification.lens, x, y) for camera, x, y in placed.seen]
            placed.position = _intersect([camera for camera, _, _ in placed.seen], np.array(rays)) + origin
        except ValueError as error:
            placed.problem = str(error)
    return found


def _cameras_of(names: Iterable[str], cameras: Sequence[Camera]) -> dict[str, Camera]:
    """Return the cameras of names of photographs, which may lack folders, or have those of another machine.

    Of several photographs of one name, in folders of several flights, the folders decide; so they do of
    several names that only one photograph fits. Names are as of `any_case`.
    """
    known = by_parts(camera.name for camera in cameras)
    folders = [any_case(camera.name).split("/")[-2::-1] for camera in cameras]
    fitting: dict[int, dict[str, int]] = defaultdict(dict)
    for name in names:
        last, *own = name.split("/")[::-1]
        same = {index: len(os.path.commonprefix([own, folders[index]])) for index in known.get(last, [])}
        for index in _best(same):
            fitting[index][name] = same[index]
    return {name: cameras[index] for index, some in fitting.items() for name in _best(some)}


def _best(scores: Mapping[T, int]) -> list[T]:
    """Return the key of the largest number; none if there are several."""
    most = [key for key, score in scores.items() if score == max(scores.values())]
    return most if len(most) == 1 else []


def normalised(lens: Lens, x: float, y: float) -> Float64:
    """Return the normalised coordinates (u, v) that a lens maps to a pixel, by Newton's method.

    ValueError: the pixel is outside the photograph, or outside what the lens maps.
    """
    if not (0 <= x <= lens.width and 0 <= y <= lens.height):
        raise ValueError(f"the mark {x:g}, {y:g} is outside a photograph of {lens.width} x {lens.height}")
    fx, fy, cx, cy = lens.intrinsics
    at, step = np.array([(x - cx) / fx, (y - cy) / fy]), 1e-6
    for _ in range(50):
        around = at[:, None] + step * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])
        pixels = np.stack(lens.project(around[0], around[1]))
        error = pixels[:, 0] - [x, y]
        if np.abs(error).max() < 1e-10 * max(lens.width, lens.height):
            break
        jacobian = np.stack([pixels[:, 1] - pixels[:, 2], pixels[:, 3] - pixels[:, 4]], axis=1) / (2 * step)
        if not np.isfinite(jacobian).all() or abs(np.linalg.det(jacobian)) < 1e-9:
            break
        at = at - np.linalg.solve(jacobian, error)
    if np.abs(error).max() < 1e-6 and not is_folded(lens, *at.tolist()):
        return at
    raise ValueError(f"the mark {x:g}, {y:g} is outside what its lens of {lens.width} x {lens.height} maps")


def _intersect(cameras: Sequence[Camera], rays: Float64) -> Float64:
    """Return the point [3] in the re-centred world that is nearest to rays, by the distances in the images.

    The rays are [M, 2], normalised coordinates.
    """
    poses = np.stack([camera.world_to_camera for camera in cameras])
    focal = np.array([camera.rectification.lens.intrinsics[0] for camera in cameras])
    centres = camera_centres(poses)
    directions = np.einsum(
        "mji,mj->mi", poses[:, :3, :3], np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = np.clip(directions @ directions.T, -1, 1)
    angle = math.degrees(math.acos(float(cosines.min())))
    if angle < _LEAST_ANGLE:
        raise ValueError(
            f"its rays differ by {angle:.2g} degrees only: mark it in views that are farther apart"
        )
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    at = np.linalg.solve(across.sum(axis=0), np.einsum("mij,mj->i", across, centres))
    for _ in range(10):  # Gauss-Newton on the distances in the images
        local = np.einsum("mij,j->mi", poses[:, :3, :3], at) + poses[:, :3, 3]
        if local[:, 2].min() <= 0:
            raise ValueError("it lies behind a camera: a mark is in the wrong photograph")
        projected = local[:, :2] / local[:, 2:]
        slope = (poses[:, :2, :3] - projected[:, :, None] * poses[:, 2:3, :3]) / local[:, 2:, None]
        weighted = slope * focal[:, None, None]
        error = (projected - rays) * focal[:, None]
        change = np.linalg.lstsq(weighted.reshape(-1, 3), error.ravel(), rcond=None)[0]
        at = at - change
        if np.linalg.norm(change) <= 1e-15 * np.linalg.norm(at):
            break
    return np.asarray(at)


def align(points: Sequence[ControlPoint], origin: Float64, crs: str, source: str) -> WorldFrame:
    """Fit the similarity to the points that agree, and write residuals into all that were found.

    Of five points or more, those that contradict the others are left out (least median of squares over
    triples: P. J. Rousseeuw, JASA 1984); their `problem` says so. ValueError: fewer than three points can be
    used, or they lie on a line.
    """
    used = [point for point in points if point.position is not None]
    if len(used) < 3:
        reasons = "; ".join(f"{p.name}: {p.problem}" for p in points if p.problem)
        raise ValueError(
            f"{len(used)} of {len(points)} control points can be used, and 3 are needed"
            + f" ({reasons})" * bool(reasons)
        )
    capture = np.stack([p.position for p in used if p.position is not None])
    world = np.stack([p.world for p in used])
    kept = _consensus(capture, world)
    frame = fit_similarity(capture[kept], world[kept], crs, source)
    for point, position, good in zip(used, capture, kept, strict=True):
        point.offset = frame.to_world(position) - point.world
        point.problem = "" if good else "contradicts the others and is left out"
        surveyed = frame.from_world(point.world) - origin
        point.reprojection = _reprojection(point, surveyed)
    return frame


def _consensus(capture: Float64, world: Float64) -> np.ndarray:
    """Return which points [N] agree with each other."""
    n = len(capture)
    every = np.ones(n, dtype=bool)
    if n < 5:  # four points cannot outvote one of them
        return every
    triples = np.array(list(itertools.islice(itertools.combinations(range(n), 3), 200_000)))
    triples = triples[np.random.default_rng(0).permutation(len(triples))[:_TRIPLES]]
    best, distances = math.inf, np.zeros(n)
    for triple in triples:
        try:
            frame = fit_similarity(capture[triple], world[triple])
        except ValueError:
            continue
        found = np.linalg.norm(frame.to_world(capture) - world, axis=1)
        middle = float(np.partition(found, n // 2 + 1)[n // 2 + 1])
        if middle < best:
            best, distances = middle, found
    if not math.isfinite(best):  # all triples lie on lines, which the fit refuses
        return every
    limit = 2.5 * 1.4826 * (1 + 5 / (n - 3)) * best
    return np.asarray(distances <= max(limit, 1e-9 * float(np.ptp(world, axis=0).max())))


def _reprojection(point: ControlPoint, position: Float64) -> float:
    """Return the root mean square distance of a position [3], re-centred, from a point's marks, in pixels."""
    squares = []
    for camera, column, row in point.seen:
        x, y, z = camera.world_to_camera[:3, :3] @ position + camera.world_to_camera[:3, 3]
        if z <= 0:
            return math.inf
        u, v = camera.rectification.lens.project(np.array([x / z]), np.array([y / z]))
        squares.append((u[0] - column) ** 2 + (v[0] - row) ** 2)
    return math.sqrt(float(np.mean(squares)))
