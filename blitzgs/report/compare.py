# SPDX-License-Identifier: Apache-2.0
"""Runs side by side."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from blitzgs.config.files import flat, to_dict
from blitzgs.report import gather
from blitzgs.report.gather import RunData, read_run
from blitzgs.report.page import fitted
from blitzgs.runs.evaluation import METRICS

_SCRIPTS = ("parts.js", "compare.js")
_MAX_PICTURED = 12


def compare(folders: Sequence[Path]) -> str:
    """Return a page that compares runs, as HTML of at most `blitzgs.report.page.MAX_BYTES`.

    Args:
        folders: the runs, the one that the others are compared with first.

    Raises:
        FileNotFoundError: a folder is not a run.
        ValueError: there are fewer than two, or a configuration cannot be read.
    """
    if len(folders) < 2:
        raise ValueError("a comparison needs two runs or more")
    runs = [read_run(folder) for folder in folders]
    names = labels(folders)
    metrics = [metric for metric in METRICS if any(metric in gather.metrics_of(run.views) for run in runs)]
    problems = [problem for run in runs for problem in run.problems]
    content = {
        "name": " · ".join(names),
        "subtitle": "; ".join(str(folder.resolve()) for folder in folders),
        "metrics": metrics,
        "runs": [
            {
                "name": name,
                "curves": gather.curves(run),
                "summary": {
                    key: value for key, value in run.summary.items() if isinstance(value, (int, float))
                },
            }
            for name, run in zip(names, runs, strict=True)
        ],
        "differences": differences([to_dict(run.folder.config()) for run in runs]),
        "views": _views(runs, metrics),
        "pictures": _pictures(runs, names),
        "left_out": problems,
    }
    return fitted("Comparison of runs", _SCRIPTS, content)


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


def _pictures(runs: Sequence[RunData], names: Sequence[str]) -> list[dict[str, Any]]:
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
