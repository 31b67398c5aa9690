# SPDX-License-Identifier: Apache-2.0
"""Finds lenses and poses of a capture once more, from the pixels at which its photographs saw its points."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.colmap import (
    FILES,
    ColmapCamera,
    ColmapModel,
    Float64,
    complete_files,
    find_models,
    read_model,
    world_to_camera,
)
from blitzgs.capture.names import IMAGE_SUFFIXES
from blitzgs.sfm.engine import has_pycolmap, run_pycolmap
from blitzgs.sfm.reconstruct import WORK, at_work, make_links
from blitzgs.sfm.report import distances, misses
from blitzgs.util.errors import warn
from blitzgs.util.output import check_outside
from blitzgs.util.progress import image_progress

# A refined model replaces the old one if the median miss falls to this share of what it was.
_BETTER = 0.9
# Parts of a picture along an axis, and pixels by which a lens that is worth a try misses: of captures with
# 0.19, 0.13 and 0.01 only the first gained.
_PARTS, _LENS = 8, 0.15


@dataclass(frozen=True)
class Refined:
    """What was found; misses are distances in pixels of observations from the images of their points."""

    before: float  # median miss
    after: float  # of the same observations
    observations: int
    left_out: int  # observations that miss by too much
    lenses: list[tuple[str, str]]  # each camera before and after
    moved: float  # median shift of a photograph, in units of the capture
    adopted: bool  # whether the capture got the refined model; else it has the one before

    def lines(self) -> list[str]:
        """Return the summary for the user."""
        rest = f"; {self.left_out:,} others miss by too much" if self.left_out else ""
        lines = [
            f"{'median miss:':15}{self.before:.3f} -> {self.after:.3f} pixels "
            f"({self.observations:,} observations{rest})"
        ]
        if not self.adopted:
            return [*lines, f"{'result:':15}lenses and poses are as good as can be found: they stay"]
        for old, new in self.lenses:
            if old != new:
                lines += [f"{'lens:':15}{old}", f"{'':15}-> {new}"]
        return [*lines, f"{'photographs:':15}moved by {self.moved:.3g} units (median)"]


def refine(root: Path, capture: Path) -> Refined:
    """Write a capture with the lenses, poses and points of the COLMAP model of another one, refined.

    All else of it is linked. A camera of 15 photographs or more gets its principal point and, if the error
    then falls by another tenth, the lens OPENCV in the place of a pinhole or radial one; others keep theirs.
    World coordinates stay.
    FileNotFoundError: `root` has no model. FileExistsError: `capture` is not empty. ValueError: the model has
    no observations, or `capture` is in `root`. ImportError: pycolmap is not installed.
    """
    if not has_pycolmap():
        raise ImportError("poses are refined by COLMAP's pycolmap: pip install 'blitzgs[sfm]'")
    if not (models := find_models(root)):
        raise FileNotFoundError(
            f"{root} has no COLMAP model (sparse/0 with cameras, images and points3D), whose poses could be "
            "refined; blitzgs sfm finds poses of photographs"
        )
    folder, capture = models[0][0], capture.absolute()
    check_outside(capture, root)
    others = _others(root, folder)
    if not any(path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES for path in others):
        raise ValueError(f"{root} has no photographs beside its model: name the folder of the capture")
    model = read_model(folder, points2d=True)
    missed = distances(model)
    every = np.concatenate([*missed.values(), []])
    if np.isnan(every).all():
        raise ValueError(
            f"{folder} does not say at which pixels photographs saw its points, which tell lens and poses: "
            "blitzgs sfm finds poses of the photographs anew"
        )
    # What an interrupted call left is used again.
    ours = {path.name: path.resolve() for path in others}
    if capture.is_dir() and any(
        path.name != WORK and path.resolve() != ours.get(path.name) for path in capture.iterdir()
    ):
        raise FileExistsError(f"{capture} is not empty: choose another folder for the refined capture")
    if len(models) > 1:
        warn(
            f"of {len(models)} COLMAP models, {folder.relative_to(root)} is refined, with {models[0][1]} "
            f"images; {capture} does not have the others"
        )
    work = capture / WORK
    work.mkdir(parents=True, exist_ok=True)
    make_links({capture / path.name: path for path in others})
    with at_work(work) as lock, image_progress("poses", unit="rounds") as report:
        (found := work / "models").mkdir(exist_ok=True)
        job = {"model": str(folder.absolute()), "refined": str(found), "miss": float(np.nanmedian(every))}
        run_pycolmap("refine", job, work / "colmap.log", lock, report)
    refined = _compare(model, missed, read_model(found, points2d=True))
    source = found if refined.adopted else folder
    shutil.rmtree(sparse := work / "sparse", ignore_errors=True)
    (sparse / "0").mkdir(parents=True)
    for file in (complete_files(source) or {}).values():
        shutil.copyfile(file, sparse / "0" / file.name)
    shutil.rmtree(found)
    (work / "refined.json").write_text(json.dumps(asdict(refined), indent=1))
    sparse.rename(capture / "sparse")
    return refined


def fit_of(model: Path) -> str | None:
    """Return how well lenses and poses of a COLMAP model fit its observations; None: it has none.

    What photographs miss alike, at the same part of the picture, is the lens: the median in each of
    64 parts says how much, and chance hardly adds to it.
    """
    read = read_model(model, points2d=True)
    vectors = misses(read)
    seen = ~np.isnan(vectors[:, 0])
    if not seen.any():
        return None
    sizes = {camera.id: (camera.width, camera.height) for camera in read.cameras}
    ends = read.images.point2d_offsets.astype(np.int64)
    counts = ends[1:] - ends[:-1]
    size = np.repeat(np.array([sizes[camera] for camera in read.images.camera_ids.tolist()]), counts, axis=0)
    part = np.clip(read.images.points2d * _PARTS // size, 0, _PARTS - 1).astype(np.int64) @ [_PARTS, 1]
    alike = [np.median(vectors[seen & (part == number)], axis=0) for number in np.unique(part[seen])]
    median = float(np.median(np.linalg.norm(vectors[seen], axis=1)))
    lens = float(np.sqrt((np.array(alike) ** 2).sum(axis=1).mean()))
    advice = "; blitzgs refine may help" if lens > _LENS else ""
    return f"miss their points by {median:.2f} pixels (median), by {lens:.2f} because of the lens{advice}"


def _compare(old: ColmapModel, was: dict[str, Float64], new: ColmapModel) -> Refined:
    now, lenses = distances(new), {camera.id: _lens(camera) for camera in new.cameras}
    both = {name: ~np.isnan(was[name]) & ~np.isnan(now[name]) for name in was}
    before, after = (
        float(np.median(np.concatenate([side[name][both[name]] for name in was]))) for side in (was, now)
    )
    kept = sum(int(rows.sum()) for rows in both.values())
    from_place, to_place = (
        dict(zip(model.images.names, camera_centres(world_to_camera(model.images)), strict=True))
        for model in (old, new)
    )
    return Refined(
        before=before,
        after=after,
        observations=kept,
        left_out=sum(int((~np.isnan(missed)).sum()) for missed in was.values()) - kept,
        lenses=[(_lens(camera), lenses[camera.id]) for camera in old.cameras],
        moved=float(np.median([np.linalg.norm(from_place[name] - to_place[name]) for name in was])),
        adopted=after < _BETTER * before,
    )


def _lens(camera: ColmapCamera) -> str:
    return f"{camera.model} {', '.join(f'{value:.5g}' for value in camera.params.tolist())}"


def _others(root: Path, model: Path) -> list[Path]:
    """Return what a capture has beside its model."""
    inside = model.relative_to(root).parts
    names = (*inside[:1], WORK)
    files = () if inside else (*FILES, "rigs", "frames")
    return [path for path in root.iterdir() if path.name not in names and path.stem not in files]
