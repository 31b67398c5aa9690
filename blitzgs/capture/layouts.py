# SPDX-License-Identifier: Apache-2.0
"""The layouts of a capture on disk: finds the COLMAP model or transforms.json and reads views and points."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.capture import colmap, transforms
from blitzgs.capture.cameras import SourceView
from blitzgs.capture.lengths import StrayCamera
from blitzgs.capture.lens import lenses_of
from blitzgs.capture.names import BY_PRODUCTS, IMAGE_SUFFIXES, find_images, relative_to, to_convert
from blitzgs.capture.points import SourcePoints, model_points, transforms_points
from blitzgs.capture.projects.find import FoundProject, find_project, read_project
from blitzgs.capture.world import WorldFrame, frame_beside
from blitzgs.util.errors import located, warn

# What programs write beside the images of a synthetic capture.
_BY_PRODUCT = re.compile(rf"(?i)({BY_PRODUCTS})s?(_?\d+)?$")
# How far entries of an image's rotation in two models of one world may be apart.
_SAME_TURN = 0.05


@dataclass(frozen=True)
class About:
    """What was read of a capture and what was decided, for messages; `load_capture` knows all of it."""

    cameras: str  # the model or files that the poses are from, relative to the capture
    split_from: str = ""  # what in the files decides on the split
    notes: tuple[str, ...] = ()  # what the reader decided between fields or files, and what has no effect
    without_camera: int = 0  # photographs beside those of the views that have no camera
    frame: WorldFrame | None = None  # where the capture lies in the world; None: the files do not say
    split: str = ""  # what decided on the held-out views
    # The cameras whose pose is wrong; they are left out unless `stray_cameras` keeps them.
    strays: Sequence[StrayCamera] = ()
    unused: int = 0  # number of frames that are in no list of the file's own split
    missing: int = 0  # number of views whose image is not on disk
    blind: int = 0  # number of views that see none of the points
    random_points: bool = False  # whether the capture has no points, so that training starts from random ones
    points_from: str = ""  # the file of the points, relative to the capture
    colors_from: str = ""  # what in it gives their colours; empty: nothing
    with_alpha: int = 0  # number of photographs that have alpha
    extra_bands: int = 0  # number of photographs with a band that is neither colour nor alpha; it is not used
    damaged: int = 0  # number of views that `allow_missing` left out because their image or mask is damaged


def read_layout(
    root: Path, images: str, downscale: float, sparse: str = "largest", project: FoundProject | None = None
) -> tuple[list[SourceView], SourcePoints, About]:
    """Read the views and points of a folder in any of the layouts of docs/captures.md, or of a `project`.

    `downscale` (which decides on the folder of images) and `sparse` are those of `load_capture`.
    FileNotFoundError: the folder has no capture. ValueError: a file is damaged.
    """
    if not root.is_dir():
        raise FileNotFoundError(
            f"{root} is not a folder: name the folder of the capture (images and a COLMAP model) with --data"
        )
    if project is not None:
        views, points, about = _read_project(root, project, images, downscale)
        return views, points, _with_photographs(about, views)
    models, notes = _models(root, sparse)
    folder = models[0] if models else None
    parts = {part: found[0][0] for part in ("train", "val") if (found := colmap.find_models(root / part))}
    by_default = sparse in ("largest", "all")
    has_transforms = by_default and bool(transforms.find_transforms(root))
    if has_transforms and (folder is None or "colmap" in folder.relative_to(root).parts):
        views, points, about = _read_transforms(root, folder)
    elif folder is not None:
        read = [_read_colmap(root, model, images, downscale) for model in models]
        views, points = read[0] if len(read) == 1 else _joined(read)
        notes += [note for model in models for note in _of_other_kind(root, model)]
        shown = " and ".join(str(model.relative_to(root)) for model in models if model != root)
        about = About(shown or "cameras, images and points3D", "", tuple(notes))
    elif "train" in parts:
        read = [_read_colmap(root / p, model, images, downscale, part=p) for p, model in parts.items()]
        views, points = [view for views, _ in read for view in views], read[0][1]
        about = About(" and ".join(str(model.relative_to(root)) for model in parts.values()))
    elif (project := find_project(root)) is not None:
        views, points, about = _read_project(root, project, images, downscale)
    else:
        incomplete = colmap.find_incomplete_model(root)
        if incomplete is not None:
            _read_colmap(root, incomplete, images, downscale)  # raises an error that names the missing file
        raise FileNotFoundError(
            f"{root} holds no capture: expected a COLMAP model (sparse/0 with cameras, images and points3D "
            f"as .bin or .txt), transforms.json, or a project of another program{_hint(root)}"
        )
    if about.frame is None:
        about = replace(about, frame=frame_beside(root))
    return views, points, _with_photographs(about, views)


def _read_project(
    root: Path, project: FoundProject, images: str, downscale: float
) -> tuple[list[SourceView], SourcePoints, About]:
    views, points, content = read_project(root, project, images, downscale)
    cameras = f"{relative_to(root, project.file)} ({project.program})"
    return views, points, About(cameras, notes=tuple(content.notes), frame=content.frame)


def _hint(root: Path) -> str:
    """Return what a folder without a capture has instead, and what to do."""
    files = [path for depth in ("*", "*/*", "*/*/*") for path in root.glob(f"{depth}/cameras.*")]
    models = [path.parent for path in files if path.suffix in (".bin", ".txt")]
    if models:
        return (
            f"; there is a COLMAP model in {min(models)}: name the folder above its sparse/0 with --data, or "
            f"move the model to {root / 'sparse' / '0'}"
        )
    names = [path.name for path in (*root.glob("*"), *root.glob("*/*"))]
    if any(name.lower().endswith(IMAGE_SUFFIXES) for name in names):
        return (
            f"; it has images but not their cameras: blitzgs sfm {shlex.quote(str(root))} CAPTURE finds these"
        )
    return to_convert(names)


def _models(root: Path, sparse: str) -> tuple[list[Path], list[str]]:
    """Return the COLMAP models to read, the largest first, and a line if others are left out."""
    if sparse not in ("largest", "all"):
        named = root / sparse
        found = colmap.find_models(named)[:1]
        if found and found[0][0].is_relative_to(root):
            return [found[0][0]], []
        raise FileNotFoundError(
            f"data.sparse: {named} has no complete COLMAP model (cameras, images and points3D); name its "
            "folder relative to the capture, or use 'largest' or 'all'"
        )
    models = colmap.find_models(root)
    if len(models) < 2:
        return [model for model, _ in models], []
    counts = ", ".join(f"{model.relative_to(root)} {count} images" for model, count in models)
    if sparse == "all":
        return [model for model, _ in models], [f"{len(models)} COLMAP models are read as one: {counts}"]
    note = (
        f"of {len(models)} COLMAP models, the largest is used: {counts} (others with --data.sparse=FOLDER; "
        "--data.sparse=all reads all, if they have the same world coordinates)"
    )
    warn(note)
    return [models[0][0]], [note]


def _of_other_kind(root: Path, model: Path) -> list[str]:
    """Return a line if a model has files of both kinds, of which one is read: the others may be newer."""
    read = (colmap.complete_files(model) or {})["images"]
    other = read.with_suffix(".txt" if read.suffix == ".bin" else ".bin")
    shown = relative_to(root, read)
    return [f"{shown} is read, and {other.name} beside it not"] if other.is_file() else []


def _joined(parts: list[tuple[list[SourceView], SourcePoints]]) -> tuple[list[SourceView], SourcePoints]:
    """Return the views and points of several models; of an image in two of them, the first counts.

    ValueError: such an image looks elsewhere in the second, so that their worlds are not the same.
    """
    views: dict[str, SourceView] = {}
    for view in (view for found, _ in parts for view in found):
        known = views.setdefault(view.name, view)
        ours, theirs = (each.world_to_camera[:3, :3] for each in (known, view))
        if not np.allclose(ours, theirs, atol=_SAME_TURN, equal_nan=True):
            raise ValueError(
                f"data.sparse: {view.name} is in two COLMAP models and looks elsewhere in the second: their "
                "worlds are not the same; name one model, or align them first (colmap model_merger)"
            )
    columns = [points.columns() for _, points in parts]
    common = [name for name in columns[0] if all(name in others for others in columns)]
    joined: dict[str, Any] = {name: np.concatenate([each[name] for each in columns]) for name in common}
    first = parts[0][1]
    return list(views.values()), SourcePoints(**joined, path=first.path, colors_from=first.colors_from)


def _with_photographs(about: About, views: Sequence[SourceView]) -> About:
    """Add the number of photographs that have no camera, and say it.

    They are searched in the folders of those that have one, so that folders of masks or of smaller copies do
    not count; only files with the suffixes of photographs in use count, and no depths or normals beside them.
    """
    used = {view.path for view in views}
    suffixes = {path.suffix.lower() for path in used} & set(IMAGE_SUFFIXES)
    folders = {path.parent for path in used}
    known = used | {view.mask_path for view in views}
    without = sorted(
        file
        for folder in folders
        for file in (folder.iterdir() if folder.is_dir() else ())
        if file.suffix.lower() in suffixes
        and file not in known
        and not file.name.startswith(".")
        and not _BY_PRODUCT.search(file.stem)
    )
    if without:
        warn(
            f"{len(without)} of {len(without) + len(used)} photographs have no camera in {about.cameras} "
            f"and are not used (first: {without[0].name})"
        )
    return replace(about, without_camera=len(without))


def _read_transforms(root: Path, model: Path | None) -> tuple[list[SourceView], SourcePoints, About]:
    content = transforms.read_transforms(root)
    notes = list(content.notes)
    if content.files[0].name == "transforms.json":
        others = [f"transforms_{part}.json" for part in ("train", "val", "test")]
        if beside := [name for name in others if (root / name).is_file()]:
            notes.append(f"transforms.json is read, and {', '.join(beside)} beside it not")
    for note in notes:
        if not note.startswith("fields without effect"):
            warn(f"{content.files[0]}: {note}")
    about = About(
        " and ".join(path.name for path in content.files), " and ".join(content.split), tuple(notes)
    )
    return content.frames, transforms_points(root, content, model), about


def _read_colmap(
    root: Path, folder: Path, images: str, downscale: float, part: str = ""
) -> tuple[list[SourceView], SourcePoints]:
    model = colmap.read_model(folder)
    used = set(model.images.camera_ids.tolist())
    with located(str(folder)):
        lenses = lenses_of([camera for camera in model.cameras if camera.id in used])
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
    paths = find_images(root, images, names, lens_of, downscale)
    poses = colmap.world_to_camera(model.images)
    views = [
        SourceView(f"{part}/{name}" if part else name, path, None, lens, pose)
        for name, path, lens, pose in zip(names, paths, lens_of, poses, strict=True)
    ]
    return views, model_points(model)
