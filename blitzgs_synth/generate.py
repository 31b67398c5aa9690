# SPDX-License-Identifier: Apache-2.0
"""Writes a synthetic city as a capture, by `blitzgs synth`: images, sparse model, manifest."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from blitzgs.capture.colmap import (
    FILES,
    ColmapCamera,
    ColmapImages,
    ColmapModel,
    ColmapPoints,
    read_model,
    write_model,
)
from blitzgs.cli.arguments import Commands, add_command
from blitzgs.util.output import PARTIAL, locked, write_file
from blitzgs.util.progress import image_progress
from blitzgs.util.rotations import quaternions
from blitzgs_synth.flight import View, plan_flight
from blitzgs_synth.photographs import CORNERS, Progress, each, take_photographs
from blitzgs_synth.plan import PRESETS, CityOptions, Doubles, Ints, Plan
from blitzgs_synth.render import City
from blitzgs_synth.tracks import Cloud, track

MANIFEST = "city.json"
_STARTED = "started.json"  # the manifest of a city that is not finished
_LOCK = ".lock"
_FOLDERS = ("images", "sparse")


def generate_city(
    out: Path | str,
    *,
    processes: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    **parameters: Any,
) -> Path:
    """Generate a city and photograph it from the air, unless `out` already holds the same one.

    Writes `images/*.jpg`, `sparse/0/*.bin` (a COLMAP model: PINHOLE camera, poses, points with tracks; in
    metres, z up) and `city.json` (the parameters, fields of `CityOptions`). The folder appears only when
    complete. Until then the files are in `.NAME.partial` beside it, and after an interruption the same call
    continues there. The files depend on the parameters alone, not on processes or interruptions. On another
    processor or with other library versions, single pixels may differ by rounding.

    `processes` render (None: one for each core that this process may use); `progress` is called after each
    image. TypeError, ValueError: a parameter is unknown, or out of range. FileExistsError: `out` holds
    something else, which `overwrite` allows of a city. BlockingIOError: another process is making it.
    BrokenProcessPool: the system ended one of the processes, for example because memory ran out. ImportError:
    `embreex` is not installed.
    """
    options = CityOptions(**parameters)
    out = Path(out)
    if out.name in ("", ".."):
        raise ValueError(f"synthetic city: the folder must be given by its name, got '{out}'")
    if processes is not None and processes < 1:
        raise ValueError(f"synthetic city: processes must be at least 1, got {processes}")
    if _reusable(out, options, overwrite):
        return out
    partial = out.with_name(f".{out.name}.partial")
    with _begun(partial, options):
        _write(partial, options, processes or len(os.sched_getaffinity(0)), progress)
        for name in (_STARTED, _LOCK):
            (partial / name).unlink()
        if out.exists() and any(out.iterdir()):
            _replace(out, partial)
        else:
            partial.rename(out)
    return out


@contextlib.contextmanager
def _begun(partial: Path, options: CityOptions) -> Iterator[None]:
    """Lock the folder in which a city is made; empty it if it holds the beginning of another city."""
    partial.mkdir(parents=True, exist_ok=True)
    with locked(partial / _LOCK, f"{partial}: another process is making this city; wait for it"):
        started = partial / _STARTED
        wanted = json.dumps(options.manifest(), indent=2) + "\n"
        found = started.read_text() if started.exists() else ""
        leftovers = [path for path in partial.iterdir() if path.name != _LOCK]
        if leftovers and not found:
            raise FileExistsError(f"{partial} holds no unfinished city: move it, or choose another folder")
        if found != wanted:
            for path in leftovers:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            write_file(started, wanted)
        yield


def _reusable(out: Path, options: CityOptions, overwrite: bool) -> bool:
    """Return whether `out` holds this city; raise if it holds files that must not be replaced."""
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for the city")
    if not out.exists() or not any(out.iterdir()):
        return False
    if not (out / MANIFEST).exists():
        raise FileExistsError(f"{out} has files but no generated city; choose another folder")
    try:
        found = json.loads((out / MANIFEST).read_text())
        if not isinstance(found, dict):
            raise ValueError("not a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        what = f"holds no generated city ({MANIFEST}: {error})"
        raise FileExistsError(f"{out} {what}; choose another folder") from error
    pairs = [(key, found.get(key), value) for key, value in options.manifest().items()]
    different = [f"{key} {mine}, not {wanted}" for key, mine, wanted in pairs if mine != wanted]
    if not different:
        return True
    if not overwrite:
        what = f"holds another city ({'; '.join(different)})"
        raise FileExistsError(f"{out} {what}; choose another folder, or --overwrite it")
    # Its folders are replaced as a whole, so they must have no other files.
    sparse = out / "sparse" / "0"
    own = {sparse / f"{name}.bin" for name in FILES}
    if all(path.is_file() for path in own):
        own |= {out / "images" / name for name in read_model(sparse).images.names}
    for folder in _FOLDERS:
        for path in sorted((out / folder).rglob("*")):
            if path not in own and not path.is_dir():
                raise FileExistsError(f"{path} is no part of the city, and would be lost: move it elsewhere")
    return False


def _write(folder: Path, options: CityOptions, processes: int, progress: Progress | None) -> None:
    city = City(Plan(options))
    views = plan_flight(options)
    corners = take_photographs(folder, city, views, processes, progress)
    cloud = track(city, views, corners, options.seed, lambda seen, count: each(seen, count, processes))
    write_model(folder / "sparse" / "0", colmap_model(views, cloud))
    shutil.rmtree(folder / CORNERS)
    for path in list((folder / "images").iterdir()):
        if PARTIAL.fullmatch(path.name):  # of a generation that was killed
            path.unlink(missing_ok=True)
    write_file(folder / MANIFEST, json.dumps(options.manifest(), indent=2) + "\n")


def _replace(out: Path, made: Path) -> None:
    """Replace the city in `out` by a new one; other files in it stay."""
    (out / MANIFEST).unlink()
    for name in _FOLDERS:
        shutil.rmtree(out / name, ignore_errors=True)
        (made / name).rename(out / name)
    (made / MANIFEST).rename(out / MANIFEST)
    made.rmdir()


def colmap_model(views: list[View], cloud: Cloud) -> ColmapModel:
    """Return one PINHOLE camera, the poses with their observations, and the points with their tracks.

    An image lists its matched observations first, by point, and then the corners without a match.
    """
    first = views[0]
    params = np.array([first.focal, first.focal, first.width / 2, first.height / 2])
    camera = ColmapCamera(1, "PINHOLE", first.width, first.height, params)

    matched = np.bincount(cloud.views, minlength=len(views))
    starts = np.concatenate([[0], np.cumsum(matched)])
    pixels, points = [], []
    for i, loose in enumerate(cloud.loose):
        pixels += [cloud.pixels[starts[i] : starts[i + 1]], loose]
        points += [cloud.points[starts[i] : starts[i + 1]] + 1, np.full(len(loose), -1)]
    totals = matched + [len(loose) for loose in cloud.loose]
    image_ids = np.arange(1, len(views) + 1, dtype=np.uint32)
    images = ColmapImages(
        ids=image_ids,
        camera_ids=np.ones(len(views), np.uint32),
        quats=quaternions(torch.from_numpy(np.stack([v.rotation for v in views]))).numpy(),
        translations=np.stack([v.translation for v in views]),
        names=[v.name for v in views],
        point2d_offsets=np.concatenate([[0], np.cumsum(totals)]).astype(np.uint64),
        points2d=np.concatenate(pixels),
        point3d_ids=np.concatenate(points).astype(np.int64),
    )

    by_point = np.argsort(cloud.points, kind="stable")
    in_image = np.arange(len(cloud.views)) - starts[cloud.views]
    lengths = np.bincount(cloud.points, minlength=len(cloud.positions))
    return ColmapModel(
        [camera],
        images,
        ColmapPoints(
            ids=np.arange(1, len(cloud.positions) + 1, dtype=np.int64),
            positions=cloud.positions,
            colors=cloud.colors,
            errors=_mean_errors(views, cloud, starts, lengths),
            track_offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.uint64),
            track_image_ids=image_ids[cloud.views[by_point]],
            track_point2d_ids=in_image[by_point].astype(np.uint32),
        ),
    )


def _mean_errors(views: list[View], cloud: Cloud, starts: Ints, lengths: Ints) -> Doubles:
    errors = np.empty(len(cloud.views))
    for i, view in enumerate(views):
        rows = slice(starts[i], starts[i + 1])
        projected, _ = view.project(cloud.positions[cloud.points[rows]])
        errors[rows] = np.linalg.norm(projected - cloud.pixels[rows], axis=1)
    return np.bincount(cloud.points, errors, len(cloud.positions)) / np.maximum(lengths, 1)


ARGUMENTS = f"""
out DIR  folder to create; if it has a part of the same city, only the rest is made
--preset {"|".join(PRESETS)}  city that the other flags change (default: %(default)s): {
    "; ".join(f"{name}, {o.views:,} views of {o.width} x {o.height}" for name, o in PRESETS.items())
}
--processes N  number of processes (default: one for each core)
--overwrite  replace another generated city in this folder
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command `blitzgs synth`."""
    types = {"--processes": int}
    parser = add_command(commands, "synth", run, summary, None, ARGUMENTS, types, preset="demo")
    for field in fields(CityOptions):
        flag, kind = f"--{field.name.replace('_', '-')}", type(field.default)
        how: dict[str, Any] = {"type": kind, "metavar": "N" if kind is int else "X"}
        if kind is bool:
            how = {"action": argparse.BooleanOptionalAction}
        parser.add_argument(flag, help=field.metadata["help"], **how)


def run(args: argparse.Namespace) -> None:
    """Generate the city. Raises what `generate_city` raises."""
    given = {field.name: getattr(args, field.name) for field in fields(CityOptions)}
    chosen = asdict(PRESETS[args.preset]) | {name: v for name, v in given.items() if v is not None}
    started = time.monotonic()
    how = {"processes": args.processes, "overwrite": args.overwrite}
    with image_progress("Photographing the city") as progress:
        out = generate_city(args.out, **chosen, **how, progress=progress)
    size = f"{chosen['views']} images of {chosen['width']} x {chosen['height']}"
    print(f"{out}: {size}, {time.monotonic() - started:.1f} s")
