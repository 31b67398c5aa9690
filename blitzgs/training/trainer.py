# SPDX-License-Identifier: Apache-2.0
"""The training loop: batches in, a model out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.density_stats import density_stats_
from blitzgs.pipeline import Frame
from blitzgs.scene.capture import Capture
from blitzgs.training import run
from blitzgs.training.batches import BatchLoader, Images
from blitzgs.training.config import Config
from blitzgs.training.config_io import config_hash
from blitzgs.training.events import evaluate, handle, save
from blitzgs.training.guard import LossGuard, StopRequest, check_table
from blitzgs.training.run_log import RunLog
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.setup import set_up
from blitzgs.training.step_report import log_step, measure_step
from blitzgs.training.views import render_options


class Trainer:
    """One run: initialises or resumes a model of a capture and trains it to the end of the schedule.

    Attributes:
        state: what the run is made of.
    """

    def __init__(
        self,
        config: Config,
        capture: Capture,
        images: Images,
        folder: Path,
        ranks: Ranks,
        resume: bool = False,
    ) -> None:
        """Set a run up; arguments and errors are those of `blitzgs.training.setup.set_up`."""
        self.state = state = set_up(config, capture, images, folder, ranks, resume)
        sizes = [(camera.width, camera.height) for camera in capture.cameras]
        sampler = BatchSampler([sizes[i] for i in capture.train], config.schedule.batch_size, config.seed)
        self._loader = BatchLoader(
            images,
            state.views,
            capture.train,
            sampler,
            ranks.device,
            config.data.prefetch,
            state.owners if ranks.world_size > 1 else None,
        )
        self._guard = LossGuard()

    @torch.no_grad()
    def train(self) -> dict[str, Any] | None:
        """Train to the end, evaluate, and write the summary.

        Returns:
            The summary; None when the run was asked to stop early (it then saved a checkpoint to resume
            from).

        Raises:
            NonFiniteError: a loss or a parameter stopped being finite.
        """
        state, schedule, done = self.state, self.state.schedule, self.state.progress.step
        size = schedule.batch_size
        folder = state.folder if state.ranks.rank == 0 else None
        state.log = RunLog(folder, schedule.iterations, done * size, state.config.log.tensorboard)
        state.start_clock()
        try:
            with StopRequest() as stop:
                self._announce()
                for step in range(done + 1, schedule.steps + 1):
                    self.step(step)
                    for event in schedule.events((step - 1) * size, step * size):
                        handle(state, event)
                    if step < schedule.steps and (name := stop.agreed(step, state.ranks)):
                        save.run(state)
                        text = f"stopped by {name}; continue with --resume"
                        state.log.event(step * size, "stopped", {"signal": name}, text)
                        return None
            return self._finish()
        finally:
            self.close()

    def close(self) -> None:
        """Stop loading batches and close the log."""
        self._loader.close()
        self.state.log.close()

    def step(self, step: int) -> None:
        """Take one optimiser step (from 1), without the schedule's events."""
        state, config, schedule = self.state, self.state.config, self.state.schedule
        begin, end = (step - 1) * schedule.batch_size, step * schedule.batch_size
        batch = self._loader.get(step - 1, schedule.steps)
        degree = schedule.sh_degree(begin, config.model.sh_degree)
        frame, terms, sums = state.stepper.forward(step, render_options(config, state.space, degree), batch)
        names = [state.capture.cameras[i].name for i in batch.indices]
        self._guard.check(step, names, sums, state.table, frame)
        is_logged = end // config.log.every > begin // config.log.every
        measured = measure_step(state, frame, batch) if is_logged else None
        v_means2d = state.stepper.backward(
            step, frame, terms, keep_means2d=schedule.gathers_statistics(begin)
        )
        if v_means2d is not None:
            self._gather(frame, v_means2d)
        state.stepped(step, degree)
        if measured is not None:
            log_step(state, measured, batch, names, sums)

    def _gather(self, frame: Frame, v_means2d: Tensor) -> None:
        """Add a step's screen-space gradients to the statistics that density control reads."""
        rows, views, table = frame.rows, frame.views, self.state.table
        density_stats_(
            table["grad_sum"],
            table["grad_count"],
            table["max_radii"],
            rows.visible_ids,
            rows.row_offsets,
            v_means2d,
            rows.conics,
            views.width,
            views.height,
            float(len(views)),
        )

    def _announce(self) -> None:
        """Log what is about to be trained."""
        state, ranks = self.state, self.state.ranks
        views = {"train": len(state.capture.train), "test": len(state.capture.test)}
        text = (
            f"{state.population():,} Gaussians on {state.progress.level_count} levels; "
            f"{views['train']} training views, {views['test']} held out"
        )
        if ranks.world_size > 1:
            text += f"; {ranks.world_size} ranks, transport {ranks.transport}"
        values = views | run.versions(ranks.device) | {"transport": ranks.transport}
        state.log.event(state.images_seen, "start", values, text)

    def _finish(self) -> dict[str, Any]:
        """Save and evaluate the trained model; return and write the summary."""
        state = self.state
        state.catch_up()
        check_table(state.table, state.progress.step)
        save.run(state)
        summary = evaluate.run(state) | {
            "images": state.images_seen,
            "seconds": state.progress.seconds,
            "images_per_second": state.images_seen / max(state.progress.seconds, 1e-9),
            "gaussians": state.population(),
            "peak_gaussians": state.progress.peak_gaussians,
            "peak_memory_bytes": run.peak_memory_bytes(state.ranks.device),
            "config_hash": config_hash(state.config),
            "versions": run.versions(state.ranks.device),
        }
        if state.ranks.rank == 0:
            (state.folder / run.SUMMARY).write_text(json.dumps(summary, indent=1))
        return summary
