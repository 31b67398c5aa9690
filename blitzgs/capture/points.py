# SPDX-License-Identifier: Apache-2.0
"""The points of a capture: those that its files name, or those beside them, as PLY, LAS, LAZ or E57."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.capture import colmap
from blitzgs.capture.cameras import Float64, camera_centres
from blitzgs.capture.names import any_case
from blitzgs.capture.transforms import Transforms
from blitzgs.formats.ply import read_point_cloud
from blitzgs.util.errors import optional_package, warn

SUFFIXES = (".las", ".laz", ".e57")
# A start needs no more: denser clouds are thinned evenly while they are read.
_MOST = 10_000_000
_CHUNK = 2_000_000
_GREY = 128


def _step(path: Path, count: int) -> int:
    """Return of how many points one is kept, and say it."""
    step = max(1, -(-count // _MOST))
    if step > 1:
        warn(f"{path}: every {step}th of {count:,} points is used")
    return step


def _check_las(path: Path) -> None:
    """Refuse a LAS or LAZ file that cannot hold what its header counts (ValueError).

    The packages take memory and time for what is counted: a lost byte could end the process. Numbers are at
    the places of LAS 1.4; the table of chunks is that of LAZ.
    """
    size = path.stat().st_size
    with path.open("rb") as file:

        def number(at: int, count: int) -> int:
            file.seek(at)
            return int.from_bytes(file.read(count), "little")

        has_more, is_packed = number(25, 1) >= 4, number(104, 1) & 0xC0 != 0
        begin, row = number(96, 4), number(105, 2)
        count = number(247, 8) if has_more else number(107, 4)
        needs = [begin, number(94, 2) + 54 * number(100, 4)]
        if has_more:
            needs.append(60 * number(243, 4))
        if is_packed:
            table = number(begin, 8)
            table = number(size - 8, 8) if table == 2**64 - 1 else table
            needs += [table + 8, row * number(min(table, size) + 4, 4)]  # a chunk begins with a whole point
        else:
            needs.append(begin + row * count)
        if max(needs) > size:
            raise ValueError(f"its header counts {max(needs):,} bytes, and it has {size:,}")


def _read_las(path: Path) -> SourcePoints:
    laspy = optional_package("laspy", "geo", f"{path}: reading it")
    _check_las(path)
    with laspy.open(path) as reader:
        header = reader.header
        step, begin = _step(path, header.point_count), 0
        has_color = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
        positions, colors = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.uint16)]
        for chunk in reader.chunk_iterator(_CHUNK):
            kept = slice(-begin % step, None, step)
            begin += len(chunk)
            # Integers times scale plus offset, in float64.
            positions.append(np.stack([np.asarray(chunk[axis])[kept] for axis in "xyz"], axis=1))
            if has_color:
                rgb = [np.asarray(chunk[name])[kept] for name in ("red", "green", "blue")]
                colors.append(np.stack(rgb, axis=1))
        try:
            crs = header.parse_crs()
        except Exception as error:  # pyproj is not installed, or does not know the system
            warn(f"the reference system of the points is not read ({error})")
            crs = None
    found = np.concatenate(colors)
    if not has_color or not found.any():
        return SourcePoints.grey(np.concatenate(positions), crs)
    # The format has 16 bits, but some programs write bytes.
    uint8 = (found >> (8 if found.max() > 255 else 0)).astype(np.uint8)
    return SourcePoints(np.concatenate(positions), uint8, colors_from="red, green, blue", crs=crs)


def _read_e57(path: Path) -> SourcePoints:
    pye57 = optional_package("pye57", "geo", f"{path}: reading it")
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
            none = np.full(len(xyz), np.nan)
            rgb = [scan[f"color{c}"][::step] if with_color else none for c in ("Red", "Green", "Blue")]
            colors.append(np.stack(rgb, axis=1).astype(np.float64))
    finally:
        file.close()
    found = np.concatenate(colors)
    if not len(found) or np.isnan(found).all():
        return SourcePoints.grey(np.concatenate(positions))
    white = 255.0 if np.nanmax(found) > 1 else 1.0
    white = 65535.0 if np.nanmax(found) > 255 else white
    scaled = np.where(np.isnan(found), _GREY, found * (255 / white))
    uint8 = np.clip(scaled + 0.5, 0, 255).astype(np.uint8)
    return SourcePoints(np.concatenate(positions), uint8, colors_from="red, green, blue")


# Points in the world of transforms.json, by the programs that write them beside it: nerfstudio and INRIA's.
_BESIDE = ("sparse_pc.ply", "points3d.ply")
# Centres of cameras that agree, as a share of the distance between cameras.
_SAME_PLACE = 1e-3


@dataclass(eq=False)
class SourcePoints:
    """The points as the capture's file describes them, in its own world; see `Capture` for the columns."""

    positions: Float64
    colors: npt.NDArray[np.uint8]
    track_lengths: npt.NDArray[np.int64] | None = None
    errors: Float64 | None = None
    path: Path | None = None  # the file or model that has them; None: there are none
    colors_from: str = ""  # what in it gives the colours; empty: nothing
    crs: Any = None  # the reference system that the file names (pyproj's); None: it names none

    def columns(self) -> dict[str, Any]:
        """Return the columns that there are, by name."""
        found = {name: getattr(self, name) for name in ("positions", "colors", "track_lengths", "errors")}
        return {name: column for name, column in found.items() if column is not None}

    @classmethod
    def grey(cls, positions: Float64, crs: Any = None) -> SourcePoints:
        """Return points without colours."""
        return cls(positions, np.full(positions.shape, _GREY, np.uint8), crs=crs)

    @classmethod
    def none(cls) -> SourcePoints:
        """Return no points."""
        return cls.grey(np.zeros((0, 3)))


