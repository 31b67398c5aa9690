# SPDX-License-Identifier: Apache-2.0
"""The report of one run, and runs side by side: HTML files that need no network.

Whatever comes from a run's files is passed to the script as JSON, which makes text of it: names of
photographs and warnings may hold anything.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.config.files import flat, to_dict
from blitzgs.distributed.group import Ranks
from blitzgs.formats.web_page import as_html, check_replaces_page
from blitzgs.report import gather
from blitzgs.report.gather import RunData, read_run
from blitzgs.runs import run_files
from blitzgs.runs.evaluation import METRICS
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.web import web_file

MAX_BYTES = 10_000_000
_ROOM_FOR_NOTES = 1000


def page(
    title: str, scripts: tuple[str, ...], data: Mapping[str, Any], look: Mapping[str, str] | None = None
) -> str:
    """Return a page of some scripts of `assets` and their data; numbers that JSON lacks become null.

    `look` has "html", a page with the model in 3D, and "note", a sentence about it; None: there is none.
    """
    assets = files("blitzgs.report") / "assets"
    values = {
        "@TITLE@": as_html(title),
        "@SCRIPT@": "\n".join((assets / name).read_text(encoding="utf-8") for name in scripts),
        "@DATA@": _json(data),
        "@LOOK@": _json(look),
    }
    # Split first, so that nothing in a value is taken for a place.
    parts = re.split("(@[A-Z]+@)", (assets / "page.html").read_text(encoding="utf-8"))
    return "".join(values.get(part, part) for part in parts)


def fitted(
    title: str, scripts: tuple[str, ...], data: dict[str, Any], look: Mapping[str, str] | None = None
) -> str:
    """Return a page of at most `MAX_BYTES`: the look in 3D is left out first, then pictures; it says so."""
    pictures, notes = data["pictures"], list(data["left_out"])
    room = MAX_BYTES - _ROOM_FOR_NOTES - len(page(title, scripts, data | {"pictures": []}).encode())
    if room < 0:
        raise ValueError(f"the page would have more than {MAX_BYTES / 1e6:g} MB without any picture")
    sizes = np.cumsum([0, *(len(_json(picture)) + 1 for picture in pictures)])
    if look is not None and sizes[-1] + len(_json(look)) > room:
        look = None
        notes.append("The model in 3D is left out to keep this file small.")
    fitting = int((sizes <= room).sum()) - 1
    if fitting < len(pictures):
        notes.append(f"{len(pictures) - fitting} pictures are left out to keep this file small.")
    return page(title, scripts, data | {"pictures": pictures[:fitting], "left_out": notes}, look)


def write_page(path: Path, text: str) -> None:
    """Write a page (FileExistsError: the file exists and is no page of ours)."""
    check_replaces_page(path)
    write_file(path, text, sync=False)


def _json(value: object) -> str:
    # "<" cannot end the script element that holds the text.
    return json.dumps(_finite(value), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return value


_SCRIPTS = ("parts.js", "report.js")
_SHOWN_EXTREMES = 4


def report(folder: Path, look: Mapping[str, str] | None = None) -> str:
    """Return the report of a run, which may be unfinished, as HTML of at most `MAX_BYTES`; see `page`."""
    data = read_run(folder)
    metrics = gather.metrics_of(data.views)
    content = {
        "name": folder.resolve().name,
        "subtitle": gather.subtitle(data),
        "summary": data.figures,
        "split": "test" if data.is_test else "train",
        "metrics": metrics,
        "views": list(gather.rows_of(data.views, metrics)),
        "pictures": _pictures(data),
        "curves": gather.curves(data),
        "stages": gather.stages(data),
        "cameras": gather.plan(data),
        "exposures": gather.exposures(data),
        "warnings": gather.warnings_of(data),
        "environment": gather.environment(data),
        "config": _text(folder / run_files.CONFIG),
        "left_out": data.problems,
    }
    return fitted(f"{content['name']} · report", _SCRIPTS, content, look)


def write_report(folder: Path, look: Mapping[str, str] | None = None, out: Path | None = None) -> Path:
    """Write the report of a run, into its folder if `out` is None; return the file."""
    path = out or folder / run_files.REPORT
    write_page(path, report(folder, look))
    return path


def _pictures(data: RunData) -> list[dict[str, Any]]:
    """Return the views with previews: the worst first, then the best, then others."""
    indices = gather.pictured(data)
    ordered = sorted(data.views, key=lambda name: data.views[name].get("psnr", 0.0))
    worst = ordered[: min(_SHOWN_EXTREMES, (len(ordered) + 1) // 2)]
    best = [name for name in ordered[::-1][:_SHOWN_EXTREMES] if name not in worst]
    others = [name for name in indices if name not in worst and name not in best]
    found = []
    for label, names in (("worst", worst), ("best", best), ("", others)):
        for name in names:
            layers = gather.layers(data, indices[name]) if name in indices else None
            if layers is None:
                continue
            psnr = data.views[name].get("psnr")
            note = " ".join(part for part in (label, "" if psnr is None else f"{psnr:.2f} dB") if part)
            shown = [{"label": part, "src": layers[part]} for part in ("photograph", "render", "error")]
            found.append({"name": gather.short_name(name), "note": note, "layers": shown})
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")[:200_000]
    except OSError as error:
        return str(error)


# Size of the model in the report.
LOOK_BYTES = 4_000_000


def look_of(folder: Path) -> dict[str, str]:
    """Return the newest model of a run as a page with its viewer ("html"), and what it lacks ("note").

    The checkpoint is read into host memory, with the optimiser's moments. FileNotFoundError and
    CheckpointError: there is no sound checkpoint. ValueError: the model has no visible Gaussian.
    """
    found = web_file(open_model(folder, Ranks()), LOOK_BYTES)
    note = f"{found.gaussians:,} of {found.of:,} Gaussians. {found.left_out}"
    if found.left_out:
        note += " blitzgs export RUN --html FILE writes more, blitzgs view RUN shows all."
    return {"html": found.text, "note": note}


_COMPARE_SCRIPTS = ("parts.js", "compare.js")
_MAX_PICTURED = 12


def compare(folders: Sequence[Path]) -> str:
    """Return a page that compares runs with the first, as HTML of at most `MAX_BYTES`."""
    if len(folders) < 2:
        raise ValueError("a comparison needs two runs or more")
    runs = [read_run(folder) for folder in folders]
    names = labels(folders)
    metrics = [metric for metric in METRICS if any(metric in gather.metrics_of(run.views) for run in runs)]
    problems = [problem for run in runs for problem in run.problems]
    for run, name in zip(runs[1:], names[1:], strict=True):
        if differs := gather.other_cameras(runs[0].cameras, run.cameras):
            text = f"{name} has other {differs} than {names[0]}, so that figures differ for this reason, too"
            problems.append(f"{text}.")
            warn(text)
    content = {
        "name": " · ".join(names),
        "subtitle": "; ".join(str(folder.resolve()) for folder in folders),
        "metrics": metrics,
        "runs": [
            {"name": name, "curves": gather.curves(run), "summary": run.figures}
            for name, run in zip(names, runs, strict=True)
        ],
        "differences": differences([to_dict(run.folder.config()) for run in runs]),
        "views": _views(runs, metrics),
        "pictures": _shared_pictures(runs, names),
        "left_out": problems,
    }
    return fitted("Comparison of runs", _COMPARE_SCRIPTS, content)


def labels(folders: Sequence[Path]) -> list[str]:
    """Return short names that tell folders apart: their last parts, as many as are needed."""
    paths = [folder.resolve() for folder in folders]
    for count in range(1, max(len(path.parts) for path in paths) + 1):
        names = [os.sep.join(path.parts[-count:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{path.name} ({k + 1})" for k, path in enumerate(paths)]


def differences(configs: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return [field, value in each run] of the fields that are not equal in all; "–" where there is none."""
    found = [flat(config) for config in configs]
    fields = dict.fromkeys(name for config in found for name in config)
    rows = ([name, *(str(config.get(name, "–")) for config in found)] for name in fields)
    return [row for row in rows if len(set(row[1:])) > 1]


