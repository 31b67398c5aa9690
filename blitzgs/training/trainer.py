# SPDX-License-Identifier: Apache-2.0
"""The training loop."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore, PhotographError
from blitzgs.config.fields import Config
from blitzgs.config.files import save_config
from blitzgs.config.schedule import Event
from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import Frame
from blitzgs.ops.population import density_stats_
from blitzgs.population.importance import PHI
from blitzgs.runs import run_files
from blitzgs.runs.guard import LossGuard, ModelLostError
from blitzgs.runs.log import RunLog
from blitzgs.spawn.gate import lineage_subject
from blitzgs.table.pool import PoolError
from blitzgs.training import view_level
from blitzgs.training.agreement import MAX_STEPS, Agreement, StopRequest
from blitzgs.training.batches import MAX_MASKED, BatchLoader
from blitzgs.training.budget import Budget
from blitzgs.training.events import evaluate, handle_all, save
from blitzgs.training.events.evaluate import Glances
from blitzgs.training.inputs import is_opaque
from blitzgs.training.records import (
    describe,
    log_step,
    measure_step,
    memory_bytes,
    population_report,
    run_figures,
    versions,
    write_picture,
)
from blitzgs.training.setup import set_up
from blitzgs.training.understood import hints_of, largest_size
from blitzgs.training.watching import Watching
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file
from blitzgs.util.progress import Laps
from blitzgs.view.look import Watcher
from blitzgs.view.views import render_options


class Trainer:
    """Trains a model of a capture, from the start or from a checkpoint, to the end of the schedule."""

    def __init__(
        self,
        config: Config,
        capture: Capture,
        images: ImageStore,
        folder: Path,
        ranks: Ranks,
        resume: bool = False,
        extend: float | None = None,
        laps: Laps | None = None,
    ) -> None:
        """Set up the run; `laps` goes on until the first step; others as for `training.setup.set_up`."""
        begin, self._laps = time.monotonic(), laps or Laps()
        random_background = config.model.random_background and ranks.rank == 0 and is_opaque(capture)
        self.state = state = set_up(config, capture, images, folder, ranks, resume, extend, self._laps.lap)
        state.add_stage("setup", time.monotonic() - begin)
        self.warned: list[str] = []  # texts of warnings, which the log takes over at the end
        self._saves_first = extend is not None
        self.loader = BatchLoader(
            images,
            state.views,
            capture.train,
            state.sampler,
            ranks.device,
            owners=state.owners if ranks.world_size > 1 else None,
            random_background=ranks.broadcast_object(random_background),
        )
        self._guard = LossGuard()
        self._warned_of_masks = False
        self._watching = Watching(state, None)
        self.memory: list[int] = []  # samples of what this rank's GPU has allocated

    def watch(self, watcher: Watcher | None) -> None:
        """Let somebody watch the training; every rank calls this before `train`, rank 0 with a watcher."""
        self._watching = Watching(self.state, watcher)

    @torch.no_grad()
    def train(self) -> dict[str, Any] | None:
        """Train to the end, evaluate, and write the summary.

        Returns the summary; None if the run was asked to stop early. It has then saved a checkpoint to resume
        from. NonFiniteError: a loss or a parameter is not finite. PhotographError: a photograph cannot be
        read; the steps before it are saved. ModelLostError: no Gaussian is left. PoolError: the Gaussians
        that a step or an event needs do not fit into the pool of `memory.resident_gb`; with one rank, the
        steps before it are saved. CheckpointError: the model could not be saved, although the run waited for
        disk space.
        """
        state = self.state
        folder = state.folder if state.ranks.rank == 0 else None
        board = state.config.log.tensorboard
        state.log = RunLog(folder, state.schedule.iterations, state.images_seen, board, state.run_id)
        state.log.listener = self._watching.told
        state.start_clock()
        try:
            with StopRequest() as stop:
                agreement = Agreement(state.ranks, stop, state.save_clock, self._watching.wants)
                state.stops = lambda: agreement.now(state.progress.step).signal is not None
                if not self._take_steps(agreement):
                    return None
                self._check_photographs()
                return self.finish(agreement)
        except PhotographError as error:  # on every rank
            self._stop(f"saved after {state.images_seen:,} images, before a photograph that cannot be read")
            what = "mask" if "the mask " in str(error) else "photograph"
            raise PhotographError(
                f"{error}. The model so far is saved: put the {what} back and continue with --resume, or "
                "leave damaged ones out with --data.allow_missing=true"
            ) from error
        finally:
            state.stops = lambda: False
            self.close()

    def _take_steps(self, agreement: Agreement) -> bool:
        """Take the steps that are left, with their events; False: a signal has stopped the run, now saved."""
        state, done, size = self.state, self.state.progress.step, self.state.schedule.batch_size
        self._announce()
        if self._saves_first:  # so that --resume knows the longer schedule
            save.save_checkpoint(state)
        budget, glances = Budget(state), Glances(state)
        # What a stop kept from happening after the last step comes first.
        if not handle_all(state, [Event(*entry) for entry in state.progress.events_left]):
            return self._stop_by(agreement.now(done).signal)
        # The budget may change the number of steps.
        while (step := state.progress.step + 1) <= state.schedule.steps:
            with self._saved_for_lack_of_room("a step", is_saved=step == done + 1):
                self.step(step)
            if step == done + 1:
                self._laps.lap("first step")
                state.log.event(step * size, "setup", self._laps.seconds, self._laps.text())
            with self._saved_for_lack_of_room("an event"):
                all_ran = handle_all(state, state.schedule.events((step - 1) * size, step * size))
            if not all_ran:
                return self._stop_by(agreement.now(step).signal)
            budget.after(step)
            glances.after((step - 1) * size, step * size)
            if step == state.schedule.steps:
                break
            decision = agreement.after(step, self.loader.lost is not None)
            if decision.signal is not None:
                return self._stop_by(decision.signal)
            if decision.lost:
                break
            if decision.save:
                with state.stage("checkpoint"):
                    save.save_checkpoint(state)
            if decision.written:
                with state.stage("checkpoint"):
                    save.finish_checkpoint(state)
            if decision.watched:
                self._watching.serve(state.stops)
        return True

    @contextlib.contextmanager
    def _saved_for_lack_of_room(self, what: str, is_saved: bool = False) -> Iterator[None]:
        """Save the model, unless it `is_saved`, if `what` does not fit into the pool (PoolError)."""
        try:
            yield
        except PoolError as error:
            state = self.state
            if is_saved or state.ranks.world_size > 1:
                raise  # with several ranks, the others are in the middle of the step or event
            self._stop(f"saved after {state.images_seen:,} images, before {what} that lacks room")
            raise PoolError(
                f"{error}. The model so far is saved: continue with --resume and a larger memory.resident_gb"
            ) from error

    def _check_photographs(self) -> None:
        reasons = self.state.ranks.all_gather_object(self.loader.lost)
        lost = [f"rank {rank}: {reason}" for rank, reason in enumerate(reasons) if reason is not None]
        if lost:
            raise PhotographError(f"{'; '.join(lost)}. Up to {MAX_STEPS + 1} last steps went without it")

    def _stop_by(self, signal: str | None, saves: bool = True) -> Literal[False]:
        self._stop(f"stopped by {signal}; continue with --resume", saves)
        return False

    def _stop(self, reason: str, saves: bool = True) -> None:
        """Save a checkpoint, and log why the run stops."""
        if saves:
            save.save_last(self.state, save.STOPPING_PATIENCE_SECONDS, lambda: False)
        self.state.log.event(self.state.images_seen, "stopped", {"reason": reason}, reason)

    def close(self) -> None:
        """Stop loading batches and close the log."""
        state = self.state
        self._watching.close()
        for text in dict.fromkeys(self.warned):
            state.log.event(state.images_seen, "warned", {"warning": text})
        for opened in (self.loader, state.log, state.lineage):
            if opened is not None:
                opened.close()

    def step(self, step: int) -> None:
        """Take optimiser step number `step` (from 1), without the schedule's events."""
        state, config, schedule = self.state, self.state.config, self.state.schedule
        begin, end = (step - 1) * schedule.batch_size, step * schedule.batch_size
        reduction = self._follow_resolution(step)
        try:
            batch = self.loader.get(step - 1, schedule.steps)
        except (OSError, ValueError) as error:
            raise PhotographError(str(error)) from error
        # Gaussians of a file (model.start) begin with the degree that they have.
        degree = max(state.progress.sh_degree, schedule.sh_degree(begin, config.model.sh_degree))
        view_level.follow_schedule(state, begin)
        view_filter = view_level.batch_gate(state, batch.indices)
        options = render_options(config, state.space, degree, state.progress.lod_gate(config))
        frame, terms, sums = state.stepper.forward(step, options, batch, view_filter=view_filter)
        names = [state.capture.cameras[i].name for i in batch.indices]
        self._guard.check(step, names, sums, state.stepper.table, frame)
        is_logged = end // config.log.every > begin // config.log.every
        figures = measure_step(state, frame, batch) if is_logged else None
        v_means2d = state.stepper.backward(step, frame, terms, schedule.gathers_statistics(begin))
        if v_means2d is not None:
            self._add_statistics(frame, v_means2d, reduction)
        state.stepped(step, degree)
        state.log.advance(end)
        if figures is not None:
            if state.ranks.device.type == "cuda":
                self.memory.append(memory_bytes(state.ranks.device))
            # The device has the backward pass to do while the host waits for what was measured before it.
            log_step(state, figures, sums)
        if is_logged or step == schedule.steps:
            self._check_masks()

    def _check_masks(self) -> None:
        """Warn once if masks exclude nearly all of some training views, as inverted masks do."""
        masked, read = self.loader.views_masked
        if masked and not self._warned_of_masks and self.state.ranks.rank == 0:
            self._warned_of_masks = True
            warn(
                f"{masked} of the first {read} training views are masked by more than {MAX_MASKED:.0%}: "
                "black excludes a pixel and white counts. Invert the masks if they mean the opposite, or "
                "train without them (--data.masks=false)"
            )

    def _follow_resolution(self, step: int) -> int:
        """Return by which factor the photographs of a step are reduced; report where it differs."""
        state = self.state
        reduction = state.sampler.reduction(step - 1)
        if reduction != (state.sampler.reduction(step - 2) if step > 1 else 1):
            state.curve.restart()  # reduced photographs have a higher PSNR
            share = f"1/{reduction} of the resolution" if reduction > 1 else "the full resolution"
            text = f"training compares with photographs of {share}"
            state.log.event(state.images_seen, "resolution", {"reduction": reduction}, text)
        return reduction

    def _add_statistics(self, frame: Frame, v_means2d: Tensor, reduction: int) -> None:
        """Add a step's screen-space gradients to the statistics that density control reads.

        Radii are counted in pixels of the whole photograph, and gradients do not depend on the resolution.
        """
        splats, views, table = frame.projected, frame.views, self.state.stepper.table
        conics = splats.conics if reduction == 1 else splats.conics / reduction**2
        of_splats = splats.visible_ids, splats.splat_offsets, v_means2d, conics
        phi = table[PHI] if self.state.config.population.phi and PHI in table else None
        statistics = table["grad_sum"], table["grad_count"], table["max_radii"]
        density_stats_(*statistics, *of_splats, views.width, views.height, float(len(views)), phi)

    def _announce(self) -> None:
        state, ranks = self.state, self.state.ranks
        views = {"train": len(state.capture.train), "test": len(state.capture.test)}
        images = state.schedule.iterations
        text = (
            f"{state.population():,} Gaussians on {state.progress.level_count} levels; "
            f"{views['train']} training views, {views['test']} held out; "
            f"{images:,} images, {images / views['train']:,.0f} per view"
        )
        if state.progress.step == 0 and (found := state.progress.milestones.get("found", 0)):
            most = state.config.population.max_gaussians
            text += f"; thinned from {found:,} to population.max_gaussians={most}"
        if state.config.data.downscale > 1:
            factor = f"data.downscale={state.config.data.downscale:g}"
            text += f"; images of {largest_size(state.capture)} ({factor})"
        if ranks.world_size > 1:
            text += f"; {ranks.world_size} ranks, transport {ranks.transport}"
        if state.config.schedule.minutes > 0:
            text += f"; {state.config.schedule.minutes:g} minutes of training"
        values: dict[str, Any] = views | versions(ranks.device) | {"transport": ranks.transport}
        values |= {"origin": state.origin}
        state.log.event(state.images_seen, "start", values, f"{state.origin}; {text}")
        for hint in hints_of(state):
            state.log.event(state.images_seen, "hint", {"hint": hint}, hint)

    def finish(self, agreement: Agreement) -> dict[str, Any] | None:
        """Save and evaluate the trained model; return and write the summary.

        If the run is asked to stop before the evaluation's end, it is saved and has no summary.
        """
        state, step = self.state, self.state.progress.step
        residency = state.stepper.report(whole=True)
        state.catch_up()
        if state.population() == 0:
            raise ModelLostError("no Gaussian is left: do the poses and the points belong together?")
        if not state.is_saved:
            with state.stage("final_checkpoint"):
                save.save_last(state, save.PATIENCE_SECONDS, lambda: agreement.now(step).signal is not None)
        population = population_report(state, self.memory)
        state.log.event(state.images_seen, "population", population, describe(population))
        images = state.images.memory()
        state.log.event(state.images_seen, "image_memory", dataclasses.asdict(images), str(images))
        with state.stage("evaluate"):
            metrics = evaluate.evaluate_held_out(state)
        if not metrics:
            self._stop_by(agreement.now(step).signal, saves=False)
            return None
        summary = metrics | run_figures(state, population) | residency
        summary["warnings"] = list(dict.fromkeys(summary["warnings"] + self.warned))
        if state.ranks.rank == 0:
            write_picture(state, population)
            try:
                # The pace was measured after the run first wrote its configuration.
                save_config(state.config, state.folder / run_files.CONFIG)
                if state.stepper.exposures is not None:
                    names = [state.capture.cameras[index].name for index in state.capture.train]
                    state.stepper.exposures.write(state.folder, names)
                if state.lineage is not None:
                    state.lineage.describe(lineage_subject(state.config, state.capture))
                write_file(state.folder / run_files.SUMMARY, json.dumps(summary, indent=1) + "\n")
            except OSError as error:
                warn(f"the model is saved, its summary is not: {error}")
        return summary