def model_points(model: colmap.ColmapModel) -> SourcePoints:
    """Return the points of a COLMAP model, which may be in a file of another program."""
    path, points = model.points_path, model.points
    if path is not None and path.suffix in colmap.POINT_SUFFIXES:
        return file_points(path)
    columns = (points.positions, points.colors, points.track_lengths, points.errors)
    return SourcePoints(*columns, path, "the model's own colours")


def file_points(path: Path) -> SourcePoints:
    """Read the points of a PLY, LAS, LAZ or E57 file; warn if they have no colours.

    ImportError: the package that reads the format is not installed. FileNotFoundError: there is no such file.
    ValueError: it is damaged; names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: put the file of points there, or correct its name")
    hint = ""
    if path.suffix.lower() in SUFFIXES:
        try:
            points = _read_e57(path) if path.suffix.lower() == ".e57" else _read_las(path)
        except (ImportError, MemoryError):
            raise
        except Exception as error:  # the packages raise all kinds of errors for damaged files
            reason = str(error).partition("\n")[0]  # the rest is for the package's authors
            raise ValueError(
                f"{path} cannot be read ({reason}): export the points again, or as PLY"
            ) from error
    else:
        cloud = read_point_cloud(path)
        points = SourcePoints(cloud.positions, cloud.colors, colors_from=cloud.colors_from)
        hint = f": the file has {', '.join(cloud.properties)}, and colours are read from red, green and blue"
    points.path = path
    if not points.colors_from and len(points.positions):
        warn(f"{path}: the points have no colours and start grey{hint}")
    return points


def transforms_points(root: Path, content: Transforms, model: Path | None) -> SourcePoints:
    """Return the points that transforms.json names, else those beside it or of `model` in the same world."""
    if content.points_path is not None:
        return file_points(content.points_path)
    plys = sorted(path for path in root.iterdir() if path.suffix.lower() == ".ply" and path.is_file())
    for path in plys:
        if path.name.lower() in _BESIDE:
            return file_points(path)
    if model is not None and (found := _model_points(root, content, model)) is not None:
        return found
    if plys:
        warn(
            f"{content.files[0]} names no points, so {plys[0].name} beside it is not used: if its points are "
            f'in the same world, add "ply_file_path": "{plys[0].name}"'
        )
    return SourcePoints.none()


def _model_points(root: Path, content: Transforms, folder: Path) -> SourcePoints | None:
    """Return the points of a COLMAP model in the world of transforms.json; None if that is not certain."""
    model = colmap.read_model(folder)
    reason = _differs(model, content)
    if reason is not None:
        warn(
            f"{content.files[0]} names no points, and the {len(model.points.ids)} points of "
            f"{folder.relative_to(root)} are not used: {reason}; name a PLY with ply_file_path"
        )
        return None
    points = model_points(model)
    points.positions = content.moved(points.positions)
    return points


def _differs(model: colmap.ColmapModel, content: Transforms) -> str | None:
    """Return why the cameras of a model and of transforms.json are not known to be the same."""
    places = {PurePosixPath(any_case(frame.name)).stem: frame for frame in content.frames}
    stems = [PurePosixPath(any_case(name)).stem for name in model.images.names]
    pairs = [(i, places[stem]) for i, stem in enumerate(stems) if stem in places]
    if len(pairs) < 2 or len(places) < len(content.frames):
        return "its images are called otherwise than the frames, so their worlds cannot be compared"
    ours = camera_centres(np.stack([frame.world_to_camera for _, frame in pairs]))
    theirs = content.moved(camera_centres(colmap.world_to_camera(model.images))[[i for i, _ in pairs]])
    apart = float(np.median(np.linalg.norm(ours - theirs, axis=1)))
    spread = float(np.linalg.norm(ours - ours.mean(axis=0), axis=1).max())
    if not apart <= _SAME_PLACE * spread:  # NaN too
        return f"its cameras are elsewhere, {apart:.3g} apart, so its world is another one"
    return None
