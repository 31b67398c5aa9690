# SPDX-License-Identifier: Apache-2.0
"""What a training run is made of: the objects that the loop and the schedule's events share."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileOwners
from blitzgs.model import GaussianTable
from blitzgs.pipeline import RenderOptions
from blitzgs.population.candidates import Veto
from blitzgs.population.lineage import Lineage
from blitzgs.scene.capture import Capture
from blitzgs.training.adaptive import Signals
from blitzgs.training.agreement import SaveClock
from blitzgs.training.batches import Images
from blitzgs.training.config import Config
from blitzgs.training.evaluation import Lpips
from blitzgs.training.lod import lod_gate
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.run import Progress
from blitzgs.training.run_log import RunLog
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.schedule import Schedule
from blitzgs.training.step import Stepper
from blitzgs.training.views import Space, ViewSet, render_options
from blitzgs.view.blocks import morton_order


def never() -> bool:
    """Say that nothing asks the run to stop."""
    return False


@dataclass
class TrainingState:
    """One run on one rank; an event is a function `run(state, event)` that may change it.

    Attributes:
        config: what to compute.
        capture: cameras and points.
        images: the capture's photographs.
        folder: of the run; rank 0 writes most of it.
        ranks: the job.
        schedule: answers what happens when.
        space: how the trained world lies in the capture's.
        table: this rank's Gaussians.
        progress: where the run stands.
        views: all cameras of the capture, on the device.
        sampler: chooses the views of each step.
        optimiser: of the table.
        stepper: takes the optimiser steps.
        owners: knows what tiles cost, and divides them.
        lpips: the perceptual metric, or None.
        run_id: names the run in its log, over every resume.
        origin: where the run begins, in words.
        save_clock: says when the next checkpoint by wall time is due.
        veto: withholds candidates of densification from `schedule.gate_from` on, or None.
        lineage: logs births and deaths, or None.
        growth_was_limited: whether the log has said already that a limit holds growth back.
        log: where the run reports; silent until the loop opens the run's own.
        stops: whether the run has to stop soon, which long events ask every few seconds; the same answer on
            every rank. The loop that runs the events sets it.
        signals: what a run with `schedule.adaptive` has measured, or None.
        clock: monotonic seconds, that training time is counted by.
    """

    config: Config
    capture: Capture
    images: Images
    folder: Path
    ranks: Ranks
    schedule: Schedule
    space: Space
    table: GaussianTable
    progress: Progress
    views: ViewSet
    sampler: BatchSampler
    optimiser: LazyAdam
    stepper: Stepper
    owners: TileOwners
    lpips: Lpips | None
    run_id: str
    origin: str
    save_clock: SaveClock
    veto: Veto | None
    lineage: Lineage | None
    log: RunLog
    growth_was_limited: bool = False
    signals: Signals | None = None
    stops: Callable[[], bool] = never
    clock: Callable[[], float] = time.monotonic
    _started: float = field(default_factory=time.monotonic)

    @property
    def images_seen(self) -> int:
        """The clock: images trained on so far."""
        return self.progress.step * self.schedule.batch_size

    @cached_property
    def columns(self) -> dict[int, int]:
        """The place of each training camera among them, which is its column of the cull matrix."""
        return {index: column for column, index in enumerate(self.capture.train)}

    @property
    def render_options(self) -> RenderOptions:
        """How the run renders at its present spherical-harmonics degree."""
        lod = lod_gate(self.config, self.progress)
        return render_options(self.config, self.space, self.progress.sh_degree, lod)

    def start_clock(self) -> None:
        """Count training time from now on, on top of what a resumed run has already taken."""
        self._started = self.clock() - self.progress.seconds

    def stepped(self, step: int, sh_degree: int) -> None:
        """Note that optimiser step `step` (from 1) was taken at a spherical-harmonics degree."""
        seconds = self.clock() - self._started
        self.progress = replace(self.progress, step=step, sh_degree=sh_degree, seconds=seconds)

    @contextlib.contextmanager
    def paused_clock(self) -> Iterator[None]:
        """Leave what happens inside out of the training time."""
        paused = self.clock()
        try:
            yield
        finally:
            self._started += self.clock() - paused

    def change_pace(self, factor: float) -> None:
        """From now on, let `schedule.scale` count times `factor`; every rank calls this."""
        schedule = self.config.schedule
        pace = (*schedule.pace, (self.images_seen, factor))
        self.config = replace(self.config, schedule=replace(schedule, pace=pace))
        self.schedule = Schedule(self.config.schedule)
        self.optimiser.follow(self.schedule)
        self.stepper.reindex()
        self.log.total = self.schedule.iterations

    def catch_up(self) -> None:
        """Apply every pending optimiser step, so that all rows of the table can be read."""
        self.stepper.catch_up(self.progress.step)

    def sort(self) -> None:
        """Put neighbours in space next to each other, so that blocks of rows are small."""
        self.table.permute(morton_order(self.table["means"]))

    def population(self) -> int:
        """Count the Gaussians of all ranks; every rank calls this."""
        count = torch.tensor([len(self.table)], device=self.ranks.device)
        return int(self.ranks.all_reduce(count).item())