def _views(runs: Sequence[RunData], metrics: Sequence[str]) -> list[tuple[str, list[list[Any] | None]]]:
    """Return (name, metrics in each run or None) of all measured views."""
    found = []
    for name in dict.fromkeys(name for run in runs for name in run.views):
        values = [
            next(gather.rows_of({name: run.views[name]}, metrics))[1:] if name in run.views else None
            for run in runs
        ]
        found.append((gather.short_name(name), values))
    return found


def _shared_pictures(runs: Sequence[RunData], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return views that two runs or more have previews of, those with most runs first."""
    indices = [gather.pictured(run) for run in runs]
    shared = dict.fromkeys(name for found in indices for name in found)
    counts = {name: sum(name in found for found in indices) for name in shared}
    chosen = sorted((name for name in shared if counts[name] > 1), key=lambda name: -counts[name])
    pictures = []
    for name in chosen[:_MAX_PICTURED]:
        found = [
            (label, run.views[name].get("psnr"), layers)
            for label, run, cameras in zip(names, runs, indices, strict=True)
            if name in cameras and (layers := gather.layers(run, cameras[name])) is not None
        ]
        if len(found) < 2:
            continue
        shown = [{"label": "photograph", "src": found[0][2]["photograph"]}]
        for part in ("render", "error"):
            shown += [{"label": f"{label}, {part}", "src": layers[part]} for label, _, layers in found]
        note = " / ".join("–" if psnr is None else f"{psnr:.2f}" for _, psnr, _ in found) + " dB"
        pictures.append({"name": gather.short_name(name), "note": note, "layers": shown})
    return pictures
