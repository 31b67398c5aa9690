# SPDX-License-Identifier: Apache-2.0
"""Sets up a run: checks that the ranks agree, makes or restores the Gaussians, builds the other objects."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from blitzgs.capture.capture import Capture, train_views_fingerprint
from blitzgs.capture.images import ImageStore
from blitzgs.config.fields import BLACK, FORK, Config
from blitzgs.config.files import save_config
from blitzgs.config.schedule import Schedule, stretched
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import is_antialiased
from blitzgs.formats.models import read_gaussians, with_degree
from blitzgs.frame.ownership import TileOwners
from blitzgs.ops.population import limit_scales_
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.initialisation import INITIAL_OPACITY, octree_gaussians
from blitzgs.population.relocation import PositionNoise
from blitzgs.runs import run_files
from blitzgs.runs.cameras import SHARED_EXPOSURES, save_cameras, warn_of_changes
from blitzgs.runs.folder_checks import check_room, check_unclaimed, check_writable
from blitzgs.runs.log import RunLog
from blitzgs.runs.resume import check_resumable, decided_as, with_pace_of
from blitzgs.runs.trained_model import Progress, TrainedModel, restore
from blitzgs.runs.world import check_seen, gate_of, save_world_frame, trained_columns
from blitzgs.spawn.gate import lineage_subject, open_spawn_gate
from blitzgs.spawn.lineage import Ledger, Lineage, initial_births
from blitzgs.table.blocks import sort_rows
from blitzgs.table.host_table import HostTable
from blitzgs.table.pool import Pool
from blitzgs.table.table import GaussianTable
from blitzgs.training.agreement import SaveClock
from blitzgs.training.budget import extended
from blitzgs.training.exposure import Exposures, exposures_differ, track_gains
from blitzgs.training.inputs import check_alike, check_capture, check_resolution, mean_colour
from blitzgs.training.loss import weighted
from blitzgs.training.offload import OffloadingStepper, UpcomingCameras
from blitzgs.training.sampler import BatchSampler, tour_of
from blitzgs.training.state import Curve, TrainingState
from blitzgs.training.step import Stepper
from blitzgs.training.view_level import forget_views
from blitzgs.util.errors import located, warn
from blitzgs.view.levels import Levels, measure_levels
from blitzgs.view.views import Space, ViewSet, trained_centres


def set_up(
    config: Config,
    capture: Capture,
    images: ImageStore,
    folder: Path,
    ranks: Ranks,
    resume: bool,
    extend: float | None = None,
    lap: Callable[[str], None] = lambda _: None,
) -> TrainingState:
    """Make the state of a new run, or restore the state of the run in `folder`.

    `resume`: continue from the newest checkpoint in `folder`, if there is one. `extend`: with `resume`, train
    a finished run longer, see `budget.extended`. `lap` is called with the name of each part of this work at
    its end (`Laps.lap`).

    FileExistsError: the folder holds a trained run and `resume` is not set, or files of another program.
    ConfigError: the run to resume was started with another configuration. GateError: the spawn gate cannot be
    read, or differs from that of the run to resume. MismatchError: the ranks differ in configuration, code or
    capture. FolderError: a rank cannot write to the folder, or the disk has too little space.
    """
    # Everything that may refuse the run comes before the first file is written, so that a refused run leaves
    # its folder as it was. The ranks are compared before they work together, and the folder is checked before
    # a checkpoint is read from it.
    check_alike(config, capture, ranks, resume, extend)
    check_resolution(config, capture)
    check_unclaimed(folder, resume)
    check_writable(folder / run_files.CHECKPOINTS, ranks)
    space = Space.of(capture.offset, capture.extent)
    lap("checks")
    home = torch.device("cpu") if config.memory.resident_gb > 0 else ranks.device
    restored = restore(folder, ranks, home) if resume else None
    # Photographs may be lost or found again after a checkpoint (`data.allow_missing`). What it has by the
    # index of a training view would then belong to other views.
    train_views = train_views_fingerprint(capture)
    same_views = restored is None or restored.progress.train_views in ("", train_views)
    config = _resolved(config, capture, images, ranks, restored, same_views)
    config = _continued(config, restored, extend)
    schedule = Schedule(config.schedule)
    if restored is None:
        table, progress = first_gaussians(config, capture, space, ranks, home)
    else:
        table, progress = restored.table, restored.progress
        check_capture(restored.space, capture, folder)
        if ranks.rank == 0:
            warn_of_changes(folder, capture)
    lap("gaussians")
    if not same_views:
        forget_views(table, progress, capture, ranks)
    progress.train_views = train_views
    # The spawn gate is compared with that of the checkpoint.
    veto, progress.gate = open_spawn_gate(config, capture, ranks, progress.gate)
    is_saved = restored is not None and progress.step >= schedule.steps and not progress.events_left
    if not is_saved:
        check_room(folder, table, ranks, config.population.max_gaussians)

    run_id = restored.run_id if restored is not None else ranks.broadcast_object(secrets.token_hex(4))
    if ranks.rank == 0:
        save_config(config, folder / run_files.CONFIG)
        if restored is None or not (folder / run_files.CAMERAS).exists():
            save_cameras(folder, capture, run_id)
        if restored is None and capture.about.frame is not None:
            save_world_frame(folder, capture.about.frame)
    optimiser = TableAdam(config.optimiser, schedule, space.extent, ranks.device)
    # Tensors that are the same on all ranks: costs of tiles, and exposures.
    shared = {} if restored is None or not same_views else restored.shared
    owners = TileOwners(ranks)
    if "bounds" in shared and ranks.world_size > 1:
        owners.restore(shared)
    views = ViewSet(capture.cameras, space, ranks.device)
    sampler = _sampler(config, capture, schedule)
    if config.memory.resident_gb > 0:
        if restored is not None and restored.config.memory.resident_gb == 0:
            sort_rows(table)  # as events do for a table in host memory
        table = HostTable(table.release(), pinned=ranks.device.type == "cuda")
    upcoming = UpcomingCameras(sampler, capture.train, views)
    stepper = _stepper(config, table, optimiser, owners, space.extent, upcoming)
    if config.model.exposure:
        stepper.exposures = _exposures(capture, images, ranks, restored, same_views)
    lineage = _start_lineage(config, capture, folder, table, progress, ranks)
    lap("table")
    return TrainingState(
        config=config,
        capture=capture,
        images=images,
        folder=folder,
        ranks=ranks,
        schedule=schedule,
        space=space,
        table=table,
        progress=progress,
        views=views,
        sampler=sampler,
        optimiser=optimiser,
        stepper=stepper,
        owners=owners,
        run_id=run_id,
        origin=_origin(restored, resume, folder, schedule),
        save_clock=SaveClock(config.log.checkpoint_seconds),
        veto=veto,
        lineage=lineage,
        is_saved=is_saved,
        curve=Curve(**progress.curve),
        log=RunLog(None, schedule.iterations, progress.step * schedule.batch_size, tensorboard=False),
    )


def _resolved(
    config: Config,
    capture: Capture,
    images: ImageStore,
    ranks: Ranks,
    restored: TrainedModel | None,
    same_views: bool,
) -> Config:
    """Return `config` with the values that depend on the training views and on what the run has measured.

    The depths of what the views see decide on the near plane, the colours of the photographs on the
    background, the number of views on the length of the run and the opacity term. A run that is resumed with
    fewer or more photographs (`data.allow_missing`) keeps the values that it began with. `with_pace_of` says
    what a run measures.
    """
    saved = None if restored is None else restored.config
    if saved is not None and not same_views:
        config = decided_as(saved, config)
    model, views = config.model, len(capture.train)
    if model.near == 0:
        # Relative to the extent of this capture: a photograph that is lost later does not move the plane.
        model = replace(model, near=capture.near / capture.extent if saved is None else saved.model.near)
    if model.background is None:
        behind = _background(config, capture, images, ranks) if saved is None else saved.model.background
        model = replace(model, background=behind)
    schedule, loss = stretched(config.schedule, views), weighted(config.loss, views)
    return with_pace_of(replace(config, model=model, schedule=schedule, loss=loss), saved)


def _background(
    config: Config, capture: Capture, images: ImageStore, ranks: Ranks
) -> tuple[float, float, float]:
    """Return the background of a run that leaves it to the capture, the same on all ranks.

    It is black where photographs have alpha: `images` composites them over black.
    """
    if not config.model.random_background or capture.has_alpha:
        return BLACK
    return ranks.broadcast_object(mean_colour(capture, images) if ranks.rank == 0 else BLACK)


def _continued(config: Config, restored: TrainedModel | None, extend: float | None) -> Config:
    """Return the configuration to begin or continue a run with: `config`, or one with a longer schedule."""
    if restored is None:
        return config
    if extend is not None:
        # An interrupted extension may have left its schedule in the folder's configuration.
        config = replace(config, schedule=restored.config.schedule)
    check_resumable(restored.config, config, restored.progress.step)
    return config if extend is None else extended(config, restored.progress.step, extend)


def _exposures(
    capture: Capture,
    images: ImageStore,
    ranks: Ranks,
    restored: TrainedModel | None,
    same_views: bool,
) -> Exposures | None:
    """Return the photographs' exposures, from the checkpoint or the tracks; None if they are equal."""
    exposures = Exposures(capture.train, ranks)
    if restored is not None:
        if SHARED_EXPOSURES not in restored.shared:
            return None
        if same_views:
            exposures.restore(restored.shared)
            return exposures
    gains = track_gains(capture, images, ranks)
    if gains is None:
        return exposures
    exposures.begin_with(gains)
    return exposures if restored is not None or exposures_differ(gains) else None


