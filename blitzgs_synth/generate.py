# SPDX-License-Identifier: Apache-2.0
"""Writes a synthetic city as a capture: images, COLMAP model and manifest."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from blitzgs.capture.colmap import FILES, read_model, write_model
from blitzgs.util.output import PARTIAL, write_file
from blitzgs_synth.dataset import colmap_model
from blitzgs_synth.flight import plan_flight
from blitzgs_synth.options import CityOptions
from blitzgs_synth.photographs import CORNERS, Progress, take_photographs
from blitzgs_synth.plan import Plan
from blitzgs_synth.processes import each
from blitzgs_synth.render import City
from blitzgs_synth.tracks import track

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
    metres, z up) and `city.json` (the parameters). The folder appears only when complete. Until then the
    files are in `.NAME.partial` beside it, and after an interruption the same call continues there. The
    files depend on the parameters alone, not on processes or interruptions. On another processor or with
    other library versions, single pixels may differ by rounding.

    Args:
        out: folder to create.
        processes: number of processes that render; None: one for each core that this process may use.
        overwrite: replace a city with other parameters instead of raising.
        progress: called after each image.
        **parameters: fields of `CityOptions`; the others have its defaults.

    Returns:
        `out`, ready to be trained on.

    Raises:
        TypeError, ValueError: a parameter is unknown, or out of range.
        FileExistsError: `out` holds something else, or another process is making it.
        BrokenProcessPool: the system ended one of the processes, for example because memory ran out.
        ModuleNotFoundError: `embreex` is not installed.
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
    descriptor = os.open(partial / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
    except BlockingIOError as error:
        raise FileExistsError(f"{partial}: another process is making this city; wait for it") from error
    finally:
        os.close(descriptor)


def _reusable(out: Path, options: CityOptions, overwrite: bool) -> bool:
    """Return whether `out` holds this city; raise if it holds files that must not be replaced."""
    if not out.exists():
        return False
    if not out.is_dir():
        raise FileExistsError(f"{out} is a file; choose a folder for the city")
    if not any(out.iterdir()):
        return False
    if not (out / MANIFEST).exists():
        raise FileExistsError(f"{out} has files but no generated city; choose another folder")
    try:
        found = json.loads((out / MANIFEST).read_text())
        if not isinstance(found, dict):
            raise ValueError("not a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        raise FileExistsError(
            f"{out} holds no generated city ({MANIFEST}: {error}); choose another folder"
        ) from error
    wanted = options.manifest()
    different = [
        f"{key} {found.get(key)}, not {value}" for key, value in wanted.items() if found.get(key) != value
    ]
    if different and not overwrite:
        raise FileExistsError(
            f"{out} holds another city ({'; '.join(different)}); choose another folder, or --overwrite it"
        )
    if different:
        _check_no_others(out)
    return not different


def _check_no_others(out: Path) -> None:
    """Check that the folders of a city, which are replaced as a whole, have no other files."""
    sparse = out / "sparse" / "0"
    own = {sparse / f"{name}.bin" for name in FILES}
    if all(path.is_file() for path in own):
        own |= {out / "images" / name for name in read_model(sparse).images.names}
    for folder in _FOLDERS:
        for path in sorted((out / folder).rglob("*")):
            if path not in own and not path.is_dir():
                raise FileExistsError(f"{path} is no part of the city, and would be lost: move it elsewhere")


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
