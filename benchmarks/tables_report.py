# SPDX-License-Identifier: Apache-2.0
"""Makes rows of the paper's tables from finished results, for `tables.py`."""

from __future__ import annotations

import csv
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from harness import markdown_table
from opponents.spatial_partition import makespan
from quality_plan import end_of
from quality_report import Run, labels, spread

Row = dict[str, Any]
Worst = Callable[[Iterable[float]], float]
PAPER_GPUS = 4  # number of GPUs on which the paper trained its blocks


def _mean_memory(run: Run) -> float | None:
    values = run.get("population", {}).get("mean_memory_bytes")
    return max(values) / 1e9 if values else None


# Columns of a finished run: name, value (None: not measured), format, and the function that picks the worst
# seed.
FIGURES: tuple[tuple[str, Callable[[Run], float | None], str, Worst], ...] = (
    ("PSNR", lambda run: end_of(run)["psnr"], "{:.2f}", min),
    ("corrected PSNR", lambda run: end_of(run).get("psnr_corrected"), "{:.2f}", min),
    ("SSIM", lambda run: end_of(run)["ssim"], "{:.4f}", min),
    ("LPIPS", lambda run: end_of(run).get("lpips"), "{:.4f}", max),
    ("images/s", lambda run: run["images_per_second"], "{:.0f}", min),
    ("seconds", lambda run: run["seconds"], "{:.1f}", max),
    ("peak M", lambda run: run["peak_gaussians"] / 1e6, "{:.3f}", max),
    ("final M", lambda run: run["gaussians"] / 1e6, "{:.3f}", max),
    ("peak GB", lambda run: run["peak_memory_bytes"] / 1e9, "{:.2f}", max),
    ("mean GB", _mean_memory, "{:.2f}", max),
)


def arm_rows(runs: Sequence[Run], arms: dict[str, dict[str, Any]]) -> tuple[list[Row], list[Row]]:
    """Return a row for each capture, arm and number of ranks: as text, and as numbers for the CSV file.

    `arms`: name of the recipe -> its "title" and, where the paper has it, its row in "paper".
    """
    groups: dict[tuple[str, int, int, str], list[Run]] = defaultdict(list)
    order, label = list(arms), labels(runs)
    for run in runs:
        if run["recipe"] in arms:
            place = order.index(run["recipe"])
            groups[run["capture"], place, run.get("ranks", 1), run["settings"]].append(run)
    columns = list(dict.fromkeys(name for arm in arms.values() for name in arm.get("paper", {})))
    texts, numbers = [], []
    for (capture, place, ranks, settings), group in sorted(groups.items(), key=lambda item: item[0]):
        arm = arms[order[place]]
        title = arm["title"] if settings not in label(group[0]) else f"{arm['title']} ({settings})"
        about = {"scene": capture, "arm": title, "GPUs": ranks, "seeds": len(group)}
        text, number = dict(about), dict(about)
        for name, value, form, worst in FIGURES:
            found = [v for run in group if (v := value(run)) is not None]
            text[name] = spread(found, form, worst)
            if found:
                number |= {name: statistics.median(found), f"worst {name}": worst(found)}
        paper = {f"paper {name}": arm.get("paper", {}).get(name, "") for name in columns}
        texts.append(text | paper)
        numbers.append(number | paper)
    return texts, numbers


def speedups(rows: list[Row]) -> None:
    """Add to number rows of `arm_rows` how many times faster they trained than on one rank."""
    alone = {(row["scene"], row["arm"]): row["seconds"] for row in rows if row["GPUs"] == 1}
    for row in rows:
        first = alone.get((row["scene"], row["arm"]))
        row["speedup"] = "" if first is None else round(first / row["seconds"], 2)


def partition_rows(runs: Sequence[Run], arms: dict[str, dict[str, Any]]) -> list[Row]:
    """Return the overhead of spatial partitions: cameras per block, and Gaussians lost at the merge."""
    rows = []
    for run in runs:
        if run["recipe"] not in arms or "blocks" not in run:
            continue
        blocks, cover = run["blocks"], run["coverage"]
        trained = sum(block["gaussians"] for block in blocks)
        sequential = [block["seconds"] for block in blocks]
        around = run["split_seconds"] + run["merge_seconds"]
        cameras = [block["cameras"] for block in blocks]
        rows.append(
            {
                "scene": run["capture"],
                "blocks": len(blocks),
                "seed": run["seed"],
                "covered": f"{cover['covered']} of {cover['cameras']}",
                "assignments per camera": round(cover["assignments"] / cover["cameras"], 2),
                "in several blocks": f"{cover['in_several'] / cover['cameras']:.1%}",
                "cameras per block": f"{min(cameras)} to {max(cameras)}",
                "trained M": round(trained / 1e6, 3),
                "merged M": round(run["gaussians"] / 1e6, 3),
                "surviving": f"{run['gaussians'] / max(trained, 1):.1%}",
                "seconds on 1 GPU": round(around + sum(sequential), 1),
                f"seconds on {PAPER_GPUS} GPUs": round(around + makespan(sequential, PAPER_GPUS), 1),
            }
        )
    return rows