def _sampler(config: Config, capture: Capture, schedule: Schedule) -> BatchSampler:
    cameras = [capture.cameras[i] for i in capture.train]
    tour = None
    if config.memory.resident_gb > 0 and config.memory.tour:
        tour = tour_of(cameras, capture.points)
    sizes = [(camera.width, camera.height) for camera in cameras]
    return BatchSampler(sizes, config.schedule.batch_size, config.seed, schedule, tour)


def _stepper(
    config: Config,
    table: GaussianTable,
    optimiser: TableAdam,
    owners: TileOwners,
    extent: float,
    upcoming: UpcomingCameras,
) -> Stepper:
    """Return a stepper for a table on the device, or one with a pool for a table on the host."""
    noise, factor = None, config.optimiser.position_noise
    if factor > 0:
        noise = PositionNoise(factor, extent, config.population.min_opacity, config.seed)
    shared = (optimiser, owners, config.loss, extent, noise, _axis_limit(config))
    if not isinstance(table, HostTable):
        return Stepper(table, *shared)
    budget = int(config.memory.resident_gb * 1e9)
    pool = Pool(table, owners.ranks.device, budget, optimiser.pending_table)
    return OffloadingStepper(pool, upcoming, *shared)


def _axis_limit(config: Config) -> float:
    """Return to which share of the extent a run's steps limit the axes of Gaussians; 0: they do not."""
    return config.population.prune_world_scale if config.model.random_background else 0.0


