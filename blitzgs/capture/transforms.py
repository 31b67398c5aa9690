# SPDX-License-Identifier: Apache-2.0
"""Reads cameras from transforms.json: nerfstudio's single file, or Blender's transforms_train/test.json.

Poses in these files are camera-to-world with x right, y up, z backwards. Poses of this package are
world-to-camera with y down, z forwards.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "OPENCV": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "PINHOLE": ("PINHOLE", ()),
    "SIMPLE_PINHOLE": ("PINHOLE", ()),
}
_COEFFICIENTS = _MODELS["OPENCV"][1]


@dataclass(frozen=True)
class Frame:
    """One frame: its lens at the size that the file states, and its world-to-camera pose, float64 [4, 4]."""

    name: str
    path: Path
    mask_path: Path | None
    lens: Lens
    world_to_camera: Float64
    is_test: bool | None
    """Whether the files hold it out; None when they do not say."""


@dataclass(frozen=True)
class Transforms:
    """The combined content of a capture's files."""

    frames: list[Frame]
    points_path: Path | None


def find_transforms(root: Path) -> list[Path]:
    """Return the files to read: transforms.json, else the files of Blender's train and test split, if any."""
    if (root / "transforms.json").is_file():
        return [root / "transforms.json"]
    files = [root / f"transforms_{part}.json" for part in ("train", "test")]
    return [path for path in files if path.is_file()]


def read_transforms(root: Path) -> Transforms:
    """Read every frame of a capture.

    Raises:
        ValueError: a field is missing or makes no sense; names the file, the frame and the field.
    """
    frames: list[Frame] = []
    points_path = None
    files = find_transforms(root)
    for path in files:
        try:
            content = json.loads(path.read_text(encoding="utf-8-sig"))
            entries = content["frames"]
            if not isinstance(entries, list):
                raise TypeError("'frames' is not a list")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path}: not a transforms file with a list of frames ({error})") from error
        if "ply_file_path" in content:
            if not isinstance(content["ply_file_path"], str):
                raise ValueError(f"{path}: ply_file_path must be text, got {content['ply_file_path']!r}")
            points_path = root / content["ply_file_path"]
        held_out = _held_out(path, content)
        for index, entry in enumerate(entries):
            try:
                frames.append(_read_frame(root, content, entry, held_out))
            except (KeyError, TypeError, ValueError, ArithmeticError) as error:
                reason = f"the field {error} is missing" if isinstance(error, KeyError) else str(error)
                raise ValueError(f"{path}: frame {index}: {reason}") from error
        if isinstance(held_out, set) and (lost := held_out - {frame.name for frame in frames}):
            raise ValueError(
                f"{path}: test_filenames or val_filenames name {len(lost)} images that are no frames "
                f"(first: {min(lost)})"
            )
    counts = Counter(frame.path for frame in frames)
    if twice := sorted({frame.name for frame in frames if counts[frame.path] > 1}):
        shown = ", ".join(twice[:5]) + (", ..." if len(twice) > 5 else "")
        raise ValueError(
            f"{' and '.join(map(str, files))}: images of more than one frame: {shown}; keep one frame of each"
        )
    return Transforms(frames, points_path)


def _held_out(file: Path, content: Mapping[str, Any]) -> set[str] | bool | None:
    """Return the names of the frames that a file holds out, or whether it holds out all; None: not said."""
    if file.name != "transforms.json":
        return file.name == "transforms_test.json"
    lists = {key: content[key] for key in ("test_filenames", "val_filenames") if key in content}
    for key, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of the file_path of frames")
    return {str(Path(name)) for names in lists.values() for name in names} if lists else None


def _read_frame(
    root: Path, content: Mapping[str, Any], entry: Mapping[str, Any], held_out: set[str] | bool | None
) -> Frame:
    relative = entry["file_path"]
    if not isinstance(relative, str) or not PurePath(relative).name:
        raise ValueError(f"file_path must name an image, got {relative!r}")
    path = next((p for s in _SUFFIXES if (p := root / (relative + s)).is_file()), root / relative)
    mask = entry.get("mask_path")
    if mask is not None and (not isinstance(mask, str) or not PurePath(mask).name):
        raise ValueError(f"mask_path must name an image or be null, got {mask!r}")
    name = str(Path(relative))
    return Frame(
        name=name,
        path=path,
        mask_path=None if mask is None else root / mask,
        lens=_read_lens({**content, **entry}, path),
        world_to_camera=_read_pose(entry["transform_matrix"]),
        is_test=name in held_out if isinstance(held_out, set) else held_out,
    )


