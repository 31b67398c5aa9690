# SPDX-License-Identifier: Apache-2.0
"""Trains one run of `bm_quality.py` in a separate process: python benchmarks/quality_run.py SPEC RESULT.

SPEC is a JSON file of a `quality_plan.RunSpec`. The figures, or the error, are written to RESULT.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from harness import ROOT, commit, environment, seconds_of, synchronize
from opponents import spatial_partition
from opponents.gsplat_training import GsplatTrainer
from quality_plan import RunSpec

from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.evaluation import METRICS, Lpips, evaluate, load_lpips
from blitzgs.training.agreement import Agreement
from blitzgs.training.events.evaluate import measure
from blitzgs.training.inputs import open_capture
from blitzgs.training.records import peak_memory_bytes, population_report
from blitzgs.training.trainer import Trainer
from blitzgs.view.views import Space, ViewSet, render_options
from blitzgs.view.visible import Subject

# Image counts at which gsplat's results are commonly quoted. Training views are measured there and at the
# end.
QUOTED_STEPS = (7_000, 15_000)
Measure = Callable[[Sequence[int]], dict[str, Any]]


class Recorder:
    """Measures a model several times while it is trained, and keeps the figures.

    Memory is that of the training, without evaluations.
    """

    def __init__(
        self, spec: RunSpec, quoted: Sequence[int], end: int, capture: Any, device: torch.device
    ) -> None:
        """Plan the evaluations; training views are measured at the image counts `quoted` and `end`, too."""
        self.quoted = {images for images in quoted if images < end} | {end}
        self.marks = sorted({images for images in spec.evaluate_at if images < end} | self.quoted)
        self.evaluations: list[dict[str, Any]] = []
        self.views: dict[str, float] = {}
        self.peak_bytes = 0
        self._capture, self._device = capture, device

    def due(self, images: int) -> bool:
        """Tell whether a planned evaluation has been reached, and drop those that have."""
        if not self.marks or images < self.marks[0]:
            return False
        self.marks = [mark for mark in self.marks if mark > images]
        return True

    def record(self, images: int, seconds: float, gaussians: int, end: bool, measure: Measure) -> None:
        """Measure held-out views, and training views if that was planned."""
        self.peak_bytes = max(self.peak_bytes, peak_memory_bytes(self._device))
        found: dict[str, Any] = {"images": images, "seconds": seconds, "gaussians": gaussians}
        capture = self._capture
        if capture.test:
            metrics = measure(capture.test)
            found["test"] = means_of(metrics)
            self.views = {name: view["psnr"] for name, view in metrics["views"].items()}
        if end or images in self.quoted or not capture.test:
            found["train"] = means_of(measure(capture.train))
        self.evaluations.append(found)
        text = "  ".join(
            f"{split} {found[split]['psnr']:.2f}" for split in ("test", "train") if split in found
        )
        print(f"{images:,} images, {seconds:.1f} s, {gaussians:,} Gaussians: {text}", flush=True)
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self._device)


def means_of(metrics: dict[str, Any]) -> dict[str, float]:
    """Return the mean of each metric over the views.

    ValueError: no view can be measured, or the model is broken, and a mean is not finite.
    """
    if not metrics["views"]:
        raise ValueError("nothing can be measured: all pixels of the views are masked")
    means = {name: float(metrics[name]) for name in METRICS if name in metrics}
    if not all(torch.tensor(value).isfinite() for value in means.values()):
        raise ValueError(f"the training diverged: {means}")
    return means


class RecordedTrainer(Trainer):
    """A trainer that measures its model during training, and saves no checkpoint."""

    recorder: Recorder
    lpips: Lpips | None
    population: dict[str, Any]  # `population_report` of the finished run

    def step(self, step: int) -> None:
        """Take a step; if planned, measure before the schedule's events."""
        super().step(step)
        if step < self.state.schedule.steps and self.recorder.due(self.state.images_seen):
            self._record(end=False)

    def finish(self, agreement: Agreement) -> dict[str, Any]:
        """Measure the trained model."""
        self._record(end=True)
        self.population = population_report(self.state, self.memory)
        # The report has the peak since the last evaluation, because the recorder resets the device's count.
        self.population["peak_memory_bytes"] = self.state.ranks.all_gather_object(self.recorder.peak_bytes)
        return {}

    def _record(self, end: bool) -> None:
        state = self.state
        begin = time.monotonic()
        synchronize(state.ranks.device)
        # The run's clock has the time until the host had queued the step. Add the time until the GPU ends it.
        seconds = state.progress.seconds + time.monotonic() - begin
        with state.paused_clock():
            self.recorder.record(
                state.images_seen, seconds, state.population(), end,
                lambda indices: measure(state, indices, None, self.lpips),
            )  # fmt: skip


def train_ours(spec: RunSpec, ranks: Ranks) -> dict[str, Any]:
    """Train with BlitzGS."""
    config = spec.config()
    capture, images = open_capture(config, ranks)
    with tempfile.TemporaryDirectory() as folder:
        shared = Path(ranks.broadcast_object(folder))  # all ranks are on one host
        trainer = RecordedTrainer(config, capture, images, shared, ranks)
        schedule = trainer.state.schedule
        recorder = Recorder(spec, (), schedule.iterations, capture, ranks.device)
        trainer.recorder, trainer.lpips = recorder, load_lpips(spec.lpips)
        if trainer.train() is None:
            raise InterruptedError("stopped by a signal")
    return figures(recorder, trainer.state.progress.peak_gaussians) | {
        "population": trainer.population,
        "largest_fall": trainer.state.curve.fall,
    }