def _start_lineage(
    config: Config, capture: Capture, folder: Path, table: GaussianTable, progress: Progress, ranks: Ranks
) -> Lineage | None:
    """Open the log of births and deaths, for a new run or at the checkpoint's state; None if it is off."""
    if not config.population.lineage:
        return None
    about, ledger = lineage_subject(config, capture), Ledger(**progress.ledger)
    lineage = Lineage(folder / run_files.LINEAGE, ranks, progress.step, ledger, about)
    if not progress.ledger:
        lineage.born(initial_births(table["id"], table["parent"], table["means"]), progress.step)
    return lineage


def _origin(restored: TrainedModel | None, resume: bool, folder: Path, schedule: Schedule) -> str:
    if restored is not None:
        more = ""
        if Schedule(restored.config.schedule).iterations != schedule.iterations:
            more = f", extended to {schedule.iterations:,} images"
        elif restored.progress.step >= schedule.steps:
            more = ", its end (--extend trains it longer)"
        return f"resumed from {restored.source} after {restored.progress.step:,} steps{more}"
    return f"nothing to resume in {folder}: starting anew" if resume else "new run"


def first_gaussians(
    config: Config, capture: Capture, space: Space, ranks: Ranks, home: torch.device
) -> tuple[GaussianTable, Progress]:
    """Make the first Gaussians; each rank keeps its share of them at `home`."""
    device = ranks.device
    points = torch.from_numpy(capture.points).to(device) / space.unit
    # Cameras that are far from the others would stretch the octree over distances that no photograph covers.
    together = [i for i in capture.train if i not in capture.apart] or capture.train
    centres = trained_centres([capture.cameras[i] for i in together], space).to(device)
    levels = measure_levels(points, centres, FORK)
    if config.model.start:
        table, count, degree = _of_file(config, capture, space, ranks, home, levels)
        found = count
    else:
        first = octree_gaussians(
            points, torch.from_numpy(capture.colors).to(device), centres, levels,
            config.lod.visible_threshold, most=config.population.max_gaussians, seed=config.seed,
        )  # fmt: skip
        # A row of the table has some 750 bytes, so each rank makes only its own rows, on its device.
        share = slice(ranks.rank, None, ranks.world_size)
        table = first.table(config.model.sh_degree, INITIAL_OPACITY, home, share)
        count, degree, found = len(first), 0, first.found
    sort_rows(table)
    return table, Progress(
        step=0,
        sh_degree=degree,
        level_count=levels.count,
        peak_gaussians=count,
        seconds=0.0,
        milestones={"initial": count} | ({"found": found} if found > count else {}),
        reference_distance=levels.reference_distance,
    )