def _read_pose(matrix: object) -> Float64:
    camera_to_world = np.asarray(matrix, dtype=np.float64)
    if camera_to_world.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"transform_matrix must be 4 x 4, got the shape {camera_to_world.shape}")
    pose = np.eye(4)
    rotation = camera_to_world[:3, :3] * np.array([1.0, -1.0, -1.0])
    # Some exporters do not remove the scale of the rig.
    rotation = rotation / np.linalg.norm(rotation, axis=0)
    if np.isfinite(rotation).all():
        if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3):
            raise ValueError("transform_matrix is not a rotation and a translation")
        if np.linalg.det(rotation) < 0:
            raise ValueError("transform_matrix mirrors the scene: one of its axes has the wrong sign")
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ camera_to_world[:3, 3]
    return pose


def _read_lens(fields: Mapping[str, Any], path: Path) -> Lens:
    if "w" in fields and "h" in fields:
        width, height = int(fields["w"]), int(fields["h"])
    elif not path.is_file():
        raise ValueError(f"the image {path} does not exist, and its size is not given by w and h")
    else:
        header = read_header(path)
        width, height = header.width, header.height
    if min(width, height) < 1:
        raise ValueError(f"the image's size must be at least 1 x 1, got {width} x {height}")
    if "fl_x" in fields:
        fx = float(fields["fl_x"])
        fy = float(fields.get("fl_y", fx))
    elif "camera_angle_x" in fields:
        fx = 0.5 * width / float(np.tan(0.5 * float(fields["camera_angle_x"])))
        fy = (
            0.5 * height / float(np.tan(0.5 * float(fields["camera_angle_y"])))
            if "camera_angle_y" in fields
            else fx
        )
    else:
        raise ValueError("neither fl_x nor camera_angle_x is given")
    model = _camera_model(fields)
    name, distortion = _MODELS[model]
    params = [fx, fy, float(fields.get("cx", width / 2)), float(fields.get("cy", height / 2))]
    params += [float(fields.get(key, 0.0)) for key in distortion]
    return Lens(name, width, height, tuple(params))


def _camera_model(fields: Mapping[str, Any]) -> str:
    """Return the camera model; refuse coefficients that it would not apply as their writer meant them."""
    is_fisheye = fields.get("is_fisheye", False)
    if not isinstance(is_fisheye, bool):
        raise ValueError(f"is_fisheye must be true or false, got {is_fisheye!r}")
    # instant-ngp names no model.
    model = str(fields.get("camera_model", "OPENCV_FISHEYE" if is_fisheye else "OPENCV"))
    if model not in _MODELS:
        raise ValueError(f"camera_model {model} is not supported; known: {', '.join(_MODELS)}")
    if is_fisheye and model != "OPENCV_FISHEYE":
        raise ValueError(f"is_fisheye is true but camera_model is {model}: remove the one that is wrong")
    given = {key: value for key in _COEFFICIENTS if (value := float(fields.get(key, 0.0))) != 0}
    if model == "OPENCV" and "k4" in given and not {"k5", "k6"} & fields.keys():
        # nerfstudio multiplies by 1 + k1 r + k2 r^2 + k3 r^3 + k4 r^4 with r = x^2 + y^2.
        raise ValueError(
            f"k4 is {given['k4']:g}, without k5 and k6: a polynomial of four coefficients, as nerfstudio's, "
            "is no lens of this package; fit the lens again without k4 or undistort the images, or write k5 "
            "and k6 if k4 is of OpenCV's rational model"
        )
    if model == "OPENCV_FISHEYE" and (lost := sorted(given.keys() - set(_MODELS[model][1]))):
        values = ", ".join(f"{key} = {given[key]:g}" for key in lost)
        raise ValueError(
            f"{values}: a fisheye lens has only k1 to k4; set the others to 0, or name another camera_model"
        )
    return model
