# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: what is in it, and how to open a trained model again."""

from __future__ import annotations

import dataclasses
import platform
import resource
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import blitzgs
from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.training import checkpoint
from blitzgs.training.config import Config
from blitzgs.training.config_io import ConfigError, from_dict, load_config, to_dict
from blitzgs.training.guard import bad_column, check_before_saving
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.schedule import Schedule
from blitzgs.training.views import Space
from blitzgs.view.host_table import HostTable
from blitzgs.view.residence import Residence
from blitzgs.view.seen import Scene

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"
SUMMARY = "summary.json"
EVALUATION = "evaluation"
LINEAGE = "lineage"
# Sections and fields that a resumed run may change: they decide nothing about the result beyond rounding, but
# for `data.allow_missing`, without which a run whose photograph is lost could not go on.
FREE_FIELDS = (
    "log",
    "memory",
    "ranks",
    "data.path",
    "data.allow_missing",
    "data.cache_bytes",
    "data.threads",
    "data.prefetch",
    "schedule.checkpoint_every",
    "schedule.evaluate_every",
)
# Half precision changes the result by 1e-3.
BOUND_FIELDS = ("ranks.half_exchange",)


@dataclass(frozen=True)
class Progress:
    """Where a run stands; saved with every checkpoint.

    Attributes:
        step: optimiser steps taken.
        sh_degree: spherical-harmonics degree of the last step.
        level_count: octree levels K.
        peak_gaussians: most Gaussians so far.
        seconds: of training so far, without evaluations.
        milestones: how many Gaussians there were at the points of the run that are named so.
        ledger: of the lineage (`blitzgs.population.lineage.Ledger`), where there is one.
        reference_distance: d_0 of the levels (`blitzgs.view.levels.Levels`), in the unit of the means.
        finest_level: finest level that the LOD gate keeps; None: there is no gate at this point of the run.
        gated_views: the training views, in their order, as "1" where the LOD gate holds and "0" where it
            would keep almost all; empty without a gate.
        train_views: digest of the names of the training views, in their order; empty in old checkpoints.
        signals: `blitzgs.training.adaptive.Signals.saved`, where there are any.
        gate: digest of the spawn gate's files; empty without one, and in old checkpoints.
    """

    step: int
    sh_degree: int
    level_count: int
    peak_gaussians: int
    seconds: float
    milestones: dict[str, int] = dataclasses.field(default_factory=dict)
    ledger: dict[str, int] = dataclasses.field(default_factory=dict)
    reference_distance: float = 0.0
    finest_level: int | None = None
    gated_views: str = ""
    train_views: str = ""
    signals: dict[str, Any] = dataclasses.field(default_factory=dict)
    gate: str = ""


@dataclass
class TrainedModel:
    """A model read back from a run, caught up and ready to render.

    Attributes:
        config: of the run.
        progress: where the run stood.
        space: how the trained world lies in the capture's.
        table: this rank's Gaussians.
        pool_bytes: of a device that they may take, where the run trained with a pool; else 0.
    """

    config: Config
    progress: Progress
    space: Space
    table: GaussianTable
    pool_bytes: int = 0

    def scene(self, device: torch.device) -> Scene:
        """Return what views on a device are rendered from; a table with a pool is moved for it, once.

        Raises:
            ResidenceError: the pool has room for less than two blocks.
        """
        if self.pool_bytes == 0:
            return self.table
        self.table = HostTable(self.table.columns, pinned=device.type == "cuda")
        return Residence(self.table, device, self.pool_bytes, None)


def save(
    folder: Path,
    table: GaussianTable,
    progress: Progress,
    space: Space,
    config: Config,
    ranks: Ranks,
    run_id: str = "",
    shared: Mapping[str, torch.Tensor] | None = None,
) -> Path:
    """Write a checkpoint of a run; rows that are behind stay behind, so that saving changes nothing.

    Returns:
        The checkpoint's folder.

    Raises:
        NonFiniteError: a value is not finite; nothing is written, and earlier checkpoints are kept.
        CheckpointError: a rank could not write; earlier checkpoints are kept.
    """
    check_before_saving(table, progress.step, ranks)
    state = {
        "progress": dataclasses.asdict(progress),
        "space": dataclasses.asdict(space),
        "config": to_dict(config),
        "run": run_id,
    }
    keep = config.log.keep_checkpoints
    columns = {name: table[name] for name in table}
    return checkpoint.save(folder / CHECKPOINTS, columns, state, ranks, keep, shared)


@dataclass
class Restored:
    """What a checkpoint of a run holds.

    Attributes:
        table: this rank's Gaussians.
        progress: where the run stood.
        space: how the trained world lies in the capture's.
        config: of the run.
        run_id: names the run in its log.
        source: which checkpoint it is and why that one, in words.
        shared: what all ranks have alike: `TileOwners.columns`.
    """

    table: GaussianTable
    progress: Progress
    space: Space
    config: Config
    run_id: str
    source: str
    shared: dict[str, torch.Tensor]


