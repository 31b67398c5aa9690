# SPDX-License-Identifier: Apache-2.0
"""Reads cameras from transforms.json: nerfstudio's single file, or Blender's transforms_train/test.json.

Poses in these files are camera-to-world with x right, y up, z backwards. Poses of this package are
world-to-camera with y down, z forwards.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from blitzgs.capture.cameras import Float64, SourceView, nearest_rotation, pose_of
from blitzgs.capture.fields import Fields, entry, read_json
from blitzgs.capture.names import find_files
from blitzgs.capture.transforms_lens import FIELDS, read_lens
from blitzgs.util.errors import located

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
_PARTS = ("train", "val", "test")
# Fields that are read, or that have no meaning for a view; all others are named in `Transforms.notes`.
_KNOWN = FIELDS | {
    "frames", "file_path", "mask_path", "transform_matrix", "ply_file_path", "train_filenames",
    "val_filenames", "test_filenames", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2",
    # Of nerfstudio, instant-ngp and Blender, for their own programs.
    "aabb_scale", "scale", "offset", "from_na", "applied_transform", "applied_scale", "orientation_override",
    "sharpness", "colmap_im_id", "colmap_image_id", "depth_file_path", "rotation", "time", "n_frames",
}  # fmt: skip


@dataclass
class Transforms:
    """The combined content of a capture's files."""

    files: list[Path]
    frames: list[SourceView] = field(default_factory=list)
    points_path: Path | None = None
    split: list[str] = field(
        default_factory=list
    )  # what in the files decides on the split, if something does
    # What was decided between fields, and which fields have no effect, as keys.
    notes: dict[str, None] = field(default_factory=dict)
    applied: Float64 | None = None  # [3, 4] what nerfstudio applied to COLMAP's world, where it says so

    def moved(self, positions: Float64) -> Float64:
        """Return positions [N, 3] of COLMAP's world in that of the frames."""
        if self.applied is None:
            return positions
        return np.asarray(positions @ self.applied[:, :3].T + self.applied[:, 3])


def find_transforms(root: Path) -> list[Path]:
    """Return the files to read: transforms.json, else those of Blender's split into parts, if any."""
    if (root / "transforms.json").is_file():
        return [root / "transforms.json"]
    files = [root / f"transforms_{part}.json" for part in _PARTS]
    return [path for path in files if path.is_file()]


def read_transforms(root: Path, files: Sequence[Path] | None = None) -> Transforms:
    """Read every frame of a capture, or of the given files, whose images are relative to `root`.

    ValueError: a field is missing or makes no sense; names the file, the frame and the field.
    """
    read = Transforms(find_transforms(root) if files is None else list(files))
    ignored: dict[str, None] = {}
    for path in read.files:
        with located(str(path)):
            ignored |= _read_file(root, path, read)
    if ignored:
        shown = ", ".join(f"{key:.40}" for key in list(ignored)[:8]) + (", ..." if len(ignored) > 8 else "")
        read.notes[f"fields without effect: {shown}"] = None
    counts = Counter(frame.path for frame in read.frames)
    if twice := sorted({frame.name for frame in read.frames if counts[frame.path] > 1}):
        shown = ", ".join(twice[:5]) + (", ..." if len(twice) > 5 else "")
        where = " and ".join(map(str, read.files))
        raise ValueError(f"{where}: images of more than one frame: {shown}; keep one frame of each")
    return read


def _read_file(root: Path, path: Path, read: Transforms) -> dict[str, None]:
    """Add the content of a file; return the fields that have no effect."""
    with located("not a transforms file"):
        content = read_json(path)
        frames = entry(content, "frames", list)
    if "ply_file_path" in content:
        points = _file_name(content, "ply_file_path")
        read.points_path = _found(root, [points])[points]
    read.applied = _applied(content) if read.applied is None else read.applied
    is_whole = path.name == "transforms.json"
    lists = _lists(content) if is_whole else {}
    read.split += [f"{part}_filenames" for part in lists] if is_whole else [path.name]
    fields = [frame for frame in frames if isinstance(frame, dict)]
    named = [frame.get(key) for key in ("file_path", "mask_path") for frame in fields]
    paths = _found(root, [str(name) for name in named if _is_file_name(name)])
    own = []
    for index, frame in enumerate(frames):
        with located(f"frame {index}"):
            view = _read_frame(content, frame, paths, read.notes)
        part = "train" if path.name == "transforms_train.json" else "test"
        own.append(replace(view, part=_part(lists, view.name) if is_whole else part))
    if lost := set().union(*lists.values()) - {frame.name for frame in own}:
        keys = " or ".join(f"{part}_filenames" for part in lists)
        raise ValueError(f"{keys} name {len(lost)} images that are no frames (first: {min(lost)})")
    read.frames += own
    return dict.fromkeys(key for level in (*frames, content) for key in level if key not in _KNOWN)


