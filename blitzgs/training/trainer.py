# SPDX-License-Identifier: Apache-2.0
"""The training loop: batches in, a model out."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileOwners
from blitzgs.model import GaussianTable
from blitzgs.ops.density_stats import density_stats_
from blitzgs.pipeline import Frame
from blitzgs.population.density import DensityRules, densify
from blitzgs.population.initialisation import octree_gaussians
from blitzgs.population.redistribution import redistribute
from blitzgs.scene.capture import Capture
from blitzgs.training import run
from blitzgs.training.batches import Batch, BatchLoader, Images
from blitzgs.training.config import Config
from blitzgs.training.config_io import config_hash, save_config
from blitzgs.training.evaluation import evaluate, load_lpips
from blitzgs.training.guard import LossGuard, StopRequest, check_table
from blitzgs.training.loss import batch_psnr, photometric, scale_term
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.run import Progress
from blitzgs.training.run_log import RunLog
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.schedule import Event, Schedule
from blitzgs.training.step import Stepper
from blitzgs.training.views import Space, ViewSet, camera_centres, render_options
from blitzgs.view.blocks import morton_order
from blitzgs.view.levels import measure_levels


class Trainer:
    """One run: initialises or resumes a model of a capture and trains it to the end of the schedule.

    Attributes:
        table: this rank's Gaussians.
        progress: where the run stands.
    """

    table: GaussianTable
    progress: Progress

    def __init__(
        self,
        config: Config,
        capture: Capture,
        images: Images,
        folder: Path,
        ranks: Ranks,
        resume: bool = False,
    ) -> None:
        """Set a run up.

        Args:
            config: what to compute.
            capture: cameras and points.
            images: its photographs.
            folder: of the run; gets configuration, log, checkpoints, evaluation and summary.
            ranks: the job.
            resume: continue from the newest checkpoint in `folder`, if there is one.

        Raises:
            FileExistsError: the folder holds a trained run and `resume` is not set.
            ConfigError: the run to resume was started with another configuration.
            MismatchError: the ranks differ in configuration, code or capture.
        """
        self.config, self.capture, self.images = config, capture, images
        self.folder, self.ranks = folder, ranks
        run.check_alike(config, capture, ranks)
        self.schedule = Schedule(config.schedule)
        self.space = Space.of(capture.offset, capture.extent)
        self._lpips = load_lpips(config.log.lpips_weights)
        if not resume and any((folder / run.CHECKPOINTS).glob("*")):
            raise FileExistsError(
                f"{folder} already holds a run: add --resume to continue it, or choose another --out"
            )
        restored = run.restore(folder, ranks) if resume else None
        if restored is None:
            self._initialise()
        else:
            self.table, self.progress, space, saved = restored
            run.check_resumable(saved, config)
            run.check_capture(space, capture, folder)
        if ranks.rank == 0:
            folder.mkdir(parents=True, exist_ok=True)
            save_config(config, folder / run.CONFIG)
        self._optimiser = LazyAdam(config.optimiser, self.schedule, self.space.extent, ranks.device)
        self._views = ViewSet(list(capture.cameras), self.space, ranks.device)
        sizes = [(camera.width, camera.height) for camera in capture.cameras]
        sampler = BatchSampler([sizes[i] for i in capture.train], self.schedule.batch_size, config.seed)
        self._owners = TileOwners(ranks)
        self._loader = BatchLoader(
            images,
            self._views,
            capture.train,
            sampler,
            ranks.device,
            config.data.prefetch,
            self._owners if ranks.world_size > 1 else None,
        )
        self._length_unit = self.space.extent * config.loss.scale_reference
        self._stepper = Stepper(
            self.table,
            self._optimiser,
            self._owners,
            config.loss,
            self._length_unit,
            config.ranks.half_exchange,
        )
        self._guard = LossGuard()

    def _initialise(self) -> None:
        """Make the first Gaussians from the capture's points; each rank keeps its share."""
        config, lod = self.config, self.config.lod
        points = torch.from_numpy(self.capture.points) / self.space.unit
        centres = camera_centres([self.capture.cameras[i] for i in self.capture.train], self.space)
        centres = centres.to(self.ranks.device)
        levels = measure_levels(points.to(self.ranks.device), centres, lod.fork, lod.base_resolution)
        table = octree_gaussians(
            points,
            torch.from_numpy(self.capture.colors),
            centres,
            levels,
            visible_threshold=lod.visible_threshold,
            sh_degree=config.model.sh_degree,
            opacity=config.model.initial_opacity,
        )
        count = len(table)
        table.keep(torch.arange(count) % self.ranks.world_size == self.ranks.rank)
        self.table = GaussianTable({name: table[name].to(self.ranks.device) for name in table})
        self._sort()
        self.progress = Progress(
            step=0, sh_degree=0, level_count=levels.count, peak_gaussians=count, seconds=0.0
        )

    @torch.no_grad()
    def train(self) -> dict[str, Any] | None:
        """Train to the end, evaluate, and write the summary.

        Returns:
            The summary; None when the run was asked to stop early (it then saved a checkpoint to resume
            from).

        Raises:
            NonFiniteError: a loss or a parameter stopped being finite.
        """
        size, done = self.schedule.batch_size, self.progress.step
        log_folder = self.folder if self.ranks.rank == 0 else None
        log = RunLog(log_folder, self.schedule.iterations, done * size, self.config.log.tensorboard)
        self._clock = time.monotonic() - self.progress.seconds
        try:
            with StopRequest() as stop:
                self._announce(log)
                for step in range(done + 1, self.schedule.steps + 1):
                    self._step(step, log)
                    for event in self.schedule.events((step - 1) * size, step * size):
                        self._handle(event, step, log)
                    if step < self.schedule.steps and (name := stop.agreed(step, self.ranks)):
                        self._save()
                        text = f"stopped by {name}; continue with --resume"
                        log.event(step * size, "stopped", {"signal": name}, text)
                        return None
            return self._finish(log)
        finally:
            self._loader.close()
            log.close()

    def _announce(self, log: RunLog) -> None:
        views = {"train": len(self.capture.train), "test": len(self.capture.test)}
        text = (
            f"{self._population():,} Gaussians on {self.progress.level_count} levels; "
            f"{views['train']} training views, {views['test']} held out"
        )
        if self.ranks.world_size > 1:
            text += f"; {self.ranks.world_size} ranks, transport {self.ranks.transport}"
        values = views | run.versions(self.ranks.device) | {"transport": self.ranks.transport}
        log.event(self.progress.step * self.schedule.batch_size, "start", values, text)

    def _step(self, step: int, log: RunLog) -> None:
        """Take one optimiser step (from 1)."""
        config, begin = self.config, (step - 1) * self.schedule.batch_size
        batch = self._loader.get(step - 1, self.schedule.steps)
        degree = self.schedule.sh_degree(begin, config.model.sh_degree)
        options = render_options(config, self.space, degree)
        frame, terms, sums = self._stepper.forward(step, options, batch)
        names = [self.capture.cameras[i].name for i in batch.indices]
        self._guard.check(step, names, sums, self.table, frame)
        report = None
        if self._crosses(begin, config.log.every):
            report = self._measure(frame, batch)
        densifies = begin < config.schedule.densify_until * config.schedule.scale
        v_means2d = self._stepper.backward(step, frame, terms, keep_means2d=densifies)
        if v_means2d is not None:
            self._gather(frame, v_means2d)
        self.progress = dataclasses.replace(
            self.progress, step=step, sh_degree=degree, seconds=time.monotonic() - self._clock
        )
        if report is not None:
            check_table(self.table, step)
            losses = photometric(sums.read()[: 2 * len(names)], batch.samples.cpu(), config.loss)
            self._log_step(report, losses.mean().item(), step, log)

    def _sort(self) -> None:
        """Put neighbours in space next to each other, so that blocks of rows are small."""
        self.table.permute(morton_order(self.table["means"]))

    def _crosses(self, begin: int, every: int) -> bool:
        """Whether the step at `begin` completes a multiple of `every` images."""
        return (begin + self.schedule.batch_size) // every > begin // every

    def _gather(self, frame: Frame, v_means2d: Tensor) -> None:
        rows, views = frame.rows, frame.views
        density_stats_(
            self.table["grad_sum"],
            self.table["grad_count"],
            self.table["max_radii"],
            rows.visible_ids,
            rows.row_offsets,
            v_means2d,
            rows.conics,
            views.width,
            views.height,
            float(len(views)),
        )

    def _measure(self, frame: Frame, batch: Batch) -> Tensor:
        """Return the batch's L_scale and PSNR, the visible Gaussians and all, [4]; nobody waits for them."""
        scale = scale_term(frame, self.table, self._length_unit).mean()
        counts = [
            self.ranks.all_reduce(torch.full((), float(count), dtype=torch.float64, device=scale.device))
            for count in (len(frame.rows.visible_ids), len(self.table))
        ]
        return torch.stack([scale.double(), batch_psnr(frame, batch).double(), *counts])

    def _log_step(self, report: Tensor, photometric_loss: float, step: int, log: RunLog) -> None:
        images = step * self.schedule.batch_size
        scale, psnr, visible, population = report.tolist()
        values = {
            "loss": photometric_loss + self.config.loss.scale * scale,
            "l_scale": scale,
            "psnr": psnr,
            "visible": visible,
            "gaussians": int(population),
            "images_per_second": images / max(self.progress.seconds, 1e-9),
        }
        log.scalars(images, values)

    def _population(self) -> int:
        count = torch.tensor([len(self.table)], device=self.ranks.device)
        return int(self.ranks.all_reduce(count).item())

    def _handle(self, event: Event, step: int, log: RunLog) -> None:
        if event.kind == "densify":
            self._densify(event, step, log)
        elif event.kind == "evaluate":
            self._evaluate(step, log)
        else:
            self._save()

    def _densify(self, event: Event, step: int, log: RunLog) -> None:
        population, extent = self.config.population, self.space.extent
        by_size = self.schedule.prunes_by_size(event.time)
        rules = DensityRules(
            grad_threshold=population.grad_threshold,
            clone_scale=population.clone_scale * extent,
            min_opacity=population.min_opacity,
            max_screen_radius=(population.prune_screen_radius or None) if by_size else None,
            max_scale=(population.prune_world_scale * extent or None) if by_size else None,
            max_gaussians=population.max_gaussians or None,
        )
        self._optimiser.catch_up(self.table, None, step)
        check_table(self.table, step)
        report = densify(
            self.table,
            rules,
            time=event.time,
            step=step,
            seed=self.config.seed,
            level_count=self.progress.level_count,
            ranks=self.ranks,
        )
        counts = dataclasses.asdict(report) | {"gaussians": len(self.table)}
        values = self.ranks.all_reduce(torch.tensor(list(counts.values()), device=self.ranks.device))
        counts = dict(zip(counts, values.tolist(), strict=True))
        if redistribute(self.table, self.ranks, self.config.ranks.max_imbalance):
            counts["redistributed"] = 1
            self._sort()
        self._stepper.reindex()
        self.progress = dataclasses.replace(
            self.progress, peak_gaussians=max(self.progress.peak_gaussians, counts["gaussians"])
        )
        log.event(event.time, "densify", counts)

    def _evaluate(self, step: int, log: RunLog) -> dict[str, Any]:
        """Evaluate the held-out views (the training views when there are none)."""
        paused = time.monotonic()
        self._optimiser.catch_up(self.table, None, step)
        images = step * self.schedule.batch_size
        metrics = evaluate(
            self.table,
            self._views,
            self.capture.cameras,
            self.images,
            self.capture.test or self.capture.train,
            render_options(self.config, self.space, self.progress.sh_degree),
            self.folder / run.EVALUATION / f"{images:06d}",
            TileOwners(self.ranks),
            pictures=self.config.log.pictures,
            lpips=self._lpips,
        )
        means = {name: value for name, value in metrics.items() if name != "views"}
        text = "evaluation: " + "  ".join(f"{name} {value:.4f}" for name, value in means.items())
        log.event(images, "evaluation", means, text)
        self._clock += time.monotonic() - paused
        return means

    def _save(self) -> None:
        run.save(self.folder, self.table, self.progress, self.space, self.config, self.ranks)

    def _finish(self, log: RunLog) -> dict[str, Any]:
        step = self.progress.step
        self._optimiser.catch_up(self.table, None, step)
        check_table(self.table, step)
        self._save()
        images = step * self.schedule.batch_size
        summary = self._evaluate(step, log) | {
            "images": images,
            "seconds": self.progress.seconds,
            "images_per_second": images / max(self.progress.seconds, 1e-9),
            "gaussians": self._population(),
            "peak_gaussians": self.progress.peak_gaussians,
            "peak_memory_bytes": run.peak_memory_bytes(self.ranks.device),
            "config_hash": config_hash(self.config),
            "versions": run.versions(self.ranks.device),
        }
        if self.ranks.rank == 0:
            (self.folder / run.SUMMARY).write_text(json.dumps(summary, indent=1))
        return summary
