# SPDX-License-Identifier: Apache-2.0
"""The state of a training run: the objects that the loop and the events of the schedule share."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore
from blitzgs.config.fields import Config
from blitzgs.config.files import changed
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions
from blitzgs.optim.table_adam import TableAdam
from blitzgs.runs.log import RunLog
from blitzgs.runs.trained_model import Progress
from blitzgs.spawn.candidates import Veto
from blitzgs.spawn.lineage import Lineage
from blitzgs.table.table import GaussianTable
from blitzgs.training.agreement import SaveClock
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.step import Stepper
from blitzgs.view.views import Space, ViewSet, render_options
from blitzgs.view.visible import Subject

# Log records whose mean is compared: the views of one batch differ by more than a fall.
WINDOW = 16
# A fall of the mean by so many dB below its best is reported.
FALL = 3.0


@dataclass
class Curve:
    """Means of the training PSNR in the log records of a run; the same on every rank, and saved."""

    recent: list[float] = field(default_factory=list)  # PSNR of the last `WINDOW` records, dB
    best: float | None = None  # highest mean of so many records, dB; None before there are so many
    best_at: int = 0  # images that the run had seen then
    fall: float = 0.0  # largest fall of the mean below the best one before it, dB
    fall_at: int = 0  # images that the run had seen then
    warned: bool = False  # whether the present fall has been reported

    def add(self, images: int, psnr: float) -> str | None:
        """Add a record; return a warning when the mean has fallen by `FALL` for the first time."""
        self.recent = [*self.recent[1 - WINDOW :], psnr]
        if len(self.recent) < WINDOW:
            return None
        mean = sum(self.recent) / WINDOW
        if self.best is None or mean > self.best:
            self.best, self.best_at = mean, images
        if self.best - mean > self.fall:
            self.fall, self.fall_at = self.best - mean, images
        if self.fall < FALL or self.warned:
            return None
        self.warned = True
        return self.describe()

    def restart(self) -> None:
        """Forget the best mean, because the run changes the model on purpose; the largest fall is kept."""
        self.recent, self.best = [], None

    def describe(self) -> str:
        """Return the warning about the largest fall."""
        best = self.best if self.best is not None else float("nan")
        return (
            f"training PSNR fell by {self.fall:.1f} dB, from {best:.1f} dB after {self.best_at:,} images: "
            "the run goes on unchanged. If it ends below that, train with half of optimiser.position and "
            "optimiser.opacity, or fewer Gaussians (population.max_gaussians)"
        )

    def warnings(self) -> list[str]:
        """Return the warnings for the summary."""
        return [self.describe()] if self.fall >= FALL else []


# Kinds of work during which the training clock does not run.
_UNCOUNTED = ("setup", "evaluate", "paused", "final_checkpoint")


@dataclass
class TrainingState:
    """One run on one rank; the functions of the events may change it."""

    config: Config
    capture: Capture  # cameras and points
    images: ImageStore  # the capture's photographs
    folder: Path  # folder of the run; rank 0 writes most of its files
    ranks: Ranks
    schedule: Schedule  # tells which events happen at which step
    space: Space  # maps between the trained world and the capture's world
    table: GaussianTable  # this rank's Gaussians
    progress: Progress
    views: ViewSet  # all cameras of the capture, on the device
    sampler: BatchSampler  # chooses the views of each step
    optimiser: TableAdam
    stepper: Stepper  # takes the training steps
    owners: TileOwners  # measures what tiles cost, and divides them among the ranks
    run_id: str  # identifies the run in its log, also after it is resumed
    origin: str  # describes where the run begins, for the log
    save_clock: SaveClock  # tells when the next checkpoint by wall time is due
    veto: Veto | None  # withholds candidates of densification from `schedule.gate_from` on, or None
    lineage: Lineage | None  # logs births and deaths, or None
    log: RunLog  # log of the run; it does nothing until the loop opens the run's log
    is_saved: bool = False  # whether the run was resumed at its end, which its checkpoint has
    growth_was_limited: bool = False  # whether the log has already reported that a limit holds growth back
    curve: Curve = field(default_factory=Curve)  # training PSNR of the run
    # Returns whether the run has to stop soon, the same on every rank; long events call it every few seconds.
    # The loop sets it.
    stops: Callable[[], bool] = lambda: False
    # Returns monotonic seconds, by which training time is measured.
    clock: Callable[[], float] = time.monotonic
    _started: float = field(default_factory=time.monotonic)

    @property
    def images_seen(self) -> int:
        """The number of images trained on so far, which is the run's time t."""
        return self.progress.step * self.schedule.batch_size

    @cached_property
    def columns(self) -> dict[int, int]:
        """Maps each training camera to its index among them, which is its column in the cull matrix."""
        return {index: column for column, index in enumerate(self.capture.train)}

    @property
    def render_options(self) -> RenderOptions:
        """The render options at the run's present spherical-harmonics degree."""
        lod = self.progress.lod_gate(self.config)
        return render_options(self.config, self.space, self.progress.sh_degree, lod)

    def subject(self) -> Subject:
        """Return what views of the present model are rendered from. Collective if there is an LOD gate."""
        lod = self.progress.model_gate(self.config, self.table, self.ranks)
        return Subject(self.stepper.gaussians, self.render_options, self.space, lod)

    def start_clock(self) -> None:
        """Count training time from now on, in addition to the time before a resume."""
        self._started = self.clock() - self.progress.seconds

    def stepped(self, step: int, sh_degree: int) -> None:
        """Note that optimiser step `step` (from 1) was taken at a spherical-harmonics degree."""
        progress = self.progress
        progress.step, progress.sh_degree, progress.seconds = step, sh_degree, self.clock() - self._started

    @contextlib.contextmanager
    def paused_clock(self) -> Iterator[None]:
        """Exclude the time inside this context from the training time."""
        paused = self.clock()
        try:
            yield
        finally:
            self._started += self.clock() - paused

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside this context to `progress.stages`, unless it ends with an error.

        A run that stops within an event does it again after the resume; the training time has it once.
        """
        begin = self.clock()
        yield
        self.add_stage(name, self.clock() - begin)

    def add_stage(self, name: str, seconds: float) -> None:
        """Add seconds to a kind of work in `progress.stages`."""
        stages = self.progress.stages
        stages[name] = stages.get(name, 0.0) + seconds

    def stages(self) -> dict[str, float]:
        """Return the seconds of each kind of work; "steps" is the training time that no other kind has."""
        progress = self.progress
        others = sum(seconds for name, seconds in progress.stages.items() if name not in _UNCOUNTED)
        return {"steps": max(0.0, progress.seconds - others)} | progress.stages

    def change_pace(self, factor: float) -> None:
        """Multiply `schedule.scale` by `factor` from now on; every rank calls this."""
        pace = (*self.config.schedule.pace, (self.images_seen, factor))
        self.config = changed(self.config, "schedule", pace=pace)
        self.schedule = Schedule(self.config.schedule)
        self.optimiser.follow(self.schedule)
        self.sampler.schedule = self.schedule
        self.stepper.reindex()
        self.log.total = self.schedule.iterations

    def catch_up(self) -> None:
        """Apply all pending optimiser steps, so that all rows of the table can be read."""
        self.stepper.catch_up(self.progress.step)

    def population(self) -> int:
        """Count the Gaussians of all ranks; every rank calls this."""
        return int(self.ranks.all_reduce(torch.tensor(len(self.table), device=self.ranks.device)))
