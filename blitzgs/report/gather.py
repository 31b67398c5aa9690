# SPDX-License-Identifier: Apache-2.0
"""Reads what a page shows of a run from the files in its folder."""

from __future__ import annotations

import base64
import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, TypeVar

import numpy as np

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.world import GEOCENTRIC, WorldFrame
from blitzgs.runs import run_files
from blitzgs.runs.cameras import RunCameras, load_cameras
from blitzgs.runs.checkpoint_files import DAMAGE
from blitzgs.runs.evaluation import FOLDER, INDEX, METRICS, PARTS, preview_file
from blitzgs.runs.folder import RunFolder, open_run
from blitzgs.runs.world import load_world_frame
from blitzgs.view.views import up_direction
from blitzgs.viewer.world import horizontal

T = TypeVar("T")
Point = tuple[float, float | None, float]
# A curve has at most this many points: means of its records.
MAX_POINTS = 500
# Training cameras of the plan, and photographs with a listed exposure, at most; they are then evenly spaced.
MAX_LISTED = 20_000
_MAX_WARNINGS, _MAX_TEXT, _MAX_NAME = 200, 2000, 200
_CURVES = ("loss", "psnr", "gaussians", "images_per_second", "memory_bytes")
_POPULATION_EVENTS = (None, "densify", "pass_1", "pass_2")
# An integer of JSON may be larger than any float.
_LARGEST = sys.float_info.max
# Keys of the start's record that do not describe the environment.
_NO_ENVIRONMENT = ("t", "run", "event", "origin", "train", "test")


@dataclass
class RunData:
    """What is known of a run."""

    folder: RunFolder
    summary: dict[str, Any]  # `summary.json`; empty while the run is not finished
    log: list[dict[str, Any]]  # records of the newest run in the folder, oldest first
    cameras: RunCameras | None  # all cameras, or None if the file is missing or damaged
    measured: Path | None  # folder of the newest evaluation of the held-out views, or None
    views: dict[str, dict[str, float]]  # metrics of each view, by its name
    problems: list[str] = field(default_factory=list)  # what could not be read, as sentences
    frame: WorldFrame | None = None  # where the capture lies in the world

    @property
    def figures(self) -> dict[str, float]:
        """The numbers of the summary."""
        return {name: value for name, value in self.summary.items() if isinstance(value, (int, float))}


def read_run(path: Path) -> RunData:
    """Read a run (FileNotFoundError: it is none); damaged files are left out, and named in `problems`."""
    folder = open_run(path)
    data = RunData(folder, {}, [], None, None, {})
    try:
        data.summary = _mapping(folder.summary())
    except ValueError as error:
        data.problems.append(f"{error}.")
    records = [record for record in folder.log() if _is_number(record.get("t"))]
    identity = _start_of(records).get("run")
    data.log = [record for record in records if record.get("run") == identity]
    try:
        if (path / run_files.CAMERAS).exists():
            data.cameras = load_cameras(path)
        data.frame = load_world_frame(path)
    except ValueError as error:
        data.problems.append(f"{error}.")
    files = (path / run_files.EVALUATION).glob("*/metrics.json")
    if found := [file for file in files if re.fullmatch(r"\d+|test", file.parent.name)]:
        newest = max(found, key=lambda file: file.stat().st_mtime)
        data.measured, data.views = newest.parent, _views_of(newest, data.problems)
    return data