def restore(folder: Path, ranks: Ranks, device: torch.device | None = None) -> Restored | None:
    """Read the newest sound checkpoint of a run; None when there is none.

    Args:
        folder: of the run.
        ranks: the job.
        device: where the Gaussians go; None: that of `ranks`.

    Raises:
        CheckpointError: there are checkpoints, but none is sound.
    """
    loaded = checkpoint.load_latest(folder / CHECKPOINTS, ranks, device or ranks.device, _problem_of_columns)
    if loaded is None:
        return None
    state = loaded.state
    why = "the newest sound one" if loaded.refused else "the newest"
    skipped = f"; {len(loaded.refused)} newer refused" if loaded.refused else ""
    return Restored(
        GaussianTable(loaded.columns),
        Progress(**state["progress"]),
        Space(**(state["space"] | {"offset": tuple(state["space"]["offset"])})),
        from_dict(state["config"]),
        state.get("run", ""),
        f"{loaded.name} ({why}{skipped})",
        loaded.shared,
    )


def _problem_of_columns(columns: dict[str, torch.Tensor]) -> str | None:
    return bad_column(GaussianTable(columns))


def check_is_run(folder: Path) -> None:
    """Check that a folder looks like a run.

    Raises:
        FileNotFoundError: it has neither a configuration nor checkpoints.
    """
    if not (folder / CONFIG).exists() and not (folder / CHECKPOINTS).exists():
        raise FileNotFoundError(f"{folder} is not a run: it has no {CONFIG} and no {CHECKPOINTS}")


def open_model(folder: Path, ranks: Ranks, data: str | None = None) -> TrainedModel:
    """Open the newest model of a run for rendering, with the configuration that was saved with it.

    Args:
        folder: of the run.
        ranks: the job.
        data: where the capture is now; None: where it was.

    Raises:
        FileNotFoundError: the folder is not a run, or holds no checkpoint.
    """
    check_is_run(folder)
    pool_bytes = _pool_bytes(folder / CONFIG)
    home = torch.device("cpu") if pool_bytes > 0 else ranks.device
    restored = restore(folder, ranks, home)
    if restored is None:
        raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")
    config, progress, table = restored.config, restored.progress, restored.table
    if ranks.rank == 0:
        _compare_with_file(config, folder / CONFIG)
    if data is not None:
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=data))
    optimiser = LazyAdam(config.optimiser, Schedule(config.schedule), restored.space.extent, home)
    optimiser.catch_up(table, None, progress.step)
    return TrainedModel(config, progress, restored.space, table, pool_bytes)


def _pool_bytes(path: Path) -> int:
    """Return how many bytes of a device a run's Gaussians may take, by its configuration; 0: all."""
    try:
        return int(load_config(path).memory.resident_gb * 1e9)
    except ConfigError:
        return 0


def _compare_with_file(config: Config, path: Path) -> None:
    """Say so when a run's configuration file is not what its checkpoint was trained with."""
    try:
        # The file has the pace of the run's end or of its beginning.
        fields = _changed_fields(config, with_pace_of(load_config(path), config))
        what = f"differs in {', '.join(fields)}" if fields else ""
    except ConfigError as error:
        what = f"cannot be read ({error})"
    if what:
        warnings.warn(f"{path} {what}: what the checkpoint was trained with counts", stacklevel=3)


def check_resumable(saved: Config, wanted: Config) -> None:
    """Check that a resumed run computes what the checkpoint's run would have.

    Raises:
        ConfigError: names the first field that differs.
    """
    for name, old, new in _differences(to_dict(saved), to_dict(wanted), ""):
        # A run may get more time, or less: what is left of it is fitted into what is left of the time.
        is_budget = name == "schedule.minutes" and old > 0 and new > 0
        if not (_is_free(name) or is_budget):
            raise ConfigError(
                f"{name}: the checkpoint was trained with {old!r}, now {new!r}; "
                "resume with the run's own configuration or start another run"
            )


def with_pace_of(config: Config, saved: Config | None) -> Config:
    """Return a configuration for going on from a checkpoint, or from the start where `saved` is None.

    With `schedule.minutes` the run has measured its pace so far, or is about to measure it; without, the
    configuration says what the pace is. The same goes for the places of `schedule.adaptive`.
    """
    schedule = config.schedule
    if schedule.minutes > 0:
        schedule = dataclasses.replace(schedule, pace=() if saved is None else saved.schedule.pace)
    if schedule.adaptive:
        schedule = dataclasses.replace(schedule, placed=() if saved is None else saved.schedule.placed)
    return dataclasses.replace(config, schedule=schedule)


def _is_free(name: str) -> bool:
    return name not in BOUND_FIELDS and any(
        name == free or name.startswith(free + ".") for free in FREE_FIELDS
    )


def _changed_fields(saved: Config, found: Config) -> list[str]:
    return [name for name, *_ in _differences(to_dict(saved), to_dict(found), "") if not _is_free(name)]


def _differences(old: dict[str, Any], new: dict[str, Any], where: str) -> list[tuple[str, Any, Any]]:
    found = []
    for name in old | new:
        path, a, b = where + name, old.get(name), new.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += _differences(a, b, path + ".")
        elif a != b:
            found.append((path, a, b))
    return found


def peak_memory_bytes(device: torch.device) -> int:
    """Most memory this process has used: on the GPU when there is one, else resident memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def versions(device: torch.device) -> dict[str, str]:
    """Return what the result was made with."""
    found = {"blitzgs": blitzgs.__version__, "torch": torch.__version__, "python": platform.python_version()}
    if device.type == "cuda":
        found |= {"device": torch.cuda.get_device_name(device), "cuda": str(torch.version.cuda)}
    return found | {"machine": platform.platform()}
