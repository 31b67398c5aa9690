# SPDX-License-Identifier: Apache-2.0
"""Makes the tables of `report.py` from the files that benchmarks write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import city_report
from harness import table

Json = dict[str, Any]


@dataclass(frozen=True)
class Section:
    """One table: the files that it needs, and the function that makes its lines."""

    files: tuple[str, ...]  # names in `COMMANDS`
    lines: Callable[..., list[str]]  # takes the content of each file, in the order of `files`
    origin: bool = True  # whether lines with command, machine and commit follow


QUALITY_COLUMNS = (
    "recipe", "images", "seeds", "PSNR", "SSIM", "corrected", "training PSNR / SSIM", "seconds",
)  # fmt: skip
OFFLOAD_COLUMNS = {
    "arm": "arm", "order": "views in order", "pool_gb": "GB on the GPU", "step_ms": "ms a step",
    "cost": "relative", "resident_hits": "blocks already there", "moved_mb_per_step": "MB moved a step",
    "sweep_s": "s for a sweep",
}  # fmt: skip


def ms(value: float) -> str:
    """Return milliseconds with two decimals, three below a tenth."""
    return f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"


def fastest_gsplat(result: Json) -> Json | None:
    """Return the figures of gsplat's faster mode, or None if gsplat was not installed."""
    modes = [result[name] for name in ("gsplat", "gsplat packed") if name in result]
    return min(modes, key=lambda mode: mode["total"]) if modes else None


def render_lines(render: Json) -> list[str]:
    """Tabulate the forward and backward pass, against gsplat's faster mode."""

    def cells(figures: Json) -> list[str]:
        parts = " / ".join(ms(figures[name]) for name in ("forward", "backward", "total"))
        return [parts, f"{figures['peak_gb']:.2f}"]

    rows = []
    for result in render["results"]:
        ours, theirs = result["blitzgs"], fastest_gsplat(result)
        row = [result["scene"], f"{result['visible'] / 1e6:.2f} M", *cells(ours)]
        row += [*cells(theirs), f"**{theirs['total'] / ours['total']:.2f}**"] if theirs else ["–"] * 3
        rows.append(row)
    head = ["scene", "visible", "BlitzGS forward / backward / total, ms", "peak GB",
            "gsplat forward / backward / total, ms", "peak GB", "ratio"]  # fmt: skip
    return table(head, rows)


def stage_lines(render: Json) -> list[str]:
    """Tabulate the stages of the forward and backward pass."""
    stages = list(render["results"][0]["stages"])
    rows = [
        [
            result["scene"],
            f"{result['rows'] / 1e6:.2f} M",
            f"{result['intersections'] / 1e6:.2f} M",
            *(ms(result["stages"][stage]) for stage in stages),
        ]
        for result in render["results"]
    ]
    return table(["scene", "splats", "tile entries", *(s.replace("_", " ") for s in stages)], rows)


def call_lines(render: Json) -> list[str]:
    """Tabulate the same work through `blitzgs.rasterization` and autograd."""
    columns = {
        "blitzgs": "the training step's ops", "rasterization": "the call, dense gradients",
        "rasterization, 1 thread": "dense, autograd in one thread", "sparse": "sparse gradients",
        "sparse, 1 thread": "sparse, autograd in one thread", "sparse, meta": "sparse, all of meta read",
        "gsplat": "gsplat", "gsplat, 1 thread": "gsplat, autograd in one thread",
    }  # fmt: skip
    measured = [name for name in columns if any(name in result for result in render["results"])]
    rows = [
        [result["scene"], *(ms(result[name]["total"]) if name in result else "–" for name in measured)]
        for result in render["results"]
    ]
    return table(["scene", *(columns[name] for name in measured)], rows)


