# SPDX-License-Identifier: Apache-2.0
"""Finds the project of another program in a folder, and reads it and the points beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from blitzgs.capture.cameras import SourceView
from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens
from blitzgs.capture.names import (
    IMAGE_SUFFIXES,
    any_case,
    by_parts,
    files_below,
    find_images,
    to_convert,
    unified,
)
from blitzgs.capture.points import SUFFIXES, SourcePoints, file_points
from blitzgs.capture.projects import Project
from blitzgs.capture.projects.metashape import is_metashape, read_metashape
from blitzgs.capture.projects.opensfm import NAME, ORIGINAL, read_opensfm
from blitzgs.capture.projects.pix4d import SUFFIX, read_opf, read_pix4d
from blitzgs.capture.projects.realitycapture import (
    is_bundler,
    is_realitycapture,
    read_bundler,
    read_realitycapture,
)
from blitzgs.capture.world import WorldFrame, converted, frame_beside, reference_system
from blitzgs.util.errors import located, warn


class FoundProject(NamedTuple):
    """The project of a program in a folder: its file, and what reads it."""

    program: str
    file: Path
    read: Callable[[Path], Project]


_PARAMS = ("", "params/", "*/params/", "*/*/params/")
# Each program, how its files are called, what reads them, and what tells whether a file is one.
_KINDS: tuple[tuple[str, tuple[str, ...], Callable[[Path], Project], Callable[[Path], bool]], ...] = (
    ("Metashape", ("*.xml",), read_metashape, is_metashape),
    ("OPF", ("*.opf", "*/*.opf"), read_opf, Path.is_file),
    ("Pix4D", tuple(f"{at}*{SUFFIX}" for at in _PARAMS), read_pix4d, Path.is_file),
    ("RealityCapture", ("*.csv",), read_realitycapture, is_realitycapture),
    ("OpenSfM", (NAME, f"opensfm/{NAME}", ORIGINAL), read_opensfm, Path.is_file),
    ("Bundler", ("*.out",), read_bundler, is_bundler),
)
# Folders above a project's file that may be the capture's: opensfm/, or 1_initial/params/.
_FOLDERS_ABOVE = 3


def named_project(path: Path, images: str) -> tuple[Path, FoundProject]:
    """Return the folder of the capture that the file of a project describes, and the project.

    It is the nearest folder that has the images' folder. FileNotFoundError: the file is no project.
    """
    for program, patterns, read, is_one in _KINDS:
        if any(PurePosixPath(path.name).match(Path(p).name) for p in patterns) and is_one(path):
            above = [path.parent, *path.parent.parents][:_FOLDERS_ABOVE]
            root = next((folder for folder in above if (folder / images).is_dir()), path.parent)
            return root, FoundProject(program, _original(path), read)
    raise FileNotFoundError(
        f"{path} is no project that can be read (docs/captures.md lists them): name the folder of the "
        f"capture (images and a COLMAP model) with --data{to_convert([path.name])}"
    )


def _original(path: Path) -> Path:
    """Return the file that OpenDroneMap kept when it moved a reconstruction, or the file itself."""
    original = path.with_name(ORIGINAL)
    return original if path.name == NAME and original.is_file() else path


def find_project(root: Path) -> FoundProject | None:
    """Return the project in a folder; None: there is none.

    A reconstruction of Bundler beside another project has its points, and is not a project of its own.
    ValueError: there are several.
    """
    found = [
        FoundProject(program, file, read)
        for program, patterns, read, is_one in _KINDS
        for file in sorted({_original(f) for pattern in patterns for f in root.glob(pattern)})
        if file.is_file() and is_one(file)
    ]
    main = [project for project in found if project.read is not read_bundler] or found
    if len(main) > 1:
        shown = ", ".join(str(project.file.relative_to(root)) for project in main[:5])
        raise ValueError(f"{root} has {len(main)} projects ({shown}): name one of these files with --data")
    return main[0] if main else None


def read_project(
    root: Path, found: FoundProject, images: str, downscale: float
) -> tuple[list[SourceView], SourcePoints, Project]:
    """Read a project: its views, its points, and what else it says.

    FileNotFoundError: no photograph is there, so that the size of none is known. ValueError: the project is
    damaged.
    """
    with located(str(found.file)):
        project = found.read(found.file)
    if not project.views:
        raise ValueError(
            f"{found.file} has no photograph with a pose: align the photographs, and export again"
        )
    project.frame = project.frame or frame_beside(root)
    names = _with_suffixes(root / images, root, [_relative(view.name) for view in project.views])
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise ValueError(
            f"{found.file}: there are two photographs called {twice}, and nothing tells them apart: give all "
            "photographs names of their own, and align them again"
        )
    lenses = _lenses(found, project, names, root, images)
    paths = find_images(root, images, names, lenses, downscale)
    if project.lost:
        project.notes.append(f"{project.lost} photographs of the project have no pose and are left out")
    for note in project.notes:
        warn(f"{found.file}: {note}")
    views = [
        SourceView(name, path, None, lens, view.world_to_camera)
        for name, path, lens, view in zip(names, paths, lenses, project.views, strict=True)
    ]
    return views, _points(root, found, project, views), project


def _relative(name: str) -> str:
    """Return a name without the drive and folders of the machine that wrote it."""
    name = unified(name)
    return PurePosixPath(name).name if name.startswith("/") or name[1:3] == ":/" else name


def _with_suffixes(folder: Path, root: Path, names: Sequence[str]) -> list[str]:
    """Complete names without a suffix, as Metashape's labels are (ValueError: several files fit one)."""
    if all(name.lower().endswith(IMAGE_SUFFIXES) for name in names):
        return list(names)
    base = folder if folder.is_dir() else root
    files = [file for file in files_below(base) if file.lower().endswith(IMAGE_SUFFIXES)]
    known, found = by_parts(files), []
    for name in names:
        key = any_case(name)
        fits = [] if key.endswith(IMAGE_SUFFIXES) else [files[index] for index in known.get(key, [])]
        fits = [file for file in fits if any_case(file).rpartition(".")[0] == key] or fits
        if len(fits) > 1:
            shown = ", ".join(fits[:3])
            raise ValueError(f"{base}: {len(fits)} files could be the photograph {name} ({shown}): keep one")
        found.append(fits[0] if fits else name)
    return found


