# SPDX-License-Identifier: Apache-2.0
"""COLMAP sparse models (cameras, images, points3D; binary and text) as columns of numpy arrays.

Poses map world to camera: x_camera = R(q) x_world + t with q = (w, x, y, z); pixel (i, j) has its centre at
(i + 0.5, j + 0.5). Compiled readers parse the files; they check every count against the bytes left.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.formats import native

Float64 = npt.NDArray[np.float64]
FILES = ("cameras", "images", "points3D")
_SUFFIXES = (".bin", ".txt")
# Files that may be in the place of a model's points.
POINT_SUFFIXES = (".ply", ".las", ".laz", ".e57")


def _empty(dtype: str, *shape: int) -> Any:
    return field(default_factory=lambda: np.zeros(shape, dtype=dtype))


@dataclass
class ColmapCamera:
    """One camera: `model` is COLMAP's name ("PINHOLE", "OPENCV", ...), `params` in COLMAP's order."""

    id: int
    model: str
    width: int
    height: int
    params: Float64


@dataclass
class ColmapImages:
    """N registered images. Observations of image i are rows point2d_offsets[i] to point2d_offsets[i + 1]."""

    ids: npt.NDArray[np.uint32] = _empty("u4", 0)
    camera_ids: npt.NDArray[np.uint32] = _empty("u4", 0)
    quats: Float64 = _empty("f8", 0, 4)  # [N, 4] w, x, y, z
    translations: Float64 = _empty("f8", 0, 3)  # [N, 3]
    names: list[str] = field(default_factory=list)
    # [N + 1]; all zero when the observations were not read.
    point2d_offsets: npt.NDArray[np.uint64] = _empty("u8", 1)
    points2d: Float64 = _empty("f8", 0, 2)  # [O, 2] pixels
    point3d_ids: npt.NDArray[np.int64] = _empty("i8", 0)  # [O]; -1 where the observation has no point


@dataclass
class ColmapPoints:
    """M points. The track of point i is rows track_offsets[i] to track_offsets[i + 1]."""

    ids: npt.NDArray[np.int64] = _empty("i8", 0)
    positions: Float64 = _empty("f8", 0, 3)  # [M, 3] world
    colors: npt.NDArray[np.uint8] = _empty("u1", 0, 3)  # [M, 3]
    errors: Float64 = _empty("f8", 0)  # [M] mean reprojection error in pixels; -1 = unknown
    # [M + 1]; right even when the tracks themselves were not read.
    track_offsets: npt.NDArray[np.uint64] = _empty("u8", 1)
    track_image_ids: npt.NDArray[np.uint32] = _empty("u4", 0)
    track_point2d_ids: npt.NDArray[np.uint32] = _empty("u4", 0)

    @property
    def track_lengths(self) -> npt.NDArray[np.int64]:
        """The number of images that see each point, int64 [M]."""
        ends = self.track_offsets.astype(np.int64)
        return np.asarray(ends[1:] - ends[:-1])


@dataclass
class ColmapModel:
    """A sparse model."""

    cameras: list[ColmapCamera] = field(default_factory=list)
    images: ColmapImages = field(default_factory=ColmapImages)
    points: ColmapPoints = field(default_factory=ColmapPoints)
    # The file of the points. With a suffix of `POINT_SUFFIXES`, `points` is empty: the caller reads it.
    points_path: Path | None = None


@cache
def camera_models() -> dict[str, list[str]]:
    """Return the names of the parameters, in order, of every camera model of COLMAP."""
    return {name: params.split(",") for _, name, params in native.camera_models()}


def find_models(path: Path) -> list[tuple[Path, int]]:
    """Return the sparse models below `path` in one place (sparse/0, sparse, `path`, colmap/...).

    Each is a folder and its number of images. Of several numbered models, which COLMAP makes of parts that it
    could not join, the largest comes first. The number is 0 if there is only one, which nobody compares.
    """
    for folder in ("sparse", ".", "colmap/sparse"):
        numbered = _numbered(path / folder) if folder != "." else []
        if len(numbered) > 1:
            counted = [(model, count_images(model)) for model in numbered]
            return sorted(counted, key=lambda model: -model[1])  # stable: of equal ones, the first
        if numbered or complete_files(path / folder):
            return [(numbered[0] if numbered else path / folder, 0)]
    return []


def find_incomplete_model(path: Path) -> Path | None:
    """Return the folder of a model that lacks files, where `find_models` would look for it, or None."""
    folders = [path / name for name in ("sparse/0", "sparse", ".", "colmap/sparse/0", "colmap/sparse")]
    kinds = ((folder, _files(folder, suffix)) for folder in folders for suffix in _SUFFIXES)
    return next((folder for folder, files in kinds if any(map(Path.is_file, files.values()))), None)


def _numbered(folder: Path) -> list[Path]:
    """Return the complete models in the folders 0, 1, ... of a folder, in the order of their numbers."""
    found = [model for model in folder.glob("[0-9]*") if model.name.isdecimal() and complete_files(model)]
    return sorted(found, key=lambda model: int(model.name))


def complete_files(folder: Path) -> dict[str, Path] | None:
    """Return the files of a model by their names in `FILES`, binary ones first; None: one is missing."""
    kinds = (_files(folder, suffix) for suffix in _SUFFIXES)
    return next((files for files in kinds if all(map(Path.is_file, files.values()))), None)


def _files(folder: Path, suffix: str) -> dict[str, Path]:
    """Return the files of a model by their names; its points may be in a file of another program alone."""
    files = {name: folder / f"{name}{suffix}" for name in FILES}
    points = [folder / f"points3D{other}" for other in (*_SUFFIXES, *POINT_SUFFIXES)]
    found = next((path for path in points if path.is_file()), None)
    return files if found is None or found.suffix in _SUFFIXES else {**files, "points3D": found}


def count_images(folder: Path) -> int:
    """Return the number of images of a model; 0 if its file is damaged, so that an undamaged one is used."""
    files = complete_files(folder)
    try:
        return len(native.read_images(os.fsencode(files["images"]), False)[0]) if files else 0
    except ValueError:
        return 0


def read_model(folder: Path | str, *, points2d: bool = False, tracks: bool = False) -> ColmapModel:
    """Read a sparse model of .bin or .txt files; binary files are preferred where both kinds are complete.

    Observations of images (`points2d`, most of the file's size) and tracks are read if asked for; the tracks'
    lengths always are. FileNotFoundError: a file is missing. ValueError: a file is damaged; names the file,
    the byte offset or line, and the reason.
    """
    folder = Path(folder)
    paths = complete_files(folder)
    if paths is None:
        suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
        lost = next(path for path in _files(folder, suffix).values() if not path.is_file())
        instead = "" if lost.stem != "points3D" else f"; points of another program can be in {lost.stem}.ply"
        raise FileNotFoundError(f"{lost} is missing: {folder} is not a complete COLMAP sparse model{instead}")
    cameras = [ColmapCamera(*row) for row in native.read_cameras(os.fsencode(paths["cameras"]))]
    images, points = native.read_images(os.fsencode(paths["images"]), points2d), ColmapPoints()
    if paths["points3D"].suffix not in POINT_SUFFIXES:
        points = ColmapPoints(*native.read_points(os.fsencode(paths["points3D"]), tracks))
    return ColmapModel(cameras, ColmapImages(*images), points, paths["points3D"])


def write_model(folder: Path | str, model: ColmapModel) -> None:
    """Write a sparse model as .bin files, creating the folder.

    ValueError: a camera's parameters do not fit its model, a name cannot stand in the file, or columns have
    different lengths. Nothing is written then.
    """
    for camera in model.cameras:
        if len(camera.params) != len(camera_models()[camera.model]):
            raise ValueError(f"camera {camera.id}: {len(camera.params)} parameters do not fit {camera.model}")
    for name in model.images.names:
        if not name or "\0" in name or "\n" in name:
            raise ValueError(f"images: the name {name!r} is empty or has a NUL or line break in it")
    try:
        contents = list(_bytes_of(model))
    except ValueError as error:
        raise ValueError(f"columns of the model have different lengths: {error}") from error
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, content in zip(FILES, contents, strict=True):
        Path(folder, f"{name}.bin").write_bytes(content)


def _bytes_of(model: ColmapModel) -> Iterator[bytes]:
    ids = {name: number for number, name, _ in native.camera_models()}
    cameras = (
        struct.pack(f"<IiQQ{len(c.params)}d", c.id, ids[c.model], c.width, c.height, *c.params)
        for c in model.cameras
    )
    yield struct.pack("<Q", len(model.cameras)) + b"".join(cameras)
    images, points = model.images, model.points
    poses = zip(images.ids, images.quats, images.translations, images.camera_ids, images.names, strict=True)
    heads = [struct.pack("<I7dI", i, *q, *t, c) + os.fsencode(name) + b"\0" for i, q, t, c, name in poses]
    observations = np.empty(len(images.points2d), [("xy", "<f8", 2), ("id", "<i8")])
    observations["xy"], observations["id"] = images.points2d, images.point3d_ids
    yield _joined(heads, images.point2d_offsets, observations)
    table = np.empty(len(points.ids), [("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
    table["id"], table["xyz"], table["rgb"] = points.ids, points.positions, points.colors
    table["error"] = points.errors
    tracks = np.empty(len(points.track_image_ids), [("image", "<u4"), ("point2d", "<u4")])
    tracks["image"], tracks["point2d"] = points.track_image_ids, points.track_point2d_ids
    yield _joined([row.tobytes() for row in table], points.track_offsets, tracks)


def _joined(heads: list[bytes], offsets: npt.NDArray[np.uint64], rows: npt.NDArray[np.void]) -> bytes:
    """Return the number of records, and for each its head, the number of its rows, and these."""
    if len(rows) != offsets[-1]:
        raise ValueError(f"{offsets[-1]} rows of tracks or observations, got {len(rows)}: read them too")
    parts, data, size = [struct.pack("<Q", len(heads))], rows.tobytes(), rows.itemsize
    for head, (begin, end) in zip(heads, pairwise(offsets.tolist()), strict=True):
        parts += [head, struct.pack("<Q", end - begin), data[begin * size : end * size]]
    return b"".join(parts)


def world_to_camera(images: ColmapImages) -> Float64:
    """Return the poses as matrices [N, 4, 4]; a quaternion of zeros gives NaN."""
    import torch

    from blitzgs.util.rotations import quaternion_matrices

    with np.errstate(invalid="ignore", divide="ignore"):
        unit = images.quats / np.linalg.norm(images.quats, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(unit), 1, 1))
    poses[:, :3, :3] = quaternion_matrices(torch.from_numpy(unit)).numpy()
    poses[:, :3, 3] = images.translations
    return poses
