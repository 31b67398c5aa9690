# SPDX-License-Identifier: Apache-2.0
"""The stress grid of `bm_quality.py`: how far a recipe is from losing what it has learnt.

Every capture x schedule x change of one value x batch size; a column has one capture and one value of the
grid's other axes. A cell has the held-out PSNR, and the largest fall of the training PSNR below its running
best (`blitzgs.training.curve.Curve.fall`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from blitzgs.config.files import load_config

SCHEDULES = (0.15, 0.25, 0.5, 1.0)
FACTORS = (0.5, 2.0)
BATCHES = (1, 4, 16)
SEEDS = (0, 1)
# Name in the table and field; one at a time is halved and doubled.
VALUES = {
    "opacity": "optimiser.opacity",
    "position": "optimiser.position",
    "growth": "population.growth",
    "noise": "optimiser.position_noise",
}


def recipes(source: str) -> dict[str, str]:
    """Return the grid's recipes, name -> source and overrides, the present values first.

    Names have no dots: factors and schedules are in per cent.

    Args:
        source: configuration file whose values are changed.
    """
    config = load_config(source)
    changes = [("base", "")]
    for factor, (name, field) in itertools.product(FACTORS, VALUES.items()):
        section, value = field.split(".")
        changed = factor * getattr(getattr(config, section), value)
        changes.append((f"{name}={factor:.0%}".rstrip("%"), f" --{field}={changed:.8g}"))
    return {
        f"{change}+schedule={round(100 * scale)}+B={batch}": (
            f"{source} --schedule.scale={scale:g} --schedule.batch_size={batch}{override}"
        )
        for (change, override), scale, batch in itertools.product(changes, SCHEDULES, BATCHES)
    }


def part_of(found: dict[str, str], part: tuple[int, int]) -> dict[str, str]:
    """Return part K of N (from 1) of the recipes: each part has some of every schedule and change."""
    number, count = part
    return dict(list(found.items())[number - 1 :: count])


def parse_part(text: str) -> tuple[int, int]:
    """Read "K/N".

    Raises:
        ValueError: it is not 1 <= K <= N.
    """
    number, _, count = text.partition("/")
    part = int(number), int(count)
    if not 1 <= part[0] <= part[1]:
        raise ValueError(f"part {text}: write K/N with K from 1 to N")
    return part


def markdown(runs: Sequence[dict[str, Any]]) -> str:
    """Return the stress table: worst PSNR and largest fall over the seeds, and the loss against the column.

    Args:
        runs: results of `bm_quality.py --stress`; others are left out.
    """
    cells: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for run in runs:
        change, _, column = run["recipe"].partition("+")
        if run["status"] == "done" and column and "largest_fall" in run:
            cells.setdefault((run["capture"], column, change), []).append(run)
    worst = {key: min(_psnr(run) for run in group) for key, group in cells.items()}
    lines = [
        "| capture | schedule, batch | change | seeds | PSNR | below the column's best | largest fall |",
        "|---|---|---|---|---|---|---|",
    ]
    for (capture, column, change), group in sorted(cells.items()):
        best = max(value for key, value in worst.items() if key[:2] == (capture, column))
        psnr = worst[capture, column, change]
        fall = max(run["largest_fall"] for run in group)
        lines.append(
            f"| {capture} | {column} | {change} | {len(group)} "
            f"| {psnr:.2f} | {best - psnr:.2f} | {fall:.2f} |"
        )
    return "\n".join(lines) + "\n"


def _psnr(run: dict[str, Any]) -> float:
    last = run["evaluations"][-1]
    psnr: float = last.get("test", last.get("train"))["psnr"]
    return psnr
