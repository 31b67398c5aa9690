# SPDX-License-Identifier: Apache-2.0
"""Results of `bm_quality.py`: JSON and Markdown tables of all runs of a folder."""

from __future__ import annotations

import json
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from harness import command_line, markdown_table
from quality_run import write

RUNS = "runs"
Run = dict[str, Any]
Group = tuple[str, str]  # capture, label of the recipe


def read_runs(source: Path) -> list[Run]:
    """Return the runs in a folder of results, of its `runs` folder or of one collected JSON file.

    ValueError: a file holds something else. OSError: the folder or file does not exist.
    """
    if source.is_dir():
        inner = source / RUNS if (source / RUNS).is_dir() else source
        return [run for path in sorted(inner.glob("*.json")) for run in read_runs(path)]
    try:
        found = json.loads(source.read_text())
        runs = found.get("runs", [found])
        if not all({"name", "status", "capture", "recipe", "seed"} <= set(run) for run in runs):
            raise KeyError("name")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{source} holds no results of bm_quality.py") from error
    return runs


def collect(out: Path, sources: Iterable[Path]) -> None:
    """Copy the runs of other folders and files into `out`; a failed run never replaces a finished one."""
    (out / RUNS).mkdir(parents=True, exist_ok=True)
    for source in sources:
        for run in read_runs(source):
            path = out / RUNS / f"{run['name']}.json"
            if run["status"] == "done" or not path.exists():
                write(path, run)


def origin_of(runs: Sequence[Run]) -> dict[str, Any]:
    """Return command, commit and environment of runs, as `harness.write_json` takes them."""
    known = [run for run in runs if "environment" in run]  # those that got as far as their training
    return {
        "command": command_line(),
        "commit": " and ".join(sorted({run["commit"] for run in known})) or "unknown",
        "environment": known[0]["environment"] if known else {},
    }


def is_done(out: Path, name: str) -> bool:
    """Tell whether a run has been finished."""
    path = out / RUNS / f"{name}.json"
    return path.exists() and read_runs(path)[0]["status"] == "done"


def report(out: Path) -> str:
    """Write quality.json and quality.md into `out`; return the Markdown."""
    runs = read_runs(out / RUNS)
    text = markdown(runs)
    (out / "quality.json").write_text(json.dumps({"runs": runs}))
    (out / "quality.md").write_text(text)
    return text


def labels(runs: Sequence[Run]) -> Callable[[Run], str]:
    """Name the recipes; if a recipe was trained with several settings, add the digest of each."""
    settings: dict[Group, set[str]] = defaultdict(set)
    for run in runs:
        settings[run["capture"], run["recipe"]].add(run["settings"])

    def label(run: Run) -> str:
        several = len(settings[run["capture"], run["recipe"]]) > 1
        name = f"{run['recipe']} ({run['settings']})" if several else run["recipe"]
        return f"{name}, {run['ranks']} ranks" if run.get("ranks", 1) > 1 else name

    return label


def grouped(runs: Sequence[Run]) -> dict[Group, list[Run]]:
    """Put the seeds of a capture and a recipe together, by capture."""
    label, groups = labels(runs), defaultdict(list)
    for run in runs:
        groups[run["capture"], label(run)].append(run)
    return {key: groups[key] for key in sorted(groups, key=lambda key: key[0])}


def markdown(runs: Sequence[Run]) -> str:
    """Return a table for each capture, the hardware and code of the runs, and the runs that failed."""
    done = [run for run in runs if run["status"] == "done"]
    rows: dict[str, list[dict[str, str]]] = defaultdict(list)
    for (capture, label), group in grouped(done).items():
        rows[capture] += table_rows(label, group)
    parts = ["# Quality\n", *(f"## {capture}\n\n{markdown_table(rows[capture])}\n" for capture in rows)]
    if done:
        parts.append(
            'Medians over the seeds, the worst in brackets. Held-out views, unless "training" is said; gap: '
            "training less held-out PSNR. Corrected: after the affine map of each view's colours to its "
            "photograph's. Seconds of training alone, evaluations left out; ~: runs shared a GPU, so that "
            "times do not compare. GB: most memory of the training. The gsplat recipes are gsplat's density "
            "strategies over the renderer and loss of BlitzGS, with photographs already on the device.\n"
        )
        machines = {", ".join(f"{k} {v}" for k, v in run["environment"].items()) for run in done}
        beside = {run.get("side_by_side", 1) for run in done}
        commits = {run["commit"] for run in done}
        parts.append(
            f"Commit {', '.join(sorted(commits))}. {'; '.join(sorted(machines))}. Runs side by side on a "
            f"host: up to {max(beside)}.\n"
        )
    failed = [f"- {run['name']}: {run['error']}" for run in runs if run["status"] != "done"]
    if failed:
        parts += ["## Failed\n", "\n".join(failed) + "\n"]
    return "\n".join(parts)


def table_rows(label: str, group: Sequence[Run]) -> list[dict[str, str]]:
    """Return a row for each image count at which every seed measured its training views, too."""
    counts = [{e["images"] for e in run["evaluations"] if "train" in e} for run in group]
    return [
        table_row(label, [(run, e) for run in group for e in run["evaluations"] if e["images"] == images])
        for images in sorted(set.intersection(*counts))
    ]


def table_row(label: str, found: Sequence[tuple[Run, dict[str, Any]]]) -> dict[str, str]:
    """Return the cells of some seeds, each with its evaluation at the same image count."""
    evaluations = [evaluation for _, evaluation in found]
    images = evaluations[0]["images"]
    ends = [run for run, evaluation in found if evaluation["images"] == run["images"]]
    # A capture without held-out views is measured on its training views.
    split = "test" if all("test" in e for e in evaluations) else "train"
    seconds = spread([e["seconds"] for e in evaluations], "{:.1f}", max)
    row = {"recipe": label, "images": f"{images:,}", "seeds": str(len(found))}
    for metric, name, form in (
        ("psnr", "PSNR", "{:.2f}"),
        ("ssim", "SSIM", "{:.4f}"),
        ("psnr_corrected", "corrected", "{:.2f}"),
    ):
        row[name] = spread([e[split][metric] for e in evaluations], form, min)
    lpips = [e[split]["lpips"] for e in evaluations if "lpips" in e[split]]
    row["LPIPS"] = spread(lpips, "{:.4f}", max)
    row["training PSNR / SSIM"] = " / ".join(
        form.format(statistics.median(e["train"][metric] for e in evaluations))
        for metric, form in (("psnr", "{:.2f}"), ("ssim", "{:.4f}"))
    )
    gaps = [e["train"]["psnr"] - e[split]["psnr"] for e in evaluations]
    row["gap"] = f"{statistics.median(gaps):.2f}" if split == "test" else ""
    row["seconds"] = "~" * any(run.get("per_gpu", 1) > 1 for run, _ in found) + seconds
    row["images/s"] = f"{statistics.median(images / max(e['seconds'], 1e-9) for e in evaluations):.0f}"
    row["Gaussians"] = spread([e["gaussians"] / 1e6 for e in evaluations], "{:.3f} M", max)
    row["peak"] = spread([run["peak_gaussians"] / 1e6 for run in ends], "{:.3f} M", max)
    row["GB"] = spread([run["peak_memory_bytes"] / 1e9 for run in ends], "{:.2f}", max)
    return row


def spread(values: Sequence[float], form: str, worst: Callable[[Iterable[float]], float]) -> str:
    """Return the median, and with several values the worst in brackets."""
    if not values:
        return ""
    median = form.format(statistics.median(values))
    return median if len(values) == 1 else f"{median} ({form.format(worst(values))})"