def metrics_of(views: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the metrics that a run's views have."""
    return [metric for metric in METRICS if any(metric in view for view in views.values())]


def curves(data: RunData) -> dict[str, list[Point]]:
    """Return the curves of the log by name: (images, seconds of training or None, value)."""
    found: dict[str, list[Point]] = {name: [] for name in (*_CURVES, "held_out")}
    seconds: float | None = 0.0
    for record in data.log:
        kind, t = record.get("event"), float(record["t"])
        if kind is None:
            seconds = float(record["seconds"]) if _is_number(record.get("seconds")) else None
        for name in _CURVES:
            kinds = _POPULATION_EVENTS if name == "gaussians" else (None,)
            if kind in kinds and _is_number(record.get(name)):
                found[name].append((t, seconds, float(record[name])))
        is_held_out = kind in ("glance", "evaluation") and record.get("split") != "train"
        if is_held_out and _is_number(record.get("psnr")):
            found["held_out"].append((t, seconds, float(record["psnr"])))
    return {name: _thinned(points) for name, points in found.items()}


def _thinned(points: list[Point]) -> list[Point]:
    """Return means over stretches of a curve, with five digits."""
    size = max(1, math.ceil(len(points) / MAX_POINTS))
    found: list[Point] = []
    for part in (points[k : k + size] for k in range(0, len(points), size)):
        t, seconds, _ = part[-1]
        found.append((t, None if seconds is None else round(seconds, 1), digits(fmean(p[2] for p in part))))
    return found


def warnings_of(data: RunData) -> list[tuple[float, str, str]]:
    """Return (images, kind, text) of the log's warnings and hints, each text once."""
    found: dict[tuple[str, str], float] = {}
    for record in data.log:
        kind = record.get("event")
        if kind == "worst views":
            continue
        for name in ("warning", "hint", "reason"):
            if isinstance(text := record.get(name), str):
                label = "warning" if name == "warning" else str(kind)
                found.setdefault((label, text[:_MAX_TEXT]), float(record["t"]))
    return [(t, kind, text) for (kind, text), t in found.items()][:_MAX_WARNINGS]


def environment(data: RunData) -> dict[str, object]:
    """Return where the run was trained: versions, device, transport."""
    start = _start_of(data.log)
    found = {name: value for name, value in start.items() if name not in _NO_ENVIRONMENT}
    found |= _mapping(data.summary.get("versions"))
    found |= {f"{name} views": start[name] for name in ("train", "test") if name in start}
    return found | {"run": data.summary.get("run", "")}


def _start_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the record of the newest start; empty: there is none."""
    return next((record for record in reversed(records) if record.get("event") == "start"), {})


def plan(data: RunData) -> dict[str, Any] | None:
    """Return the cameras from above: (x, y, held out, PSNR or None, name) of each.

    In metres where GPS gave the world, else in the capture's unit.
    """
    cameras = data.cameras
    if cameras is None or not cameras.cameras:
        return None
    poses = [np.asarray(camera.world_to_camera, dtype=np.float64) for camera in cameras.cameras]
    flat = camera_centres(np.stack(poses)) @ np.stack(horizontal(up_direction(poses)), axis=1)
    metres = data.frame is not None and data.frame.crs == GEOCENTRIC
    if data.frame is not None and metres:
        flat *= data.frame.scale
    step = max(1e-9, float(np.ptp(flat, axis=0).max())) / 5000
    decimals = max(0, math.ceil(-math.log10(step)))
    others = _other_views(data)
    known = {name: view["psnr"] for name, view in (others | data.views).items() if "psnr" in view}
    held = set(cameras.test)
    train = evenly([index for index in range(len(poses)) if index not in held], MAX_LISTED)
    points = []
    for index in sorted({*train, *held}):
        name = cameras.cameras[index].name
        psnr = round(known[name], 2) if name in known else None
        points.append((*flat[index].round(decimals).tolist(), int(index in held), psnr, short_name(name)))
    measured = bool(train) and all(cameras.cameras[index].name in known for index in train)
    return {"points": points, "trained_known": measured, "unit": "m" if metres else "unit"}


def other_cameras(first: RunCameras | None, second: RunCameras | None) -> str:
    """Return what of a second run's cameras is not as the first's, in words; empty: all is, or unknown."""
    if first is None or second is None:
        return ""
    found, other = ({camera.name: camera for camera in run.cameras} for run in (first, second))
    held = [{run.cameras[index].name for index in run.test} for run in (first, second)]
    both = [(found[name], other[name]) for name in found if name in other]
    differs = {
        "photographs": found.keys() != other.keys(),
        "held-out views": held[0] != held[1],
        "sizes of images": any((a.width, a.height) != (b.width, b.height) for a, b in both),
        "poses": not all(np.allclose(a.world_to_camera, b.world_to_camera, atol=1e-6) for a, b in both),
    }
    return ", ".join(name for name, is_other in differs.items() if is_other)


def _other_views(data: RunData) -> dict[str, dict[str, float]]:
    """Return the metrics of training views, of the run's end and of `blitzgs eval --split train` or `all`."""
    found: dict[str, dict[str, float]] = {}
    folder = data.folder.path / run_files.EVALUATION
    for file in (
        *sorted(folder.glob(f"*/{run_files.TRAINED_VIEWS}")),
        *(folder / split / "metrics.json" for split in ("all", "train")),
    ):
        found |= _views_of(file, data.problems)
    return found


def exposures(data: RunData) -> list[list[Any]]:
    """Return [name, gain R, G, B, bias R, G, B] of the training photographs; empty without exposures."""

    def listed(content: Any) -> list[list[Any]]:
        rows = [
            [short_name(str(name)), *(float(part) for row in values for part in row)]
            for name, values in content.items()
        ]
        if any(len(row) != 7 for row in rows):
            raise ValueError("an exposure has another number of values")
        return [rows[index] for index in evenly(list(range(len(rows))), MAX_LISTED)]

    return _parsed(data.folder.path / run_files.EXPOSURES, data.problems, listed, [])


def pictured(data: RunData) -> dict[str, int]:
    """Return the cameras of the newest evaluation that have previews, by the names of their views."""
    if data.measured is None or data.cameras is None:
        return {}
    cameras, views = data.cameras.cameras, data.views

    def known(indices: Any) -> dict[str, int]:
        return {cameras[index].name: index for index in indices if cameras[index].name in views}

    return _parsed(data.measured / FOLDER / INDEX, data.problems, known, {})


def layers(data: RunData, index: int) -> dict[str, str] | None:
    """Return the previews of a camera as data addresses by their parts; None if one is missing."""
    found = {}
    for part in PARTS:
        try:
            content = preview_file(data.measured / FOLDER, index, part).read_bytes()  # type: ignore[operator]
        except OSError:
            return None
        found[part] = "data:image/webp;base64," + base64.b64encode(content).decode()
    return found


def stages(data: RunData) -> dict[str, float]:
    """Return the seconds of the stages of the training."""
    found = _mapping(data.summary.get("stages"))
    return {str(name): round(value, 2) for name, value in found.items() if isinstance(value, (int, float))}


def subtitle(data: RunData) -> str:
    """Return a line below the title."""
    state = "finished" if data.summary else "not finished"
    made = time.strftime("%Y-%m-%d %H:%M")
    return f"{data.folder.path.resolve()} · {state} · written {made} by blitzgs"


def rows_of(views: Mapping[str, Mapping[str, float]], metrics: Sequence[str]) -> Iterator[list[Any]]:
    """Yield [name, value of each metric or None] of each view."""
    for name, view in views.items():
        yield [short_name(name), *(digits(view[metric], 6) if metric in view else None for metric in metrics)]


def evenly(values: list[int], most: int) -> list[int]:
    """Return at most so many of some values, evenly spaced."""
    return [values[k * len(values) // most] for k in range(most)] if len(values) > most else values


def short_name(name: str) -> str:
    """Return a name that is not too long for a page."""
    return name if len(name) <= _MAX_NAME else f"{name[: _MAX_NAME // 2]}…{name[-_MAX_NAME // 2 :]}"


def digits(value: float, count: int = 5) -> float:
    """Return a number with so many digits."""
    return float(f"{value:.{count}g}")


def _views_of(file: Path, problems: list[str]) -> dict[str, dict[str, float]]:
    def numbers(content: Any) -> dict[str, dict[str, float]]:
        return {
            str(name): {metric: float(value) for metric, value in view.items() if _is_number(value)}
            for name, view in content["views"].items()
        }

    return _parsed(file, problems, numbers, {})


def _parsed(path: Path, problems: list[str], convert: Callable[[Any], T], missing: T) -> T:
    """Return what is made of a JSON file; `missing` if there is none, or if it is damaged, which is noted."""
    try:
        return convert(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return missing
    except DAMAGE as error:
        problems.append(f"{path} is damaged ({error}).")
        return missing


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _LARGEST
