# SPDX-License-Identifier: Apache-2.0
"""Makes a capture of photographs: stages that are kept, so that an interrupted reconstruction goes on.

The folder `sfm/` of the capture has COLMAP's database, its messages, what is finished, and the report.
"""

from __future__ import annotations

import json
import shutil
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.capture.colmap import FILES, count_images
from blitzgs.capture.fields import read_small
from blitzgs.capture.world import GEO, enu_frame
from blitzgs.sfm.engine import (
    STAGES,
    Job,
    StageError,
    backend,
    decided,
    read_found,
    read_positions,
    run_stage,
)
from blitzgs.sfm.photographs import Photographs, judge_positions
from blitzgs.sfm.report import Reconstruction, examine
from blitzgs.util.output import check_outside, locked, write_file
from blitzgs.util.progress import image_progress

PAIRS = ("auto", "gps", "sequence", "exhaustive")
MAPPERS = ("auto", "incremental", "global")
WORK = "sfm"
_STATE = "state.json"
_SOURCE = "GPS of the photographs"


@dataclass(frozen=True)
class Settings:
    """How to reconstruct; see `blitzgs sfm --help`."""

    pairs: str = "auto"
    mapper: str = "auto"
    camera_model: str = "auto"


def is_finished(capture: Path) -> bool:
    """Tell whether `reconstruct` finished a capture."""
    return (capture / WORK / "report.json").is_file()


def at_work(folder: Path) -> AbstractContextManager[int]:
    """Return what keeps others out of the folder `WORK` of a capture; COLMAP's processes hold it too."""
    return locked(folder / "lock", f"another blitzgs sfm is at work in {folder}: wait for its end")


def reconstruct(photographs: Photographs, capture: Path, settings: Settings) -> Reconstruction:
    """Find the poses of photographs and write a capture, whose `images` is a link to their folder.

    Stages that an earlier call finished for the same photographs and settings are left out. New photographs
    are added to what is there; after any other change the work begins anew. Nothing in the capture that
    another program wrote is replaced (FileExistsError). BlockingIOError: another process is at it.
    ValueError: no poses were found, or the capture is in the folder of the photographs.
    """
    backend()
    folder = photographs.folder
    check_outside(capture, folder)
    work = capture / WORK
    if not (work / _STATE).is_file() and (capture / "sparse").exists():
        raise FileExistsError(
            f"{capture} has a model that blitzgs sfm did not make: choose another folder for the capture"
        )
    links = _links(photographs, capture)
    work.mkdir(parents=True, exist_ok=True)
    make_links(links)
    with at_work(work) as lock:
        state = _state(work, photographs, settings)
        masks = photographs.write_masks(work / "masks")
        paths = [str((work / name).absolute()) for name in ("database.db", "models", "georeference.json")]
        job = Job(
            database=paths[0],
            photos=str(folder.absolute()),
            masks=str(masks.absolute()) if masks else "",
            models=paths[1],
            georeference=paths[2],
            names=photographs.names,
            sizes=photographs.sizes,
            **asdict(settings),
        )
        for stage, what in STAGES.items():
            if stage == "pairs":
                if "gps" not in state:
                    places = np.array(list(read_positions(Path(job.database)).values())).reshape(-1, 3)
                    state["gps"], state["altitude"] = judge_positions(places, len(job.names))
                job = decided(job, state["gps"], state["altitude"])
            if stage not in state["finished"]:
                if stage == "cameras":
                    shutil.rmtree(job.models, ignore_errors=True)
                with image_progress(what) as report:
                    run_stage(stage, job, work / "colmap.log", lock, report)
                state["finished"].append(stage)
                write_file(work / _STATE, json.dumps(state))
        models = sorted(Path(job.models).glob("[0-9]*"), key=count_images, reverse=True)
        if not models or not count_images(models[0]):
            raise StageError(_no_poses(photographs, work))
        _write_model(models[0], capture)
        _write_frame(Path(job.georeference), capture / GEO)
        return examine(capture, work, photographs, job, models)


def _no_poses(photographs: Photographs, work: Path) -> str:
    found = read_found(work / "database.db").values()
    features = float(np.median([photograph.features for photograph in found])) if found else 0.0
    alike = sum(one.neighbours > 0 for one in found)
    return (
        f"no poses were found for the {len(photographs.names)} photographs of {photographs.folder}: they "
        f"have {features:,.0f} features (median), and {alike} of them show what another shows; are they "
        f"sharp, and from places apart? ({work / 'colmap.log'} says more)"
    )


def _state(work: Path, photographs: Photographs, settings: Settings) -> dict[str, Any]:
    """Return what is finished; without what a change of photographs or settings makes invalid."""
    identity, chosen = photographs.identity(), asdict(settings)
    path = work / _STATE
    before = json.loads(path.read_text()) if path.exists() else {}
    if not before:
        before = {"photographs": identity, "settings": chosen, "finished": []}
    old = before["photographs"]
    (work / "report.json").unlink(missing_ok=True)
    if any(identity.get(name) != stamp for name, stamp in old.items()) or (
        chosen["camera_model"] != before["settings"]["camera_model"]
    ):
        for name in ("database.db", "database.db-wal", "database.db-shm", "georeference.json"):
            (work / name).unlink(missing_ok=True)
        shutil.rmtree(work / "masks", ignore_errors=True)
        before = {"finished": []}
    elif len(identity) > len(old):
        before["finished"] = []
    elif chosen["pairs"] != before["settings"]["pairs"]:
        before["finished"] = [stage for stage in before["finished"] if stage == "features"]
    elif chosen["mapper"] != before["settings"]["mapper"]:
        before["finished"] = [stage for stage in before["finished"] if stage != "cameras"]
    state = {**before, "photographs": identity, "settings": chosen}
    write_file(path, json.dumps(state))
    return state


def _links(photographs: Photographs, capture: Path) -> dict[Path, Path]:
    """Return the links of a capture to photographs and their masks (FileExistsError: one is another file)."""
    folder = photographs.folder
    links = {capture / "images": folder}
    if any(photographs.masks):
        roots = (root / "masks" for root in (folder, folder.parent))
        links[capture / "masks"] = next(root for root in roots if root.is_dir())
    for link, target in links.items():
        if link.exists() and not link.samefile(target):
            raise FileExistsError(f"{link} is not {target}: choose another folder for the capture")
    return links


def make_links(links: dict[Path, Path]) -> None:
    """Make links, before the work of hours: some disks (exFAT) cannot hold any (OSError)."""
    for link, target in links.items():
        if link.exists():
            continue
        link.unlink(missing_ok=True)
        try:
            link.symlink_to(target.resolve())
        except OSError as error:
            raise OSError(
                f"{link} cannot be a link to {target} ({error.strerror}): choose a capture on a disk of Linux"
            ) from error


def _write_model(model: Path, capture: Path) -> None:
    sparse = capture / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        write_file(sparse / f"{name}.bin", (model / f"{name}.bin").read_bytes())


def _write_frame(origin: Path, path: Path) -> None:
    """Write the place of the capture in the world where GPS gave its origin; keep what a user has written."""
    if not origin.exists() or (path.exists() and _SOURCE not in read_small(path)):
        return
    place = json.loads(origin.read_text())
    frame = enu_frame(place["latitude"], place["longitude"], place["altitude"], _SOURCE)
    write_file(path, json.dumps(frame.as_json(), indent=1))