def _lenses(
    found: FoundProject, project: Project, names: Sequence[str], root: Path, images: str
) -> list[Lens]:
    if all(isinstance(view.lens, Lens) for view in project.views):
        return [view.lens for view in project.views if isinstance(view.lens, Lens)]
    paths = find_images(root, images, names, (), 1)
    sizes = [(h.width, h.height) if p.is_file() and (h := read_header(p)) else None for p in paths]
    common = Counter(size for size in sizes if size is not None).most_common(1)
    if not common:
        raise FileNotFoundError(
            f"{found.file} gives lengths as shares of the image, and none of its {len(names)} photographs "
            f"(first: {names[0]}) is in {root / images}: put them there, or name their folder "
            "with --data.images=FOLDER"
        )
    lenses = []
    for view, size in zip(project.views, sizes, strict=True):
        with located(f"{found.file}: {view.name}"):
            # A photograph that is missing is refused or left out later.
            lenses.append(view.lens if isinstance(view.lens, Lens) else view.lens(*(size or common[0][0])))
    return lenses


# Points and views that are compared to find out in which coordinates points are.
_SAMPLE, _VIEWS = 2000, 100
# Views see points whose pixels are so far apart, as a share of the width.
_SPREAD = 0.05


def _points(root: Path, found: FoundProject, project: Project, views: Sequence[SourceView]) -> SourcePoints:
    """Return the project's own points, or those of a file beside it, in the world of its cameras.

    Programs export cameras in coordinates of their own and points in those of a reference system, or both in
    one of the two: the coordinates in which the views see the points are taken.
    """
    if project.points is not None and len(project.points.positions):
        return project.points
    points = _points_beside(root, found)
    frame, choices = project.frame, {"the project's own coordinates": points.positions}
    if frame is not None:
        choices[f"coordinates of {frame.name}"] = frame.from_world(points.positions)

    def seen(name: str) -> int:
        sample = choices[name][:: max(1, len(points.positions) // _SAMPLE)]
        pixels = [(view, view.pixels_of(sample)) for view in views[:: max(1, len(views) // _VIEWS)]]
        # Points of another world are as one far away, if they are seen at all.
        return sum(len(p) > 1 and np.ptp(p, axis=0).max() > _SPREAD * view.lens.width for view, p in pixels)

    def add(frame: WorldFrame, crs: Any) -> None:
        moved = converted(points.positions, crs, frame.crs)
        choices[f"coordinates of {reference_system(crs).name}"] = frame.from_world(moved)

    if frame is not None and frame.crs and points.crs is not None:
        add(frame, points.crs)
    elif frame is not None and frame.crs and project.crs and not any(map(seen, choices)):
        with suppress(ValueError):  # that no view sees the points is said later
            add(frame, project.crs)
    best = max(choices, key=seen)
    if best != next(iter(choices)):
        warn(f"{points.path}: the points are in {best}, and are moved to the cameras'")
    points.positions = choices[best]
    return points


def _points_beside(root: Path, found: FoundProject) -> SourcePoints:
    for bundle in sorted(root.glob("*.out")):
        if is_bundler(bundle) and bundle != found.file:
            with located(str(bundle)):
                return read_bundler(bundle).points or SourcePoints.none()
    files = sorted(p for p in root.iterdir() if p.suffix.lower() in (".ply", *SUFFIXES) and p.is_file())
    named = [path for path in files if path.stem.lower() in ("points3d", "sparse_pc", "points")] or files
    if len(named) == 1:
        return file_points(named[0])
    if named:
        shown = ", ".join(path.name for path in named[:5])
        warn(
            f"{root} has {len(named)} files of points ({shown}), and none is used: call one of them "
            f"points{named[0].suffix.lower()}"
        )
    return SourcePoints.none()