def step_lines(*files: Json) -> list[str]:
    """Tabulate a whole training step, against gsplat with torch's fused Adam."""
    results = [result for file in files for result in file["results"]]

    def cells(figures: Json | None) -> list[str]:
        if figures is None:
            return ["–", "–"]
        parts = ", ".join(f"{name} {ms(value)}" for name, value in figures["ms"].items() if name != "total")
        return [parts, f"**{ms(figures['ms']['total'])}**"]

    rows = []
    for result in results:
        ours, theirs = result["blitzgs"], result.get("gsplat + fused Adam")
        ratio = f"**{theirs['ms']['total'] / ours['ms']['total']:.2f}**" if theirs else "–"
        rows.append([result["scene"], str(result["views"]), *cells(ours), *cells(theirs), ratio])
    head = ["scene", "views", "BlitzGS by stage, ms", "total", "gsplat by stage, ms", "total", "ratio"]
    return table(head, rows)


def exchange_lines(exchange: Json) -> list[str]:
    """Tabulate a step on several GPUs, by stage."""
    reports = exchange["results"]
    names = {"alone": "a step alone, behind a barrier", "step": "**steps in a row**"}
    rows = [[names.get(stage, stage), *(ms(report["ms"][stage]) for report in reports)]
            for stage in reports[0]["ms"]]  # fmt: skip
    alone = {report["views"]: report["ms"]["step"] * report["ranks"] for report in reversed(reports)}
    rows += [
        ["speed-up of steps in a row", *(f"{alone[r['views']] / r['ms']['step']:.2f}" for r in reports)],
        ["largest cost over the mean", *(f"{report['balance']['measured']:.3f}" for report in reports)],
        ["MB between ranks", *(f"{sum(r['bytes per step'].values()) / 1e6:.0f}" for r in reports)],
    ]
    return table(["ms", *(f"{r['views']} views, {r['ranks']} GPU" for r in reports)], rows)


def row_lines(file: Json) -> list[str]:
    """Tabulate the rows that a benchmark has written itself."""
    rows = file["rows"]
    cells = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    return [f"{file['title']}.", "", *table(rows[0], cells)]


def city_lines(rows_of: Callable[[Json], city_report.Rows]) -> Callable[[Json], list[str]]:
    """Return the function that makes a table of the city's file."""

    def lines(city: Json) -> list[str]:
        rows = rows_of(city)
        return table(rows[0], (row.values() for row in rows)) if rows else ["No run got so far."]

    return lines


def accuracy_lines(accuracy: Json) -> list[str]:
    """Tabulate the error against time of each option."""
    rows = [
        [r["name"], ms(r["milliseconds"]), f"{r['image_error']:.1e}", f"{r['gradient_error']:.1e}",
         f"{r['cut_pixels']:.2%}"]
        for r in accuracy["rows"]
    ]  # fmt: skip
    return table(["option", "ms a view", "image error", "gradient error", "cut pixels"], rows)


def quality_lines(quality: Json) -> list[str]:
    """Tabulate held-out quality and training time at the end of each recipe, by capture."""
    import quality_report  # needs the package, which the other tables do not

    rows = []
    done = [run for run in quality["runs"] if run["status"] == "done"]
    for (capture, label), group in quality_report.grouped(done).items():
        last = quality_report.table_rows(label, group)[-1]
        rows.append([capture, *(last[column] for column in QUALITY_COLUMNS)])
    return table(["capture", *QUALITY_COLUMNS], rows)


def offload_lines(offload: Json) -> list[str]:
    """Tabulate steps with all Gaussians on the GPU, and with a pool."""
    rows = []
    for result in offload["results"]:
        values = [result.get(name, "–") for name in OFFLOAD_COLUMNS]
        rows.append([value if isinstance(value, str) else f"{value:.3g}" for value in values])
    return table(OFFLOAD_COLUMNS.values(), rows)


