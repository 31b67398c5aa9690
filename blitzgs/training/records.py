# SPDX-License-Identifier: Apache-2.0
"""What a training reports: the record of a step, and how the population changed over the run."""

from __future__ import annotations

import contextlib
import math
import platform
import resource
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import psutil
import torch

import blitzgs
from blitzgs.config.files import config_hash
from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.render import Frame
from blitzgs.ops.host import HostCopy
from blitzgs.runs.guard import check_table, find_bad
from blitzgs.runs.log import records
from blitzgs.runs.run_files import LOG, PICTURE
from blitzgs.training.batches import Batch
from blitzgs.training.loss import SCALE_UNIT, batch_psnr, opacity_term, photometric, scale_term
from blitzgs.training.state import TrainingState
from blitzgs.util.charts import line_chart
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file

_MILESTONES = ("initial", "before_pass_1", "after_pass_1", "peak", "before_pass_2", "after_pass_2", "final")


def population_report(state: TrainingState, memory_samples: Sequence[int]) -> dict[str, Any]:
    """Return the population at its stages and the memory of each rank; every rank calls this.

    "initial", "before_pass_1" and so on (only passes that happened), "peak" and "final" are numbers of
    Gaussians of all ranks. "peak_memory_bytes" and, on CUDA, "mean_memory_bytes" since the run began or was
    resumed are lists with a value for each rank.
    """
    progress = state.progress
    counts = progress.milestones | {"peak": progress.peak_gaussians, "final": state.population()}
    mean = round(fmean(memory_samples)) if memory_samples else None
    memory = state.ranks.all_gather_object((peak_memory_bytes(state.ranks.device), mean))
    report: dict[str, Any] = {name: counts[name] for name in _MILESTONES if name in counts}
    report["peak_memory_bytes"] = [peak for peak, _ in memory]
    if all(mean is not None for _, mean in memory):
        report["mean_memory_bytes"] = [mean for _, mean in memory]
    return report


def describe(report: dict[str, Any]) -> str:
    """Return the report in one line of text."""
    stages = [f"{name.replace('_', ' ')} {report[name]:,}" for name in _MILESTONES if name in report]
    return "population: " + ", ".join(stages)


def run_figures(state: TrainingState, population: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a run for its summary, besides its metrics and the `population_report`."""
    figures = {
        "images": state.images_seen,
        "seconds": state.progress.seconds,
        "stages": state.stages(),
        "images_per_second": state.images_seen / max(state.progress.seconds, 1e-9),
        "gaussians": population["final"],
        "peak_gaussians": population["peak"],
        "population": population,
        "peak_memory_bytes": peak_memory_bytes(state.ranks.device),
        "config_hash": config_hash(state.config),
        "run": state.run_id,
        "versions": versions(state.ranks.device),
        "largest_fall": state.curve.fall,
        "warnings": state.curve.warnings(),
    }
    if state.config.schedule.minutes > 0:
        figures |= {
            "budget_seconds": 60 * state.config.schedule.minutes,
            "scale": state.images_seen / state.config.schedule.iterations,
        }
    if state.stepper.exposures is not None:
        figures["exposure"] = state.stepper.exposures.describe()
    return figures


def write_picture(state: TrainingState, report: dict[str, Any]) -> None:
    """Draw the population over time into the run's folder, from its log; on rank 0."""
    points: list[tuple[float, float]] = [(0, report["initial"])] if "initial" in report else []
    points += _logged(state.folder / LOG, state.run_id)
    points.append((state.images_seen, report["final"]))
    try:
        write_file(state.folder / PICTURE, line_chart({"": points}, "images", "Gaussians"))
    except OSError as error:
        warn(f"the population's picture was not written: {error}")


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


def measure_step(state: TrainingState, frame: Frame, batch: Batch) -> HostCopy:
    """Queue the measurement of a step between its forward and its backward pass. Collective.

    Returns float64 as int64 [7 + B]. Of all ranks: the number of ranks with parameters that are not finite,
    the Gaussians that the step projected, those of them that are visible in a view, and all Gaussians. Of the
    batch: L_scale and L_opacity (0 if their weights are), PSNR (nan if all pixels are masked), and
    `Batch.samples` [B].
    """
    loss, extent, table = state.config.loss, state.space.extent, state.stepper.table
    assert frame.active is not None  # as in every step of a training
    active = frame.active.considered()
    visible, population = (
        active.new_full((), count) for count in (len(frame.projected.visible_ids), len(state.table))
    )
    counts = state.ranks.all_reduce(torch.stack([find_bad(table), active, visible, population]))
    scale = opacity = batch.samples.new_zeros(())
    if loss.scale > 0:
        scale = scale_term(frame, table, extent * SCALE_UNIT).mean()
    if loss.opacity > 0:
        opacity = opacity_term(frame, table).mean()
    # Over random colours, the PSNR of a view with a border that no Gaussian covers would be random.
    shown = frame.over_own_background()
    if (exposures := state.stepper.exposures) is not None:  # as the loss compares them
        shown, _ = exposures.shown(shown, batch.indices)
    terms = torch.stack([scale, opacity, batch_psnr(frame, batch, shown)])
    figures = torch.cat([counts.double(), terms.double(), batch.samples.double()])
    return HostCopy(figures.view(torch.int64))


def log_step(state: TrainingState, measured: HostCopy, sums: HostSum) -> None:
    """Write the record of the last step; wait for its figures, and check the parameters (NonFiniteError).

    `measured`: of `measure_step`. `sums`: `LossTerms.parts` over all ranks.
    """
    with state.ranks.watchdog.waiting("read_figures"):
        figures = measured.read().view(torch.float64)
    bad, active, visible, population, scale, opacity, psnr = figures[:7].tolist()
    if bad:
        check_table(state.stepper.table, state.progress.step)
    samples, loss = figures[7:].float(), state.config.loss
    losses = photometric(sums.read()[: 2 * len(samples)], samples, loss)
    values = {
        "loss": losses.mean().item() + loss.scale * scale + loss.opacity * opacity,
        # Without a pixel that counts there is no PSNR, and JSON has no nan.
        **({} if math.isnan(psnr) else {"psnr": psnr}),
        "active": active,
        "visible": visible,
        "gaussians": int(population),
        "images_per_second": state.images_seen / max(state.progress.seconds, 1e-9),
        "seconds": state.progress.seconds,
        "memory_bytes": memory_bytes(state.ranks.device),
    } | state.stepper.report()
    if loss.scale > 0:
        values["l_scale"] = scale
    state.log.scalars(state.images_seen, values)
    warning = None if math.isnan(psnr) else state.curve.add(state.images_seen, psnr)
    if warning is not None:
        state.log.event(state.images_seen, "warning", {"warning": warning}, f"warning: {warning}")


def peak_memory_bytes(device: torch.device) -> int:
    """Return this process's peak memory in bytes: allocated on a GPU, or resident on the CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def memory_bytes(device: torch.device) -> int:
    """Return this process's memory in bytes now: allocated on a GPU, or resident on the CPU."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    return int(psutil.Process().memory_info().rss)


def versions(device: torch.device) -> dict[str, str]:
    """Return the versions of the software and the name of the device."""
    found = {"blitzgs": blitzgs.__version__, "torch": torch.__version__, "python": platform.python_version()}
    if device.type == "cuda":
        found |= {"device": torch.cuda.get_device_name(device), "cuda": str(torch.version.cuda)}
    return found | {"machine": platform.platform()}