def _read_frame(content: Fields, frame: Any, paths: Mapping[str, Path], notes: dict[str, None]) -> SourceView:
    if not isinstance(frame, dict):
        raise ValueError(f"must be an object with file_path and transform_matrix, got {frame!r:.40}")
    relative = _file_name(frame, "file_path")
    mask = None if frame.get("mask_path") is None else paths[_file_name(frame, "mask_path")]
    lens = read_lens(content, frame, paths[relative], notes)
    pose = _read_pose(entry(frame, "transform_matrix", list))
    return SourceView(_name(relative), paths[relative], mask, lens, pose)


def _applied(content: Fields) -> Float64 | None:
    """Return nerfstudio's applied_transform and applied_scale as one matrix; None: there is neither."""
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    try:
        matrix = np.asarray(content.get("applied_transform", np.eye(4)), dtype=np.float64)[:3]
        scale = float(content.get("applied_scale", 1.0))
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise ValueError("applied_transform must be 3 x 4 and applied_scale a number") from error
    if matrix.shape != (3, 4):
        raise ValueError(f"applied_transform must be 3 x 4, got the shape {matrix.shape}")
    return matrix * scale


def _is_file_name(value: object) -> bool:
    return isinstance(value, str) and bool(PurePath(value).name)


def _file_name(fields: Fields, key: str) -> str:
    if not _is_file_name(fields.get(key)):
        raise ValueError(f"{key} must name a file, got {fields.get(key)!r:.40}")
    return str(fields[key])


def _found(root: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the file of each name; a name may lack its suffix, as Blender's do."""
    return find_files(names, lambda name: (root / (_name(name) + suffix) for suffix in _SUFFIXES), root)


def _lists(content: Fields) -> dict[str, set[str]]:
    """Return the names in the lists of a file's split, as far as it has them."""
    lists = {}
    for part in _PARTS:
        key = f"{part}_filenames"
        if key not in content:
            continue
        names = content[key]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{key} must be a list of the file_path of frames")
        lists[part] = {_name(name) for name in names}
    return lists


def _part(lists: Mapping[str, set[str]], name: str) -> str | None:
    """Return the part of a frame by the lists of its file, see `SourceView.part`."""
    if not lists:
        return None
    held_out = any(name in lists.get(part, ()) for part in ("val", "test"))
    if "train" not in lists:
        return "test" if held_out else "train"
    if name in lists["train"]:
        return "both" if held_out else "train"
    return "test" if held_out else "unused"


def _name(relative: str) -> str:
    """Return the name of a view, with slashes, whatever system wrote it."""
    return str(Path(relative.replace("\\", "/")))


def _read_pose(matrix: object) -> Float64:
    try:
        camera_to_world = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError("transform_matrix must be 4 x 4 numbers") from error
    if camera_to_world.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix must be 4 x 4, got the shape {camera_to_world.shape}")
    rotation = camera_to_world[:3, :3] * np.array([1.0, -1.0, -1.0])
    if np.isfinite(camera_to_world).all():  # views whose pose is not finite are dropped later
        lengths = np.linalg.norm(rotation, axis=0)
        if lengths.max() == 0:
            raise ValueError("transform_matrix has a rotation of zeros only: leave out frames without a pose")
        last = camera_to_world[3:].ravel()
        if last.size and not np.allclose(last, [0, 0, 0, 1], atol=1e-6):
            raise ValueError(f"the last row of transform_matrix must be 0, 0, 0, 1, got {last.tolist()}")
        # Some exporters do not remove the scale of the rig, which is the same along all axes.
        if lengths.min() < 0.999 * lengths.max():
            raise ValueError(
                "transform_matrix is not a rotation and a translation: its axes have the lengths "
                f"{', '.join(f'{length:.6g}' for length in lengths)}"
            )
        rotation = rotation / lengths
        if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3):
            raise ValueError("transform_matrix is not a rotation and a translation")
        if np.linalg.det(rotation) < 0:
            raise ValueError("transform_matrix mirrors the scene: one of its axes has the wrong sign")
    return pose_of(nearest_rotation(rotation), camera_to_world[:3, 3])