def train_opponent(spec: RunSpec, ranks: Ranks) -> dict[str, Any]:
    """Train with one of gsplat's strategies."""
    assert spec.strategy is not None
    config, options = spec.config(), spec.options()
    capture, images = open_capture(config, ranks)
    trainer = GsplatTrainer(spec.strategy, options, capture, images, ranks.device, spec.seed)
    lpips, owners = load_lpips(spec.lpips), TileOwners(ranks)

    def measure_now(indices: Sequence[int]) -> dict[str, Any]:
        subject = Subject(trainer.table(), trainer.render_options, trainer.space, None)
        return evaluate(subject, trainer.views, capture.cameras, images, indices, None, owners, lpips=lpips)

    quoted = [options.scaled(step) for step in QUOTED_STEPS]
    recorder, seconds = Recorder(spec, quoted, trainer.total, capture, ranks.device), 0.0
    for mark in recorder.marks:
        seconds += seconds_of(ranks.device, partial(trainer.train_to, mark))
        count = len(trainer.params["means"])
        recorder.record(mark, seconds, count, mark == trainer.total, measure_now)
    return figures(recorder, trainer.peak)


def train_partition(spec: RunSpec, ranks: Ranks) -> dict[str, Any]:
    """Train the blocks of a grid one after the other, and measure the model that they are merged to."""
    config, shape = spec.config(), spec.grid
    assert shape is not None
    capture, images = open_capture(config, ranks)
    begin = time.monotonic()
    grid = spatial_partition.Grid(capture, *shape)
    blocks = spatial_partition.divide(capture, grid)
    split_seconds = time.monotonic() - begin
    merged = spatial_partition.train(config, capture, images, ranks, grid, blocks)
    space = Space.of(capture.offset, capture.extent)
    views = ViewSet(capture.cameras, space, ranks.device)
    lpips, owners = load_lpips(spec.lpips), TileOwners(ranks)

    def measure_now(indices: Sequence[int]) -> dict[str, Any]:
        subject = Subject(merged.table, render_options(config, space, merged.sh_degree), space, None)
        return evaluate(subject, views, capture.cameras, images, indices, None, owners, lpips=lpips)

    done = sum(block["images"] for block in merged.blocks)
    seconds = split_seconds + merged.merge_seconds + sum(block["seconds"] for block in merged.blocks)
    recorder = Recorder(spec, (), done, capture, ranks.device)
    recorder.record(done, seconds, len(merged.table), True, measure_now)
    return figures(recorder, max(block["peak"] for block in merged.blocks)) | {
        "blocks": merged.blocks,
        "coverage": spatial_partition.coverage(capture, blocks),
        "split_seconds": split_seconds,
        "merge_seconds": merged.merge_seconds,
    }


def figures(recorder: Recorder, peak_gaussians: int) -> dict[str, Any]:
    """Return the figures of a finished run."""
    last = recorder.evaluations[-1]
    return {
        "images": last["images"],
        "seconds": last["seconds"],
        "images_per_second": last["images"] / max(last["seconds"], 1e-9),
        "gaussians": last["gaussians"],
        "peak_gaussians": max(peak_gaussians, last["gaussians"]),
        "peak_memory_bytes": recorder.peak_bytes,
        "evaluations": recorder.evaluations,
        "views": recorder.views,
    }


def named_from_root(source: str) -> str:
    """Return the path of a recipe of this repository from its root; any other source as it is."""
    path = Path(source).resolve()
    return str(path.relative_to(ROOT)) if path.is_file() and path.is_relative_to(ROOT) else source


def describe(spec: RunSpec) -> dict[str, Any]:
    """Return the part of a result that describes its run, finished or failed."""
    return {
        "name": spec.name,
        "capture": spec.capture,
        "recipe": spec.recipe,
        "seed": spec.seed,
        "ranks": spec.ranks,
        "settings": spec.settings,
        "source": named_from_root(spec.source),
        "overrides": [*spec.data[1:], *spec.overrides],
        "commit": commit(),
    }


def write(path: Path, result: dict[str, Any]) -> None:
    """Write a result; a file that exists is complete."""
    partial = path.with_suffix(".part")
    partial.write_text(json.dumps(result))
    partial.replace(path)


def work(result: dict[str, Any], path: Path, train: Callable[[], dict[str, Any]]) -> int:
    """Add to a result what a training returns, or its error; rank 0 writes it. Returns the exit status."""
    try:
        result |= {"status": "done"} | train()
    except Exception as error:
        traceback.print_exc()
        result |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
    if os.environ.get("RANK", "0") == "0":
        write(path, result)
    return 0 if result["status"] in ("done", "stopped") else 1


def main(arguments: Sequence[str]) -> int:
    """Do one run; returns the exit status."""
    spec_path, result_path = map(Path, arguments)
    spec = RunSpec(**json.loads(spec_path.read_text()))
    result, begin = describe(spec), time.monotonic()

    def run() -> dict[str, Any]:
        train = train_ours if spec.strategy is None else train_opponent
        try:
            with Ranks.from_environment(spec.device) as ranks:
                found = (train if spec.grid is None else train_partition)(spec, ranks)
        finally:
            result["wall_seconds"] = time.monotonic() - begin
        return {"environment": environment(spec.device)} | found

    return work(result, result_path, run)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
