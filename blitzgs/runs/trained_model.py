# SPDX-License-Identifier: Apache-2.0
"""The model of a run at a checkpoint: its progress, and how it is saved, restored and opened for renders."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from blitzgs.config.fields import Config
from blitzgs.config.files import ConfigError, build, changed, from_dict, load_config, to_dict
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.optim.table_adam import TableAdam
from blitzgs.runs import checkpoint
from blitzgs.runs.cameras import SHARED_EXPOSURES, effective_exposures
from blitzgs.runs.checkpoint import CheckpointError
from blitzgs.runs.checkpoint_files import DAMAGE
from blitzgs.runs.guard import bad_column, check_before_saving
from blitzgs.runs.log import records
from blitzgs.runs.resume import compare_with_file
from blitzgs.runs.run_files import CAMERAS, CHECKPOINTS, CONFIG, LOG, check_is_run
from blitzgs.table.blocks import sort_rows
from blitzgs.table.host_table import HostTable
from blitzgs.table.pool import Pool
from blitzgs.table.table import GaussianTable
from blitzgs.util.errors import WRONG_CONTENT
from blitzgs.util.memory import available_bytes
from blitzgs.view.gate import LodGate, ModelGate
from blitzgs.view.levels import level_fork
from blitzgs.view.views import Space, render_options
from blitzgs.view.visible import Subject, TableOrPool

# Views that would keep at least this share of all Gaussians are rendered with all of them.
MOST_KEPT = 0.8
# Gaussians move after the training views were chosen, and held-out views see a little more or less.
_SLACK = 0.9


@dataclass
class Progress:
    """The progress of a run; saved with every checkpoint."""

    step: int  # number of optimiser steps taken
    sh_degree: int  # spherical-harmonics degree of the last step
    level_count: int  # number of octree levels K
    peak_gaussians: int  # largest number of Gaussians so far
    seconds: float  # seconds of training so far, without evaluations
    # Number of Gaussians at named points of the run, such as "before_pass_1".
    milestones: dict[str, int] = dataclasses.field(default_factory=dict)
    # Ledger of the lineage (`blitzgs.spawn.lineage.Ledger`), if births and deaths are logged.
    ledger: dict[str, int] = dataclasses.field(default_factory=dict)
    # d_0 of the levels (`blitzgs.view.levels.Levels`), in the unit of the means.
    reference_distance: float = 0.0
    # Finest level that the LOD gate keeps; None: there is no gate at this point of the run.
    finest_level: int | None = None
    # For each training view, in order, "1" if it has the LOD gate and "0" if the gate would keep almost all
    # Gaussians; empty without a gate.
    gated_views: str = ""
    # The smallest share of the Gaussians that a training view keeps with the LOD gate; 0 without a gate, and
    # in old checkpoints.
    least_kept: float = 0.0
    # Digest of the names of the training views, in their order; empty in old checkpoints.
    train_views: str = ""
    # Fields of `blitzgs.training.state.Curve`; empty in old checkpoints.
    curve: dict[str, Any] = dataclasses.field(default_factory=dict)
    gate: str = ""  # digest of the spawn gate's files; empty without a gate, and in old checkpoints
    # Seconds of each kind of work besides the optimiser steps; see `TrainingState.stage`.
    stages: dict[str, float] = dataclasses.field(default_factory=dict)
    # (time, order, kind) of the events of the last step that a signal kept from running.
    events_left: list[tuple[Any, ...]] = dataclasses.field(default_factory=list)
    # Spread of the blocks of all ranks when density events last sorted the rows, as
    # `blitzgs.training.events.densify` measures it; 0: they have not.
    sorted_spread: int = 0

    def lod_gate(self, config: Config) -> LodGate | None:
        """Return the LOD gate at this point of a run; None if it is not open, or no training view has it.

        If every training view is rendered with all Gaussians (`MOST_KEPT`), the coarse levels have never been
        trained to stand alone. A view from farther away would then show holes where it leaves out the fine
        ones. Smooth levels fade in every training view.
        """
        if self.finest_level is None or (self.gated_views and "1" not in self.gated_views):
            return None
        fork, smooth = level_fork(config), config.view.lod == "smooth"
        return LodGate(self.reference_distance, fork, self.level_count, self.finest_level, smooth)

    @property
    def least_gated(self) -> float:
        """The smallest share of the Gaussians that a view with the LOD gate keeps; see `ModelGate`."""
        return _SLACK * self.least_kept

    def model_gate(self, config: Config, table: GaussianTable, ranks: Ranks) -> ModelGate | None:
        """Return the LOD gate for any camera; None: it is not open. No step may be pending. Collective."""
        gate = self.lod_gate(config)
        return None if gate is None else ModelGate(gate, MOST_KEPT, table, ranks, self.least_gated)


@dataclass
class TrainedModel:
    """A model read from a run's checkpoint, with its pending optimiser steps (`restore`) or without."""

    config: Config
    progress: Progress  # progress of the run at the checkpoint
    space: Space  # maps between the trained world and the capture's world
    table: GaussianTable  # this rank's Gaussians
    run_id: str = ""  # identifies the run in its log
    source: str = ""  # name of the checkpoint and why it was chosen, as text
    # Tensors that are the same on all ranks: `TileOwners.columns`, and those of the exposures.
    shared: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    # Bytes of a device that the Gaussians may take, if the run trained with a pool; else 0.
    pool_bytes: int = 0

    @property
    def exposures(self) -> torch.Tensor | None:
        """Gain and bias of each training photograph, [T, 2, 3]; None if the run has none."""
        found = self.shared.get(SHARED_EXPOSURES)
        return None if found is None else effective_exposures(found[:, :-1].reshape(-1, 2, 3))

    def subject(self, ranks: Ranks) -> Subject:
        """Return what views are rendered from, on the ranks' device. Collective.

        With a pool, the first call moves the table into memory that the pool can reach. PoolError: the pool
        has room for fewer than two blocks.
        """
        gate = self.progress.lod_gate(self.config)
        options = render_options(self.config, self.space, self.progress.sh_degree, gate)
        lod = self.progress.model_gate(self.config, self.table, ranks)
        gaussians: TableOrPool = self.table
        if self.pool_bytes > 0:
            if self.config.memory.resident_gb == 0:
                sort_rows(self.table)
            self.table = HostTable(self.table.release(), pinned=ranks.device.type == "cuda")
            gaussians = Pool(self.table, ranks.device, self.pool_bytes, None)
        return Subject(gaussians, options, self.space, lod)