def _of_file(
    config: Config, capture: Capture, space: Space, ranks: Ranks, home: torch.device, levels: Levels
) -> tuple[GaussianTable, int, int]:
    """Return a table of this rank's Gaussians of `model.start`, their number on all ranks, and degree.

    All have level 0, unless the file has the levels of this run.
    """
    path, degree, most = Path(config.model.start), config.model.sh_degree, config.population.max_gaussians
    found = read_gaussians(path)
    count, known = len(found), min(found.degree, degree)
    if count == 0 or 0 < most < count:
        limit = f"population.max_gaussians is {most:,}" if count else "a training needs some"
        raise ValueError(f"{path} (model.start) holds {count:,} Gaussians: {limit}")
    check_seen(found, path, capture)
    if (marked := is_antialiased(found)) != config.model.antialiased and ranks.rank == 0:
        how, other = ("is", "without") if marked else ("is not", "with")
        warn(
            f"{path} {how} marked as trained with antialiasing, and this run trains {other} it: "
            f"--model.antialiased={str(marked).lower()} keeps the file's look"
        )
    with located(str(path)):
        gate, _ = gate_of(found, space.unit)
    if (
        gate is None
        or (gate.count, gate.fork) != (levels.count, levels.fork)
        or not math.isclose(gate.reference_distance, levels.reference_distance, rel_tol=0.01)
    ):
        found = replace(found, levels=None)
    columns = trained_columns(with_degree(found, degree), space, ranks)
    if (share := _axis_limit(config)) > 0:
        limited, rows = columns["scales"].clone(), torch.arange(len(columns["id"]), dtype=torch.int32)
        limit_scales_(limited, columns["means"], rows, share=share, extent=space.extent)
        larger = sum(ranks.all_gather_object(int((limited < columns["scales"]).any(1).sum())))
        if larger and ranks.rank == 0:
            warn(
                f"{larger:,} of the {count:,} Gaussians of {path} have axes longer than this run's limit and "
                "are made smaller, which may open holes that training has to close: "
                "--population.prune_world_scale=0 keeps them"
            )
    return GaussianTable.create({name: column.to(home) for name, column in columns.items()}), count, known
