# SPDX-License-Identifier: Apache-2.0
"""Makes the tables of `bm_city.py` from its JSON, for its own Markdown and for `report.py`.

Each table is a list of rows with the same keys, all cells text. Rows of runs that did not get as far as the
table needs are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Json = dict[str, Any]
Rows = list[dict[str, str]]

TITLES = {
    "full": "LOD gate and mask", "no_lod": "mask alone", "no_mask": "LOD gate alone", "all_off": "neither",
}  # fmt: skip
NONE = "–"


def title_of(run: Json) -> str:
    """Return the name of a run in the tables."""
    title = TITLES.get(run["recipe"], run["recipe"])
    if run.get("batch_size", 4) != 4:
        title += f", {run['batch_size']} views a step"
    if run["ranks"] > 1:
        title += f", {run['ranks']} ranks"
    if not run["finished"] and "images" in run:
        title += f" (stopped at {run['images']:,} of {run['planned_images']:,} images)"
    return title


def text(value: float | None, form: str) -> str:
    """Format a value; a dash where there is none."""
    return NONE if value is None else format(value, form)


def gb(values: list[int]) -> str:
    """Return bytes of each rank in GB."""
    return ", ".join(f"{value / 1e9:.1f}" for value in values)


def mean_share(run: Json, name: str) -> float | None:
    """Return the mean of a share over the images of a run."""
    parts = [phase for phase in run["phases"] if phase[name] is not None]
    images = sum(phase["to"] - phase["from"] for phase in parts)
    return sum(phase[name] * (phase["to"] - phase["from"]) for phase in parts) / images if images else None


def rate_after_growth(run: Json) -> float | None:
    """Return the images per second of the phases in which the model no longer grows."""
    parts = [phase for phase in run["phases"] if "growth" not in phase["on"]]
    seconds = sum(phase["seconds"] for phase in parts)
    return sum(phase["to"] - phase["from"] for phase in parts) / seconds if seconds else None


def trained(file: Json, ranks: int | None = None) -> list[Json]:
    """Return the runs whose training is over; with `ranks`, those of so many ranks."""
    return [run for run in file["results"] if "phases" in run and ranks in (None, run["ranks"])]


def compared(file: Json) -> list[tuple[Json, Json]]:
    """Return the runs that were made on several numbers of ranks, each with the same run on one rank."""
    runs = [run for run in trained(file) if run["finished"]]
    several = {(run["recipe"], run["batch_size"]) for run in runs if run["ranks"] > 1}
    ones = {(run["recipe"], run["batch_size"]): run for run in runs if run["ranks"] == 1}
    keys = [(run["recipe"], run["batch_size"]) for run in runs]
    return [(run, ones[key]) for run, key in zip(runs, keys, strict=True) if key in several and key in ones]


def arm_rows(file: Json) -> Rows:
    """Tabulate the runs."""
    return [
        {
            "view level": title_of(run),
            "PSNR": text(run.get("psnr"), ".2f"),
            "SSIM": text(run.get("ssim"), ".4f"),
            "images": f"{run['images']:,}",
            "seconds": f"{run['seconds']:.1f}",
            "images/s": f"{run['images_per_second']:,.0f}",
            "after growth": text(rate_after_growth(run), ",.0f"),
            "active": text(mean_share(run, "active"), ".1%"),
            "visible": text(mean_share(run, "visible"), ".1%"),
            "M Gaussians": f"{run['population']['initial'] / 1e6:.2f} → {run['gaussians'] / 1e6:.2f}",
            "peak GB of a GPU": gb(run["population"]["peak_memory_bytes"]),
        }
        for run in trained(file)
    ]


def cost_rows(file: Json) -> Rows:
    """Tabulate what the gate and the mask cost and gain: full, against a run without them."""
    done = [run for run in trained(file, 1) if run["finished"] and "psnr" in run]
    # The arms of the first batch size; only one arm may have others.
    runs = {run["recipe"]: run for run in done if run["batch_size"] == done[0]["batch_size"]}
    others = {"LOD gate": "no_lod", "mask": "no_mask", "both": "all_off"}
    rows = []
    for name, other in others.items():
        if "full" not in runs or other not in runs:
            continue
        ours, theirs = runs["full"], runs[other]
        row = {
            "with against without": name,
            "PSNR, dB": f"{ours['psnr'] - theirs['psnr']:+.2f}",
            "images/s, whole run": f"{ours['images_per_second'] / theirs['images_per_second']:.2f} ×",
        }
        for column, at in (
            ("median images/s, second pass to clearing", -2),
            ("median images/s, after it", -1),
        ):
            rates = [run["phases"][at]["median_images_per_second"] for run in (ours, theirs)]
            row[column] = NONE if None in rates else f"{rates[0] / rates[1]:.2f} ×"
        peaks = [max(run["population"]["peak_memory_bytes"]) / 1e9 for run in (ours, theirs)]
        rows.append(row | {"peak GB": f"{peaks[0] - peaks[1]:+.1f}"})
    return rows


def popping_rows(file: Json) -> Rows:
    """Tabulate popping along a descending flight."""
    return [
        {
            "levels": mode,
            "largest change": f"{found[mode]['largest_change']:.2f}",
            "mean change": f"{found[mode]['mean_change']:.2f}",
            "largest popping": text(found[mode].get("largest"), ".3f"),
            "mean popping": text(found[mode].get("mean"), ".3f"),
            "worst pixels": text(found[mode].get("pixel"), ".1f"),
            "kept": f"{found[mode].get('kept', 1.0):.1%}",
            "frames": str(found["frames"]),
        }
        for found in (run["popping"] for run in file["results"] if "popping" in run)
        for mode in ("full", "gated", "smooth")
    ]


def rank_rows(file: Json) -> Rows:
    """Tabulate runs of one arm on several ranks, against the one on one rank."""

    def cell(rate: float | None, base: float | None) -> str:
        return NONE if rate is None or not base else f"{rate:,.0f} ({rate / base:.2f} ×)"

    rows = []
    for run, one in compared(file):
        row = {
            "view level": TITLES.get(run["recipe"], run["recipe"]),
            "views a step": str(run["batch_size"]),
            "ranks": str(run["ranks"]),
            "PSNR": text(run.get("psnr"), ".2f"),
            "seconds": f"{run['seconds']:.1f}",
            "images/s, whole run": cell(run["images_per_second"], one["images_per_second"]),
        }
        for i, (phase, base) in enumerate(zip(run["phases"], one["phases"], strict=False), 1):
            rates = phase["median_images_per_second"], base["median_images_per_second"]
            row[f"median in phase {i}"] = cell(*rates)
        row["set-up, s"] = f"{run['wall']['set_up']:.1f}"
        row["start to end, s"] = text(run["wall"].get("evaluated"), ".0f")
        rows.append(row | {"peak GB of a GPU": gb(run["population"]["peak_memory_bytes"])})
    return rows


TABLES: dict[str, Callable[[Json], Rows]] = {
    "city_arms": arm_rows, "city_costs": cost_rows, "city_popping": popping_rows, "city_ranks": rank_rows,
}  # fmt: skip