def save(folder: Path, model: TrainedModel, ranks: Ranks, in_background: bool = False) -> checkpoint.Saving:
    """Begin to write a checkpoint of a run; pending optimiser steps stay pending: saving changes nothing.

    With `in_background`, the table may change before `Saving.finish`: a copy of it is written, or, if memory
    lacks for that, the call returns when the files are written. Earlier checkpoints are kept if a value is
    not finite (NonFiniteError: nothing is written) or a rank could not write (CheckpointError).
    """
    table = model.table
    check_before_saving(table, model.progress.step, ranks)
    state = {
        "progress": dataclasses.asdict(model.progress),
        "space": dataclasses.asdict(model.space),
        "config": to_dict(model.config),
        "run": model.run_id,
    }
    keep = model.config.log.keep_checkpoints
    columns = {name: table[name] for name in table}
    # Ranks that share a memory all copy their parts into it.
    sharing = ranks.world_size if table.device.type == "cpu" or ranks.shares_gpu else 1
    left = torch.cuda.mem_get_info(table.device)[0] if table.device.type == "cuda" else available_bytes()
    has_room = in_background and 2 * sharing * table.memory_bytes < left
    if has_room:
        columns = {name: column.clone() for name, column in columns.items()}
    saving = checkpoint.Saving(folder / CHECKPOINTS, columns, state, ranks, keep, model.shared)
    if in_background and not has_room:
        with ranks.watchdog.working("writing a checkpoint"):
            saving.wait()
    return saving