def trajectory_rows(runs: Sequence[Run], recipe: str, reference: Sequence[Row]) -> list[Row]:
    """Return the population of each scene at the stages of the schedule, in millions, beside the paper's."""
    scenes: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for run in runs:
        if run["recipe"] == recipe and "population" in run:
            scenes[run["capture"]].append(run["population"])
    rows = []
    for paper in reference:
        row = {"stage": paper["stage"]}
        for scene, populations in sorted(scenes.items()):
            found = [p[paper["stage"]] / 1e6 for p in populations if paper["stage"] in p]
            row[scene] = spread(found, "{:.3f}", max)
        rows.append(row | {f"paper {name}": value for name, value in paper.items() if name != "stage"})
    return rows


def cost_rows(scene: str, reports: Sequence[dict[str, Any]], reference: Sequence[Row]) -> list[Row]:
    """Return the time of each stage of a step by `bm_exchange.py`, under the paper's names for stages."""
    papers = {row["GPUs"]: row for row in reference}
    rows = []
    for report in reports:
        ms = report["ms"]
        ours = {
            "preprocess": ms["project"] + ms["sort"], "communicate": ms["exchange"] + ms["exchange back"],
            "render": ms["raster"], "loss": ms["loss"], "backward": ms["raster back"],
            "other": ms["optimiser"] + ms["other"], "total": ms["alone"],
        }  # fmt: skip
        paper = papers.get(report["ranks"], {})
        row: Row = {"scene": scene, "GPUs": report["ranks"]}
        row |= {name: round(value, 2) for name, value in ours.items()}
        row |= {"in a row": round(ms["step"], 2), "Gaussians M": round(report["gaussians"] / 1e6, 3)}
        rows.append(row | {f"paper {name}": paper.get(name, "") for name in ours})
    return rows


def oracle_rows(scene: str, arms: Sequence[dict[str, Any]], reference: Sequence[Row]) -> list[Row]:
    """Return the arms of `blitzgs gate replay`, beside the paper's."""
    first = arms[0]
    papers = {row["arm"]: row for row in reference}
    rows = []
    for arm in arms:
        paper = papers.get(arm["arm"], {})
        rows.append(
            {
                "scene": scene,
                "arm": arm["arm"],
                "PSNR": round(arm["psnr"], 3),
                "change": round(arm["psnr"] - first["psnr"], 3),
                "SSIM": round(arm["ssim"], 4),
                "peak M": round(arm["peak"] / 1e6, 3),
                "peak change": f"{arm['peak'] / first['peak'] - 1:+.1%}",
                "seconds": round(arm["seconds"], 1),
                "matched": f"{arm['matched']:.0%}" if "matched" in arm else "",
            }
            | {f"paper {name}": paper.get(name, "") for name in ("PSNR", "peak M", "peak change")}
        )
    return rows


def popping_rows(scene: str, found: dict[str, Any]) -> list[Row]:
    """Return the popping of one model's levels (`bm_popping.py`), in 1/255."""
    names = ("largest_change", "mean_change", "largest", "mean", "pixel", "kept")
    return [
        {"scene": scene, "levels": mode} | {name: found[mode].get(name, "") for name in names}
        for mode in ("full", "gated", "smooth")
    ]


def write(out: Path, table: str, source: str, parts: Sequence[tuple[str, list[Row]]], rows: list[Row]) -> str:
    """Write TABLE.md and TABLE.csv into a folder; returns the Markdown.

    `source`: place of the figures in the paper. `parts`: title and rows of each table of the Markdown; those
    without rows are left out. `rows`: of the CSV file.
    """
    text = [f"# {table}\n", f"Medians over the seeds, the worst in brackets. Paper: {source}.\n"]
    text += [f"## {title}\n\n{markdown_table(part)}\n" for title, part in parts if part]
    (out / f"{table}.md").write_text("\n".join(text))
    with (out / f"{table}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), restval="")
        writer.writeheader()
        writer.writerows(rows)
    return "\n".join(text)
