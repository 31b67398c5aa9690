# SPDX-License-Identifier: Apache-2.0
"""Stores a run's cameras in its folder, so that rendering needs no capture, and photographs' exposures."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import MAX_SIDE, Float64
from blitzgs.capture.capture import Capture
from blitzgs.runs.checkpoint_files import DAMAGE
from blitzgs.runs.run_files import CAMERAS
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file
from blitzgs.view.views import CameraLike

_VERSION = 1
# Bytes that are read at the beginning, middle and end of a photograph to recognise it; names in a warning.
_PIECE, _NAMED, _THREADS = 4096, 4, 16


@dataclass(frozen=True, eq=False)
class RunCamera:
    """A pinhole camera with the fields of `blitzgs.capture.cameras.Camera` that rendering reads.

    Sizes are in pixels, and so is K, float64 [3, 3]: pixel (i, j) has its centre at (i + 0.5, j + 0.5). The
    pose, float64 [4, 4], is rigid, in the re-centred world (capture position - the run's offset).
    """

    name: str
    width: int
    height: int
    K: npt.NDArray[np.float64]
    world_to_camera: npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class RunCameras:
    """All cameras of a run."""

    cameras: Sequence[CameraLike]  # in the order of the capture
    train: list[int]  # indices of the training cameras
    test: list[int]  # indices of the held-out cameras
    inputs: list[Path]  # paths of the photographs and masks during training

    def __repr__(self) -> str:
        parts = f"{len(self.train):,} train, {len(self.test):,} test"
        return f"RunCameras({len(self.cameras):,} cameras: {parts})"


def checked_camera(
    name: str, width: int, height: int, K: npt.ArrayLike, world_to_camera: npt.ArrayLike
) -> RunCamera:
    """Return a camera with these values, in arrays of its own.

    A size or matrix that is none is a TypeError, an impossible value a ValueError; the message names it.
    """
    for argument, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, (int, float, np.integer, np.floating)):
            raise TypeError(f"{argument} must be an integer, got {size!r} ({type(size).__name__})")
    intrinsics, pose = _matrix("K", K), _matrix("world_to_camera", world_to_camera)
    for argument, matrix, shape in (("K", intrinsics, (3, 3)), ("world_to_camera", pose, (4, 4))):
        if matrix.shape != shape:
            raise ValueError(f"{argument} must be a finite matrix {shape}, got {matrix.tolist()}")
    _check(np.array([[width, height]], dtype=np.float64), intrinsics[None], pose[None])
    return RunCamera(name, int(width), int(height), intrinsics, pose)


def _check(sizes: Float64, Ks: Float64, poses: Float64) -> None:  # noqa: N803
    rotations = poses[:, :3, :3]
    with np.errstate(invalid="ignore"):
        turned = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) < 1e-3
        turned &= np.linalg.det(rotations) > 0
    whole = (sizes >= 1) & (sizes <= MAX_SIDE) & (sizes == np.floor(sizes))
    for right, values, text in (
        (np.isfinite(Ks).all((1, 2)), Ks, "K must be a finite matrix (3, 3)"),
        (np.isfinite(poses).all((1, 2)), poses, "world_to_camera must be a finite matrix (4, 4)"),
        (np.minimum(Ks[:, 0, 0], Ks[:, 1, 1]) > 0, Ks, "K must have positive focal lengths"),
        (
            _near(Ks[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]),
            Ks,
            "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (a skew has no effect; divide K by K[2, 2])",
        ),
        (turned, rotations, "world_to_camera[:3, :3] must be a rotation"),
        (_near(poses[:, 3], [0, 0, 0, 1]), poses[:, 3], "the last row of world_to_camera must be 0, 0, 0, 1"),
        (whole[:, 0], sizes[:, 0], f"width must be an integer from 1 to {MAX_SIDE:,}"),
        (whole[:, 1], sizes[:, 1], f"height must be an integer from 1 to {MAX_SIDE:,}"),
    ):
        if not right.all():
            raise ValueError(f"{text}, got {values[int(right.argmin())].tolist()}")


def _near(rows: Float64, expected: list[int]) -> npt.NDArray[np.bool_]:
    """Tell which rows are what is expected, up to the rounding of float32."""
    return np.asarray(np.isclose(rows, expected, rtol=1e-5, atol=1e-9).all(1))


def _matrix(argument: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        kind = type(value).__name__
        raise TypeError(f"{argument} must be a matrix of numbers, got {kind} ({error})") from error


def save_cameras(folder: Path, capture: Capture, run_id: str = "") -> None:
    """Write the cameras of a capture into the folder of a run; `run_id` tells its checkpoints from others."""
    stamps = _stamps(capture)
    views = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "K": np.asarray(camera.K).tolist(),
            "world_to_camera": np.asarray(camera.world_to_camera).tolist(),
            "stamp": stamps[camera.name],
        }
        for camera in capture.cameras
    ]
    content = {
        "version": _VERSION,
        "run": run_id,
        "train": list(capture.train),
        "test": list(capture.test),
        "inputs": [str(path.absolute()) for path in input_files(capture)],
        "cameras": views,
    }
    write_file(folder / CAMERAS, json.dumps(content))


def warn_of_changes(folder: Path, capture: Capture) -> None:
    """Warn if photographs or masks of a capture are others than those that the run in `folder` began with."""
    try:
        views = json.loads((folder / CAMERAS).read_text(encoding="utf-8"))["cameras"]
        before = {view["name"]: view.get("stamp", "") for view in views}
    except DAMAGE:
        return  # an older run, or a damaged file, which is named where it is needed
    now = _stamps(capture)
    changed = [name for name, stamp in before.items() if stamp and now.get(name, "") not in ("", stamp)]
    if changed:
        more = ", ..." if len(changed) > _NAMED else ""
        warn(
            f"{len(changed)} of {len(now)} photographs or their masks have changed since the run in {folder} "
            f"began: {', '.join(changed[:_NAMED])}{more}; unless these replace damaged ones, put "
            "the earlier ones back or start another run"
        )


def _stamps(capture: Capture) -> dict[str, str]:
    """Return by name what tells the photograph and mask of a camera from others; empty: they are not there.

    Size and a checksum of three pieces are the same for a copy, unlike its time, and quick to read.
    """

    def stamp(paths: Sequence[Path]) -> str:
        found = 0
        try:
            for path in paths:
                with path.open("rb") as file:
                    size = file.seek(0, os.SEEK_END)
                    found = zlib.crc32(str(size).encode(), found)
                    for begin in (0, size // 2, max(0, size - _PIECE)):
                        file.seek(begin)
                        found = zlib.crc32(file.read(_PIECE), found)
        except OSError:
            return ""
        return f"{found:08x}"

    files = [[p for p in (c.image_path, c.mask_path) if p is not None] for c in capture.cameras]
    with ThreadPoolExecutor(_THREADS) as pool:  # the files may be on a slow network disk
        return dict(zip((c.name for c in capture.cameras), pool.map(stamp, files), strict=True))


def load_cameras(folder: Path) -> RunCameras:
    """Read a run's cameras (FileNotFoundError: it is older than this file; ValueError: it is damaged)."""
    path = folder / CAMERAS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["version"] != _VERSION:
            raise ValueError(f"version {content['version']}, this program reads {_VERSION}")
        views = content["cameras"]
        sizes, Ks, poses = (  # noqa: N806
            np.array(values, dtype=np.float64).reshape(len(views), *shape)
            for values, shape in (
                ([(view["width"], view["height"]) for view in views], (2,)),
                ([view["K"] for view in views], (3, 3)),
                ([view["world_to_camera"] for view in views], (4, 4)),
            )
        )
        _check(sizes, Ks, poses)
        cameras = [
            RunCamera(str(view["name"]), int(width), int(height), K, pose)
            for view, (width, height), K, pose in zip(views, sizes, Ks, poses, strict=True)
        ]
        train, test = ([int(index) for index in content[part]] for part in ("train", "test"))
        if any(not 0 <= index < len(cameras) for index in (*train, *test)):
            raise ValueError("a view of the split does not exist")
        return RunCameras(cameras, train, test, [Path(text) for text in content["inputs"]])
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise ValueError(f"{path} is damaged ({error}): give the capture with --data DIR instead") from error


def stored_cameras(folder: Path) -> RunCameras:
    """Return a run's cameras; none if it is older than their file (ValueError: it is damaged)."""
    return load_cameras(folder) if (folder / CAMERAS).exists() else RunCameras([], [], [], [])


def input_files(capture: Capture) -> list[Path]:
    """Return the paths of a capture's photographs and masks, which no command may overwrite."""
    images = [camera.image_path for camera in capture.cameras]
    return images + [camera.mask_path for camera in capture.cameras if camera.mask_path is not None]


# Photographs whose gains differ by less than this, as a standard deviation, have the same exposure.
LEAST_SPREAD = 0.02
# Name of the tensor among those of a checkpoint that are the same on all ranks.
SHARED_EXPOSURES = "exposures"


def effective_exposures(measured: Tensor) -> Tensor:
    """Return gain and bias of each training view as they are used, float64 [T, 2, 3], from the measured ones.

    Their means over the views are 1 and 0. Photographs that agree all have 1 and 0. Does not wait.
    """
    mean = measured.mean(0)
    same = torch.zeros_like(mean)
    same[0] = 1
    differs = measured[:, 0].std(0, correction=0).mean() >= LEAST_SPREAD
    return torch.where(differs, measured - mean + same, same)
