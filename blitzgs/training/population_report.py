# SPDX-License-Identifier: Apache-2.0
"""How the population grew and shrank over a run: in the summary, in the log, and as a picture."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from blitzgs.output import write_file
from blitzgs.training.run import peak_memory_bytes
from blitzgs.training.run_log import LOG
from blitzgs.training.state import TrainingState

PICTURE = "population.svg"
_STAGES = ("before_pass_1", "after_pass_1", "peak", "before_pass_2", "after_pass_2", "final")


@dataclass
class MemoryMeter:
    """Samples the memory that this rank's GPU has allocated; on the CPU there is nothing to sample."""

    total: float = 0.0
    samples: int = 0

    def sample(self, device: torch.device) -> None:
        """Add what is allocated now."""
        if device.type == "cuda":
            self.total += torch.cuda.memory_allocated(device)
            self.samples += 1

    def mean(self) -> int | None:
        """Return the mean of the samples in bytes, or None."""
        return round(self.total / self.samples) if self.samples else None


def population_report(state: TrainingState, meter: MemoryMeter) -> dict[str, Any]:
    """Return the stages of the population and the memory of each rank; every rank calls this.

    Returns:
        initial, before_pass_1, after_pass_1, peak, before_pass_2, after_pass_2 (the passes where there were
        any) and final, in Gaussians of all ranks; peak_memory_bytes and, on CUDA, mean_memory_bytes since the
        run began or was resumed, a list with a value for each rank.
    """
    progress = state.progress
    counts = progress.milestones | {"peak": progress.peak_gaussians, "final": state.population()}
    memory = state.ranks.all_gather_object((peak_memory_bytes(state.ranks.device), meter.mean()))
    report: dict[str, Any] = {name: counts[name] for name in ("initial", *_STAGES) if name in counts}
    report["peak_memory_bytes"] = [peak for peak, _ in memory]
    if all(mean is not None for _, mean in memory):
        report["mean_memory_bytes"] = [mean for _, mean in memory]
    return report


def describe(report: dict[str, Any]) -> str:
    """Return the report in one line of text."""
    stages = [
        f"{name.replace('_', ' ')} {report[name]:,}" for name in ("initial", *_STAGES) if name in report
    ]
    return "population: " + ", ".join(stages)


def write_picture(state: TrainingState, report: dict[str, Any]) -> None:
    """Draw the population over time into the run's folder, from its log; on rank 0."""
    points = [(0, report["initial"])] if "initial" in report else []
    points += _logged(state.folder / LOG)
    points.append((state.images_seen, report["final"]))
    try:
        write_file(state.folder / PICTURE, draw(points))
    except OSError as error:
        warnings.warn(f"the population's picture was not written: {error}", stacklevel=2)


def _logged(path: Path) -> list[tuple[int, int]]:
    """Return (images, Gaussians) of the events that changed the population."""
    points: list[tuple[int, int]] = []
    if not path.exists():
        return points
    for line in path.read_text().splitlines():
        record = json.loads(line)
        if record.get("event") in ("pass_1", "pass_2"):
            points.append((record["t"], record["before"]))
        if record.get("event") in ("densify", "pass_1", "pass_2"):
            points.append((record["t"], record["gaussians"]))
    return points


def draw(points: Sequence[tuple[int, int]]) -> str:
    """Return a line chart of (images, Gaussians) as SVG."""
    width, height, left, top, bottom = 720, 360, 70, 30, 45
    last = max(max(t for t, _ in points), 1)
    most = _nice(max(max(n for _, n in points), 1))
    inner_width, inner_height = width - left - 20, height - top - bottom

    def place(t: float, n: float) -> tuple[float, float]:
        return left + inner_width * t / last, top + inner_height * (1 - n / most)

    lines = []
    for k in range(5):
        (x, y), (column, _) = place(0, most * k / 4), place(last * k / 4, 0)
        lines.append(f'<path d="M{x:.1f} {y:.1f}H{width - 20}" stroke="#ddd"/>')
        lines.append(f'<text x="{x - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{_short(most * k / 4)}</text>')
        below = height - bottom + 18
        lines.append(f'<text x="{column:.1f}" y="{below}" text-anchor="middle">{_short(last * k / 4)}</text>')
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(t, n) for t, n in points))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="12"><rect width="{width}" height="{height}" fill="white"/>{"".join(lines)}'
        f'<polyline points="{path}" fill="none" stroke="#1f77b4" stroke-width="2"/>'
        f'<text x="{left}" y="18">Gaussians</text>'
        f'<text x="{width - 20}" y="{height - 8}" text-anchor="end">images</text></svg>\n'
    )


def _nice(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    size = 10.0 ** (len(str(int(value))) - 1)
    return next(step * size for step in (1, 2, 5, 10) if step * size >= value)


def _short(value: float) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"
