# SPDX-License-Identifier: Apache-2.0
"""The layouts of a capture on disk: finds the COLMAP model or transforms.json and reads views and points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture import colmap, transforms
from blitzgs.capture.cameras import Float64
from blitzgs.capture.files import ImageFinder
from blitzgs.capture.lens import Lens
from blitzgs.formats.ply import read_points

_PHOTOGRAPH_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


@dataclass(frozen=True, eq=False)
class SourceView:
    """A view as the capture's file describes it."""

    name: str
    path: Path
    mask_path: Path | None
    lens: Lens
    world_to_camera: Float64
    is_test: bool | None = None


@dataclass(eq=False)
class SourcePoints:
    """The points as the capture's file describes them, in its own world; see `Capture` for the columns."""

    positions: Float64
    colors: npt.NDArray[np.uint8]
    track_lengths: npt.NDArray[np.int64] | None = None
    errors: Float64 | None = None


def read_layout(root: Path, images: str, downscale: float) -> tuple[list[SourceView], SourcePoints]:
    """Read the views and points of a folder in any of the layouts of docs/captures.md.

    Args:
        root: folder of the capture.
        images: folder of the images, relative to `root`.
        downscale: see `load_capture`; decides which folder of images is used.

    Raises:
        FileNotFoundError: the folder has no capture.
        ValueError: a file is damaged.
    """
    if not root.is_dir():
        raise FileNotFoundError(
            f"{root} is not a folder: name the folder of the capture (images and a COLMAP model) with --data"
        )
    folder = colmap.find_model(root)
    parts = [part for part in ("train", "val") if colmap.find_model(root / part)]
    if transforms.find_transforms(root) and (folder is None or "colmap" in folder.relative_to(root).parts):
        return _read_transforms(root)
    if folder is not None:
        return _read_colmap(root, folder, images, downscale)
    if "train" in parts:
        found = [_read_colmap(root / p, _model_in(root / p), images, downscale, part=p) for p in parts]
        return [view for views, _ in found for view in views], found[0][1]
    incomplete = colmap.find_incomplete_model(root)
    if incomplete is not None:
        return _read_colmap(
            root, incomplete, images, downscale
        )  # raises an error that names the missing file
    raise FileNotFoundError(
        f"{root} holds no capture: expected a COLMAP model (sparse/0 with cameras, images and points3D as "
        f".bin or .txt), or transforms.json{_hint(root)}"
    )


def _hint(root: Path) -> str:
    """Return what a folder without a capture has instead, and what to do."""
    models = [path.parent for depth in ("*", "*/*", "*/*/*") for path in root.glob(f"{depth}/cameras.*")]
    if models:
        return (
            f"; there is a COLMAP model in {min(models)}: name the folder above its sparse/0 with --data, or "
            f"move the model to {root / 'sparse' / '0'}"
        )
    if any(path.suffix.lower() in _PHOTOGRAPH_SUFFIXES for path in [*root.glob("*"), *root.glob("*/*")]):
        return (
            "; it has images but not their cameras: run COLMAP on them (colmap automatic_reconstructor "
            f"--workspace_path {root} --image_path FOLDER_OF_THE_IMAGES --dense 0)"
        )
    return ""


def _model_in(root: Path) -> Path:
    folder = colmap.find_model(root)
    assert folder is not None
    return folder


def _read_transforms(root: Path) -> tuple[list[SourceView], SourcePoints]:
    content = transforms.read_transforms(root)
    views = [
        SourceView(f.name, f.path, f.mask_path, f.lens, f.world_to_camera, f.is_test) for f in content.frames
    ]
    if content.points_path is None:
        return views, SourcePoints(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8))
    return views, SourcePoints(*read_points(content.points_path))


def _read_colmap(
    root: Path, folder: Path, images: str, downscale: float, part: str = ""
) -> tuple[list[SourceView], SourcePoints]:
    model = colmap.read_model(folder)
    lenses: dict[int, Lens] = {}
    for camera in model.cameras:
        if camera.id in lenses:
            raise ValueError(f"{folder}: there are two cameras {camera.id}")
        try:
            lenses[camera.id] = Lens(camera.model, camera.width, camera.height, tuple(camera.params.tolist()))
        except ValueError as error:
            raise ValueError(f"{folder}: camera {camera.id}: {error}") from error
    names = model.images.names
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise ValueError(f"{folder}: there are two images called {twice}")
    unknown = [names[i] for i, c in enumerate(model.images.camera_ids.tolist()) if c not in lenses]
    if unknown:
        raise ValueError(
            f"{folder}: the cameras of {len(unknown)} images (first: {unknown[0]}) are not there"
        )
    lens_of = [lenses[c] for c in model.images.camera_ids.tolist()]
    paths = ImageFinder(root, images).find_all(names, lens_of, downscale)
    poses = colmap.world_to_camera(model.images)
    prefix = f"{part}/" if part else ""
    views = [
        SourceView(prefix + name, path, None, lens, pose)
        for name, path, lens, pose in zip(names, paths, lens_of, poses, strict=True)
    ]
    p = model.points
    return views, SourcePoints(p.positions, p.colors, p.track_lengths, p.errors)