def restore(
    folder: Path, ranks: Ranks, device: torch.device | None = None, only: str | None = None
) -> TrainedModel | None:
    """Read a run's newest undamaged checkpoint, or the one named `only`; None: the run has no checkpoint.

    The Gaussians go to `device`, else to the ranks' device. CheckpointError: all checkpoints are damaged, or
    the newest is of another version or of another run.
    """

    def load(path: Path) -> checkpoint.Loaded:
        loaded = checkpoint.load(path, ranks, device or ranks.device)
        try:
            problem = bad_column(GaussianTable(loaded.columns))
        except ValueError as error:  # a column is missing, or has another shape or dtype
            problem = str(error)
        found = ranks.all_gather_object(problem)
        if wrong := [text for text in found if text]:
            raise CheckpointError(f"checkpoint {path} is refused: {'; '.join(wrong)}")
        return loaded

    found = checkpoint.newest(folder / CHECKPOINTS, ranks, load, only)
    if found is None:
        return None
    loaded, path, refused = found
    state = loaded.state
    why = f"the newest sound one; {len(refused)} newer refused" if refused else "the newest"
    progress, space, config = parsed(state, path, folder, ranks)
    table = GaussianTable(loaded.columns)
    if len(list(path.glob("shard_*"))) != ranks.world_size:
        # Each rank had an order of its own, and the spread is of another number of blocks.
        sort_rows(table)
        progress.sorted_spread = 0
    source = f"{path.name} ({why})"
    return TrainedModel(config, progress, space, table, state.get("run", ""), source, loaded.shared)


def parsed(
    state: Mapping[str, Any], path: Path, folder: Path, ranks: Ranks
) -> tuple[Progress, Space, Config]:
    """Return what the state of the checkpoint `path` says. Collective.

    CheckpointError, on every rank: it was written by another version, or by another run than the one whose
    cameras and log are in `folder`. Old checkpoints have no id and are not compared.
    """
    known = ranks.broadcast_object(known_id(folder) if ranks.rank == 0 else "")
    run_id = str(state.get("run", ""))
    if known and run_id and known != run_id:
        raise CheckpointError(
            f"{path} was written by another run ({run_id}) than the one in {folder} ({known}), whose cameras "
            "would be used with it: put back this run's own checkpoints, or use the folder of the other run"
        )
    try:
        fields = {field.name for field in dataclasses.fields(Progress)}
        known_fields = {name: value for name, value in state["progress"].items() if name in fields}
        space = build(Space, state["space"], "space")
        if not all(0 < length < math.inf for length in (space.unit, space.extent)):
            raise ValueError(f"space: unit and extent must be positive, got {space.unit}, {space.extent}")
        return build(Progress, known_fields, "progress"), space, from_dict(state["config"])
    except WRONG_CONTENT as error:
        raise CheckpointError(f"checkpoint {path} belongs to another version of BlitzGS: {error}") from error


def known_id(folder: Path) -> str:
    """Return the id of the run in a folder, from its cameras, else from its log; empty if it is not known."""
    with suppress(*DAMAGE):
        found = json.loads((folder / CAMERAS).read_text(encoding="utf-8"))["run"]
        if isinstance(found, str) and found:
            return found
    with suppress(OSError):
        ids = [record["run"] for record in records(folder / LOG) if isinstance(record.get("run"), str)]
        return ids[-1] if ids else ""
    return ""


def open_model(
    folder: Path,
    ranks: Ranks,
    data: Path | None = None,
    resident_gb: float | None = None,
    only: str | None = None,
) -> TrainedModel:
    """Open the newest model of a run for rendering, with the configuration that was saved with it.

    `data` is the present folder of the capture, `resident_gb` the gigabytes of each device for Gaussians (0:
    no limit, None: as the run), `only` the name of a checkpoint. FileNotFoundError: the folder is no run, or
    holds no checkpoint.
    """
    check_is_run(folder)
    if resident_gb is None:
        resident_gb = 0.0
        with suppress(ConfigError):
            resident_gb = load_config(folder / CONFIG).memory.resident_gb
    pool_bytes = int(resident_gb * 1e9)
    home = torch.device("cpu") if pool_bytes > 0 else ranks.device
    model = restore(folder, ranks, home, only)
    if model is None:
        raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")
    config, model.pool_bytes = model.config, pool_bytes
    if ranks.rank == 0:
        compare_with_file(config, folder / CONFIG)
    if data is not None:
        model.config = changed(config, "data", path=str(data))
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), model.space.extent, home)
    optimiser.catch_up(model.table, None, model.progress.step)
    return model
