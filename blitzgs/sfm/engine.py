# SPDX-License-Identifier: Apache-2.0
"""Runs the stages of a reconstruction in processes of their own, and reads COLMAP's database."""

from __future__ import annotations

import importlib.util
import json
import re
import shutil
import sqlite3
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.capture.colmap import Float64, read_model
from blitzgs.util.errors import warn
from blitzgs.util.progress import Report

_PAIR_IDS = 2147483647  # the id of a pair of images a < b is this number times a, plus b


@dataclass(frozen=True)
class Found:
    """What was found in a photograph: features, and verified matches with other photographs."""

    features: int = 0
    matches: int = 0
    neighbours: int = 0


def _rows(database: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


def read_found(database: Path) -> dict[str, Found]:
    """Return what was found in each photograph, by name."""
    features = dict(_rows(database, "SELECT image_id, rows FROM keypoints"))
    matches: dict[int, list[int]] = defaultdict(list)
    for pair, count in _rows(database, "SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0"):
        for image in (pair // _PAIR_IDS, pair % _PAIR_IDS):
            matches[image].append(count)
    images = _rows(database, "SELECT image_id, name FROM images")
    return {name: Found(features.get(i, 0), sum(matches[i]), len(matches[i])) for i, name in images}


def read_positions(database: Path) -> dict[str, Float64]:
    """Return the positions by GPS, by name: latitude, longitude in degrees and altitude in metres [3].

    They are metres east, north and up once pycolmap has used them.
    """
    query = "SELECT name, position FROM pose_priors JOIN images ON image_id = corr_data_id"
    try:
        rows = _rows(database, query)
    except sqlite3.OperationalError:  # the table of a COLMAP before 4.0 has other columns
        return {}
    positions = {name: np.frombuffer(blob) for name, blob in rows if blob and len(blob) == 24}
    return {name: position for name, position in positions.items() if np.isfinite(position[:2]).all()}


def lack_places(database: str, names: Sequence[str]) -> bool:
    """Tell whether some photographs have no place by GPS: they have no neighbours by it."""
    return not set(names) <= read_positions(Path(database)).keys()


def camera_of(database: Path, names: Sequence[str]) -> int | None:
    """Return the camera that an interrupted stage gave to one of the photographs, or None."""
    known = dict(_rows(database, "SELECT name, camera_id FROM images")) if database.exists() else {}
    return next((known[name] for name in names if name in known), None)


STAGES = {"features": "features", "pairs": "matches", "cameras": "poses"}
# What COLMAP prints as it goes on: photographs or blocks of pairs and their total, or poses found.
_STEP = re.compile(r"\[(\d+)/(\d+)(?:, (\d+)/(\d+))?\]")
_POSES = re.compile(r"num_reg_frames=(\d+)")
_MATCHERS = {"gps": "spatial", "sequence": "sequential", "exhaustive": "exhaustive"}
# Photographs up to which every pair is matched, and poses are found one after the other.
MOST_IN_ALL_PAIRS, _MOST_ONE_BY_ONE = 300, 500
# Photographs without a place, among others with one, are compared with so many that follow by name.
LIKE_NAMES = 10
# Photographs of a camera that determine a full lens.
MANY = 15
# Bytes; with fewer, a failure may be that of the disk.
_LEAST_SPACE = 50e6
MISSING = (
    "COLMAP finds out where photographs were taken from, and it is not installed: pip install 'blitzgs[sfm]' "
    "(pycolmap; with an NVIDIA GPU also pycolmap-cuda12), or install the program colmap"
)


@dataclass(frozen=True)
class Job:
    """What the stages need to know; the fields are paths as text, and what was decided."""

    database: str
    photos: str
    masks: str
    models: str
    georeference: str
    names: list[str]
    sizes: list[tuple[int, int]]
    camera_model: str
    pairs: str
    mapper: str
    gps: bool = False
    use_altitude: bool = False


class StageError(ValueError):
    """COLMAP could not do a stage."""


def has_pycolmap() -> bool:
    """Tell whether pycolmap is installed."""
    return importlib.util.find_spec("pycolmap") is not None


def backend() -> str:
    """Return "pycolmap", or the path of the program `colmap` (ImportError: neither is installed)."""
    if has_pycolmap():
        return "pycolmap"
    if (program := shutil.which("colmap")) is None:
        raise ImportError(MISSING)
    return program


def run_stage(stage: str, job: Job, log: Path, lock: int, report: Report) -> None:
    """Do a stage of `STAGES`; what COLMAP says is added to the file `log`, its last words are a StageError.

    Its processes hold the locked file `lock`, a descriptor, until they end.
    """
    program = backend()
    Path(job.models).mkdir(parents=True, exist_ok=True)
    if program == "pycolmap":
        run_pycolmap(stage, asdict(job), log, lock, report, len(job.names))
        return
    for command in _commands(program, stage, job):
        try:
            _run(command, log, lock, report, len(job.names))
        except StageError as error:
            if "bundle_adjuster" not in command:
                raise
            shutil.rmtree(command[command.index("--output_path") + 1])  # `adopt` keeps the model before
            warn(
                f"the principal point stays in the middle of the photographs, as refining it failed: {error}"
            )


def run_pycolmap(
    stage: str, job: dict[str, Any], log: Path, lock: int, report: Report, photographs: int | None = None
) -> None:
    """Do a stage of `blitzgs.sfm.pycolmap_stage`; `report` gets its rounds if it knows no `photographs`."""
    file = log.with_name("job.json")  # thousands of names are too long for an argument
    file.write_text(json.dumps({"stage": stage, **job}))
    _run([sys.executable, "-m", "blitzgs.sfm.pycolmap_stage", str(file)], log, lock, report, photographs)


def _run(command: list[str], log: Path, lock: int, report: Report, photographs: int | None = None) -> None:
    last = ""
    with (
        log.open("a", buffering=1, encoding="utf-8") as file,
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            pass_fds=[lock],
        ) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                file.write(line)
                last = line.strip() or last
                _progress(line, photographs, report)
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        how = f"signal {-process.returncode}" if process.returncode < 0 else f"status {process.returncode}"
        why, free = "", shutil.disk_usage(log.parent).free
        if process.returncode == -9:
            why = " (the memory may not suffice: use smaller photographs)"
        elif free < _LEAST_SPACE:
            why = f" (the disk is nearly full: {free / 1e6:.1f} MB are free)"
        raise StageError(f"COLMAP ended with {how}{why}: {last} ({log} has all that it said)")


def _progress(line: str, photographs: int | None, report: Report) -> None:
    if photographs is not None and (found := _POSES.search(line)):
        report(int(found[1]), photographs)
    elif found := _STEP.search(line):
        done, total, inner, inners = (int(number or 1) for number in found.groups())
        whole = photographs or total
        report(whole * ((done - 1) * inners + inner) // (total * inners), whole)


def _commands(program: str, stage: str, job: Job) -> Iterator[list[str]]:
    """Yield the commands of a stage for the program `colmap`, from 3.8 on."""
    base = ["--database_path", job.database]
    if stage == "features":
        gpu = _gpu_flags(program, "feature_extractor")
        for names in _groups(job):
            listed = Path(job.models) / "photographs.txt"
            listed.write_text("\n".join(names) + "\n", encoding="utf-8")
            reader = ["--ImageReader.camera_model", lens_model(job.camera_model, len(names))]
            reader += ["--ImageReader.single_camera", "1"]
            if (known := camera_of(Path(job.database), names)) is not None:
                reader += ["--ImageReader.existing_camera_id", str(known)]
            if job.masks:
                reader += ["--ImageReader.mask_path", job.masks]
            paths = ["--image_path", job.photos, "--image_list_path", str(listed)]
            yield [program, "feature_extractor", *base, *paths, *reader, *gpu]
    elif stage == "pairs":
        matcher = _MATCHERS[job.pairs]
        far = ["--SpatialMatching.max_distance", "1e9"] if job.pairs == "gps" else []
        yield [program, f"{matcher}_matcher", *base, *far, *_gpu_flags(program, f"{matcher}_matcher")]
        if job.pairs == "gps" and lack_places(job.database, job.names):
            overlap = ["--SequentialMatching.overlap", str(LIKE_NAMES)]
            gpu = _gpu_flags(program, "sequential_matcher")
            yield [program, "sequential_matcher", *base, *overlap, *gpu]
    else:
        mapper = (
            "global_mapper"
            if job.mapper == "global" and "global_mapper" in _help(program, "help")
            else "mapper"
        )
        paths = ["--image_path", job.photos, "--output_path", job.models]
        least = ["--Mapper.min_model_size", str(least_model(len(job.names)))] if mapper == "mapper" else []
        yield [program, mapper, *base, *paths, *least]
        if min(map(len, _groups(job))) >= MANY:  # as `pycolmap_stage._centre_lenses`
            for folder in sorted(Path(job.models).glob("[0-9]*")):
                (refined := folder.with_name("refined")).mkdir(exist_ok=True)
                paths = ["--input_path", str(folder), "--output_path", str(refined)]
                yield [program, "bundle_adjuster", *paths, "--BundleAdjustment.refine_principal_point", "1"]
                adopt(refined, folder)


def adopt(refined: Path, folder: Path) -> None:
    """Move a refined model, if there is one, to its place if its error is less by a tenth.

    Else the lens is centred, or the photographs do not determine it: its axis then goes anywhere, and the
    focal length with it.
    """
    if not refined.exists():
        return
    if read_model(refined).points.errors.mean() < 0.9 * read_model(folder).points.errors.mean():
        shutil.copytree(refined, folder, dirs_exist_ok=True)
    shutil.rmtree(refined)


def _groups(job: Job) -> list[list[str]]:
    """Return the photographs of each camera, without EXIF: those of one size and folder."""
    groups: dict[tuple[tuple[int, int], Path], list[str]] = defaultdict(list)
    for name, size in zip(job.names, job.sizes, strict=True):
        groups[size, Path(name).parent].append(name)
    return list(groups.values())


def _help(program: str, command: str) -> str:
    result = subprocess.run(
        [program, command, *(["-h"] if command != "help" else [])], capture_output=True, text=True
    )
    return result.stdout + result.stderr


def _gpu_flags(program: str, command: str) -> list[str]:
    """Return the flag that keeps a `colmap` without CUDA from looking for a display."""
    if "with CUDA" in _help(program, "help"):
        return []
    names = re.findall(r"--((?:Feature|Sift)(?:Extraction|Matching)\.use_gpu)", _help(program, command))
    return [f"--{names[0]}", "0"] if names else []


def decided(job: Job, gps: bool, use_altitude: bool) -> Job:
    """Return the job with what "auto" means for its photographs.

    `gps`: their positions tell neighbours apart; pycolmap also uses them for poses, with altitudes if these
    can be used. ValueError: the user wants neighbours by GPS, and there are none.
    """
    if job.pairs == "gps" and not gps:
        raise ValueError(
            "--pairs gps: fewer than 9 of 10 photographs have GPS in EXIF, or all are within 30 metres; "
            "leave it out, or choose sequence or exhaustive"
        )
    count = len(job.names)
    found = "gps" if gps else "exhaustive" if count <= MOST_IN_ALL_PAIRS else "sequence"
    pairs = found if job.pairs == "auto" else job.pairs
    mapper = (
        ("incremental" if count <= _MOST_ONE_BY_ONE else "global") if job.mapper == "auto" else job.mapper
    )
    prior = gps and backend() == "pycolmap"
    return replace(job, pairs=pairs, mapper=mapper, gps=prior, use_altitude=prior and use_altitude)


def least_model(photographs: int) -> int:
    """Return how many photographs make a model: COLMAP's 10, but fewer of few."""
    return min(10, max(3, photographs // 2))


def lens_model(wanted: str, photographs: int) -> str:
    """Return the camera model for a camera that took so many photographs: many determine a full lens."""
    if wanted != "auto":
        return wanted
    return "OPENCV" if photographs >= MANY else "SIMPLE_RADIAL"
