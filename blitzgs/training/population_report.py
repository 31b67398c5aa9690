# SPDX-License-Identifier: Apache-2.0
"""Reports how the population changed over a run: in the summary, in the log, and as a picture."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from blitzgs.runs.files import memory_bytes, peak_memory_bytes
from blitzgs.runs.log import LOG, records
from blitzgs.training.state import TrainingState
from blitzgs.util.charts import line_chart
from blitzgs.util.output import write_file

PICTURE = "trajectory.svg"
_STAGES = ("before_pass_1", "after_pass_1", "peak", "before_pass_2", "after_pass_2", "final")


@dataclass
class MemoryMeter:
    """Samples the memory that this rank's GPU has allocated; does nothing on the CPU."""

    total: float = 0.0
    samples: int = 0

    def sample(self, device: torch.device) -> None:
        """Add a sample of the memory that is allocated now."""
        if device.type == "cuda":
            self.total += memory_bytes(device)
            self.samples += 1

    def mean(self) -> int | None:
        """Return the mean of the samples in bytes; None if there are none."""
        return round(self.total / self.samples) if self.samples else None


def population_report(state: TrainingState, meter: MemoryMeter) -> dict[str, Any]:
    """Return the population at its stages and the memory of each rank; every rank calls this.

    Returns:
        "initial", "before_pass_1", "after_pass_1", "peak", "before_pass_2", "after_pass_2" (only passes that
        happened) and "final": numbers of Gaussians of all ranks. "peak_memory_bytes" and, on CUDA,
        "mean_memory_bytes" since the run began or was resumed: lists with a value for each rank.
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
    points: list[tuple[float, float]] = [(0, report["initial"])] if "initial" in report else []
    points += _logged(state.folder / LOG, state.run_id)
    points.append((state.images_seen, report["final"]))
    try:
        write_file(state.folder / PICTURE, line_chart({"": points}, "images", "Gaussians"))
    except OSError as error:
        warnings.warn(f"the population's picture was not written: {error}", stacklevel=2)


def _logged(path: Path, run_id: str) -> list[tuple[int, int]]:
    """Return (images, Gaussians) of the events of run `run_id` that changed the population."""
    points: list[tuple[int, int]] = []
    for record in records(path):
        if record.get("run") != run_id:  # of a run that ended before its first checkpoint
            continue
        with contextlib.suppress(ValueError, LookupError, TypeError):
            if record.get("event") in ("pass_1", "pass_2"):
                points.append((int(record["t"]), int(record["before"])))
            if record.get("event") in ("densify", "pass_1", "pass_2"):
                points.append((int(record["t"]), int(record["gaussians"])))
    return points
