# SPDX-License-Identifier: Apache-2.0
"""The report of one run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from blitzgs.distributed.group import Ranks
from blitzgs.report import gather
from blitzgs.report.gather import RunData, read_run
from blitzgs.report.page import fitted, write_page
from blitzgs.runs import files as run_files
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.web import web_file

_SCRIPTS = ("parts.js", "report.js")
_SHOWN_EXTREMES = 4


def report(folder: Path, look: Mapping[str, str] | None = None) -> str:
    """Return the report of a run as HTML of at most `blitzgs.report.page.MAX_BYTES`.

    Args:
        folder: the run; it may be unfinished.
        look: the model in 3D; see `blitzgs.report.page.page`.

    Raises:
        FileNotFoundError: the folder is not a run.
    """
    data = read_run(folder)
    metrics = gather.metrics_of(data.views)
    content = {
        "name": folder.resolve().name,
        "subtitle": gather.subtitle(data),
        "summary": {name: value for name, value in data.summary.items() if isinstance(value, (int, float))},
        "split": "test" if data.is_test else "train",
        "metrics": metrics,
        "views": list(gather.rows_of(data.views, metrics)),
        "pictures": _pictures(data),
        "curves": gather.curves(data),
        "stages": _stages(data),
        "cameras": gather.plan(data),
        "exposures": gather.exposures(data),
        "warnings": gather.warnings_of(data),
        "environment": gather.environment(data),
        "config": _text(folder / run_files.CONFIG),
        "left_out": data.problems,
    }
    return fitted(f"{content['name']} · report", _SCRIPTS, content, look)


def write_report(folder: Path, look: Mapping[str, str] | None = None, out: Path | None = None) -> Path:
    """Write the report of a run, into its folder if `out` is None; return the file.

    Raises:
        FileNotFoundError: the folder is not a run.
        OSError: the file cannot be written, or exists and is no such page.
    """
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


def _stages(data: RunData) -> dict[str, float]:
    stages = data.summary.get("stages")
    if not isinstance(stages, dict):
        return {}
    return {str(name): round(value, 2) for name, value in stages.items() if isinstance(value, (int, float))}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")[:200_000]
    except OSError as error:
        return str(error)


# Size of the model in the report.
LOOK_BYTES = 4_000_000


def look_of(folder: Path) -> dict[str, str]:
    """Return the newest model of a run as a page with its viewer ("html"), and what it lacks ("note").

    The checkpoint is read into host memory, with the optimiser's moments.

    Raises:
        FileNotFoundError: there is no checkpoint.
        CheckpointError: all checkpoints are damaged.
        ValueError: the model has no visible Gaussian.
    """
    found = web_file(open_model(folder, Ranks()), LOOK_BYTES)
    note = f"{found.gaussians:,} of {found.of:,} Gaussians. {found.left_out}"
    if found.left_out:
        note += " blitzgs export RUN --html FILE writes more, blitzgs view RUN shows all."
    return {"html": found.text, "note": note}
