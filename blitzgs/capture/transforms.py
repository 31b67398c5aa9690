# SPDX-License-Identifier: Apache-2.0
"""Reads cameras from transforms.json: nerfstudio's single file, or Blender's transforms_train/test.json.

Poses in these files are camera-to-world with x right, y up, z backwards. Poses of this package are
world-to-camera with y down, z forwards.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from blitzgs.capture.cameras import Float64, SourceView
from blitzgs.capture.names import find_files
from blitzgs.capture.transforms_lens import FIELDS, read_lens

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
_PARTS = ("train", "val", "test")
# Fields that are read, or that have no meaning for a view; all others are named in `Transforms.notes`.
_KNOWN = FIELDS | {
    "frames", "file_path", "mask_path", "transform_matrix", "ply_file_path", "train_filenames",
    "val_filenames", "test_filenames", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2",
}  # fmt: skip
# Fields of nerfstudio, instant-ngp and Blender that concern their own programs.
_OF_OTHERS = {
    "aabb_scale", "scale", "offset", "from_na", "applied_transform", "applied_scale", "orientation_override",
    "sharpness", "colmap_im_id", "colmap_image_id", "depth_file_path", "rotation", "time", "n_frames",
}  # fmt: skip


@dataclass(frozen=True)
class Transforms:
    """The combined content of a capture's files."""

    frames: list[SourceView]
    points_path: Path | None
    files: list[Path]
    split: str  # what in the files decides on the split, as text; empty if nothing does
    notes: list[str]  # what was decided between fields, and which fields have no effect
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
    frames: list[SourceView] = []
    points_path, applied = None, None
    files = find_transforms(root) if files is None else list(files)
    notes: dict[str, None] = {}
    ignored: dict[str, None] = {}
    split: list[str] = []
    for path in files:
        content, entries = _read_file(path)
        if "ply_file_path" in content:
            if not _names_file(content, "ply_file_path"):
                raise ValueError(f"{path}: ply_file_path must name a file, got {content['ply_file_path']!r}")
            points_path = _found(root, [content["ply_file_path"]]).popitem()[1]
        applied = _applied(path, content) if applied is None else applied
        lists = _lists(path, content)
        split += [f"{key}_filenames" for key in lists] if path.name == "transforms.json" else [path.name]
        own: list[SourceView] = []
        named = [
            entry[key] for key in ("file_path", "mask_path") for entry in entries if _names_file(entry, key)
        ]
        paths = _found(root, named)
        for index, entry in enumerate(entries):
            try:
                if not isinstance(entry, dict):
                    raise TypeError(
                        f"must be an object with file_path and transform_matrix, got {entry!r:.40}"
                    )
                own.append(_read_frame(path, content, entry, lists, notes, paths))
            except (KeyError, TypeError, ValueError, ArithmeticError) as error:
                reason = f"the field {error} is missing" if isinstance(error, KeyError) else str(error)
                raise ValueError(f"{path}: frame {index}: {reason}") from error
            ignored |= dict.fromkeys(key for key in entry if key not in _KNOWN | _OF_OTHERS)
        ignored |= dict.fromkeys(key for key in content if key not in _KNOWN | _OF_OTHERS)
        if lost := set().union(*lists.values()) - {frame.name for frame in own}:
            keys = " or ".join(f"{part}_filenames" for part in lists)
            raise ValueError(
                f"{path}: {keys} name {len(lost)} images that are no frames (first: {min(lost)})"
            )
        frames += own
    if ignored:
        shown = ", ".join(f"{key:.40}" for key in list(ignored)[:8]) + (", ..." if len(ignored) > 8 else "")
        notes[f"fields without effect: {shown}"] = None
    counts = Counter(frame.path for frame in frames)
    if twice := sorted({frame.name for frame in frames if counts[frame.path] > 1}):
        shown = ", ".join(twice[:5]) + (", ..." if len(twice) > 5 else "")
        raise ValueError(
            f"{' and '.join(map(str, files))}: images of more than one frame: {shown}; keep one frame of each"
        )
    return Transforms(frames, points_path, files, " and ".join(split), list(notes), applied)


def _applied(file: Path, content: Mapping[str, Any]) -> Float64 | None:
    """Return nerfstudio's applied_transform and applied_scale as one matrix; None: there is neither."""
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    try:
        matrix = np.asarray(content.get("applied_transform", np.eye(4)), dtype=np.float64)[:3]
        scale = float(content.get("applied_scale", 1.0))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: applied_transform must be 3 x 4 and applied_scale a number") from error
    if matrix.shape != (3, 4):
        raise ValueError(f"{file}: applied_transform must be 3 x 4, got the shape {matrix.shape}")
    return matrix * scale


def _found(root: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the file of each name; a name may lack its suffix, as Blender's do."""
    return find_files(names, lambda name: (root / (_name(name) + suffix) for suffix in _SUFFIXES), root)


def _read_file(path: Path) -> tuple[dict[str, Any], list[Any]]:
    """Return the root of a file and its frames."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a transforms file: no JSON ({error}); export it again") from error
    if not isinstance(content, dict):
        kind = "null" if content is None else "a list" if isinstance(content, list) else f"{content!r:.40}"
        raise ValueError(f"{path}: not a transforms file with a list of frames: its content is {kind}")
    if not isinstance(content.get("frames"), list):
        what = "there are none" if "frames" not in content else f"they are {content['frames']!r:.40}"
        raise ValueError(f"{path}: not a transforms file with a list of frames: {what}")
    return content, content["frames"]


def _lists(file: Path, content: Mapping[str, Any]) -> dict[str, set[str]]:
    """Return the names in the lists of a file's split, as far as it has them."""
    if file.name != "transforms.json":
        return {}
    lists = {}
    for part in _PARTS:
        key = f"{part}_filenames"
        if key not in content:
            continue
        names = content[key]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of the file_path of frames")
        lists[part] = {_name(name) for name in names}
    return lists


def _part(file: Path, lists: Mapping[str, set[str]], name: str) -> str | None:
    """Return the part of a frame, see `SourceView.part`."""
    if file.name != "transforms.json":
        return "train" if file.name == "transforms_train.json" else "test"
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


def _names_file(entry: object, key: str) -> bool:
    return isinstance(entry, dict) and isinstance(entry.get(key), str) and bool(PurePath(entry[key]).name)


def _read_frame(
    file: Path,
    content: Mapping[str, Any],
    entry: Mapping[str, Any],
    lists: Mapping[str, set[str]],
    notes: dict[str, None],
    paths: Mapping[str, Path],
) -> SourceView:
    relative = entry["file_path"]
    if not _names_file(entry, "file_path"):
        raise ValueError(f"file_path must name an image, got {relative!r}")
    path = paths[relative]
    mask = entry.get("mask_path")
    if mask is not None and not _names_file(entry, "mask_path"):
        raise ValueError(f"mask_path must name an image or be null, got {mask!r}")
    name = _name(relative)
    return SourceView(
        name=name,
        path=path,
        mask_path=None if mask is None else paths[mask],
        lens=read_lens(content, entry, path, notes),
        world_to_camera=_read_pose(entry["transform_matrix"]),
        part=_part(file, lists, name),
    )


def _read_pose(matrix: object) -> Float64:
    try:
        camera_to_world = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError("transform_matrix must be 4 x 4 numbers") from error
    if camera_to_world.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix must be 4 x 4, got the shape {camera_to_world.shape}")
    pose = np.eye(4)
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
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ camera_to_world[:3, 3]
    return pose