def summary_lines(render: Json, step: Json, exchange: Json) -> list[str]:
    """Return the README's table: one line for each kind of work, against gsplat or one GPU."""
    rows = []

    def add(work: str, ours: float, other: str, theirs: float | None, unit: str) -> None:
        cells = [f"{other} {theirs:.2f} {unit}", f"{theirs / ours:.1f}"] if theirs else ["–", "–"]
        rows.append([work, f"{ours:.2f} {unit}", *cells])

    for result in render["results"]:
        ours, theirs = result["blitzgs"], fastest_gsplat(result) or {}
        work = f"render forward + backward, {result['scene']}"
        add(work, ours["total"], "gsplat", theirs.get("total"), "ms")
    last = max(render["results"], key=lambda result: result["blitzgs"]["peak_gb"])
    theirs = fastest_gsplat(last) or {}
    add(f"its memory, {last['scene']}", last["blitzgs"]["peak_gb"], "gsplat", theirs.get("peak_gb"), "GB")
    for result in step["results"]:
        theirs = result.get("gsplat + fused Adam", {}).get("ms", {})
        work = f"training step of {result['views']} views, {result['scene']}"
        add(work, result["blitzgs"]["ms"]["total"], "gsplat + fused Adam", theirs.get("total"), "ms")
    steps = {(report["views"], report["ranks"]): report for report in exchange["results"]}
    most = max(ranks for _, ranks in steps)
    for (views, ranks), report in steps.items():
        if ranks == most:
            work = f"step of {views} views on {ranks} GPUs, {report['gaussians'] / 1e6:.0f} M Gaussians"
            add(work, report["ms"]["step"], "1 GPU", steps[views, 1]["ms"]["step"], "ms")
    return table(["work", "BlitzGS", "compared with", "times as fast, or as small"], rows)


def badge_lines(record: Json) -> list[str]:
    """Return one line: what the tests on a GPU said, of which commit and where."""
    tests, about = record["tests"], record["environment"]
    failed = tests["failed"] + tests["errors"]
    cut = "" if record["complete"] else ", cut off before the end"
    return [
        f"**GPU tests: {tests['passed']} passed, {failed} failed**, {tests['skipped']} skipped{cut} "
        f"({about['device']}, torch {about['torch']}, commit {record['commit']}, {record['date']})"
    ]


def record_lines(record: Json) -> list[str]:
    """Tabulate the last run of all tests on a GPU, and its small bench."""
    tests, about = record["tests"], record["environment"]
    rows = [
        ["card", f"{about['device']}, {about['memory_gb']:g} GB, one of {about['gpus']}"],
        ["versions", f"driver {about['driver']}, CUDA {about['cuda']}, torch {about['torch']}, "
                     f"Python {about['python']}"],
        ["date, commit", f"{record['date']}, {record['commit']}"],
        ["tests", f"{tests['passed']} passed, {tests['failed']} failed, {tests['errors']} errors, "
                  f"{tests['skipped']} skipped in {tests['seconds']:.0f} s"],
        *(["failed", f"`{problem['name']}`"] for problem in tests["problems"]),
        *([row["work"], row.get("error") or f"{ms(row['ms'])} ms, {row['peak_gb']:.2f} GB"]
          for found in record["bench"].values() for row in found),
    ]  # fmt: skip
    if not record["complete"]:
        rows.append(["complete", "no: the run was cut off"])
    return table(["", "last run on a GPU"], rows)


SECTIONS = {
    "gpu_badge": Section(("gpu_record",), badge_lines, origin=False),
    "gpu_record": Section(("gpu_record",), record_lines, origin=False),
    "render": Section(("render",), render_lines),
    "stages": Section(("render",), stage_lines),
    "call": Section(("render",), call_lines),
    "step": Section(("step_1", "step_4"), step_lines),
    "exchange": Section(("exchange",), exchange_lines),
    "drop_in_full": Section(("drop_in_full",), row_lines),
    "accuracy": Section(("accuracy",), accuracy_lines),
    "quality": Section(("quality",), quality_lines),
    "offload": Section(("offload",), offload_lines),
    "summary": Section(("render", "step_4", "exchange"), summary_lines),
}
SECTIONS |= {
    name: Section(("city_ranks",) if name == "city_ranks" else ("city",), city_lines(rows_of))
    for name, rows_of in city_report.TABLES.items()
}
