# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a run for other programs, block by block, in the capture's unit around its own origin."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.config.fields import Config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.formats import gaussians
from blitzgs.formats.gaussians import MIP, Gaussians, GaussianSource, joined, triple_line
from blitzgs.formats.selection import Selected, Selection
from blitzgs.optim.table_adam import TableAdam
from blitzgs.runs import checkpoint
from blitzgs.runs.cameras import SHARED_EXPOSURES, stored_cameras
from blitzgs.runs.checkpoint_files import Shard, opened
from blitzgs.runs.folder import Model, model_of
from blitzgs.runs.resume import compare_with_file
from blitzgs.runs.run_files import CHECKPOINTS, CONFIG, check_is_run
from blitzgs.runs.trained_model import Progress, TrainedModel, parsed
from blitzgs.runs.world import trained_table
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.errors import located
from blitzgs.util.progress import Report
from blitzgs.view.gate import LodGate
from blitzgs.view.views import Space, up_direction, viewmat


class Changed:
    """A `GaussianSource` whose blocks are changed one by one, with header lines of its own."""

    def __init__(
        self, source: GaussianSource, change: Callable[[Gaussians], Gaussians], comments: list[str]
    ) -> None:
        self._source, self._change, self.comments = source, change, comments
        self.degree, self.has_levels = source.degree, source.has_levels

    def __len__(self) -> int:
        return len(self._source)

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians, changed."""
        for block in self._source.blocks():
            yield replace(self._change(block), comments=self.comments)


class Watched(Changed):
    """A source that reports how many Gaussians of how many a reader has taken, anew for each reading."""

    def __init__(self, source: GaussianSource, report: Report) -> None:
        super().__init__(source, lambda block: block, source.comments)
        self._report = report

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians."""
        done = 0
        for block in super().blocks():
            yield block
            done += len(block)
            self._report(done, len(self))


def source_of(model: Model, up: Iterable[float] | None = None) -> Gaussians:
    """Return the Gaussians of a model in memory; `up` is its upward direction, if that is known."""
    gate, least = (None, 0.0) if model.lod is None else (model.lod.gate, model.lod.least_kept)
    lines = _comments(model.config, model.space, gate, least, model.exposures is not None, up)
    columns = {name: getattr(model, name).cpu() for name in (*PARAMETERS, "level")}
    return _in_unit(columns, model.space, gate is not None, lines)


@dataclass(frozen=True)
class RunSource:
    """The Gaussians of a checkpoint, a `GaussianSource`: shard after shard, without pending steps."""

    path: Path  # folder of the checkpoint
    shards: list[Shard]
    progress: Progress
    space: Space
    config: Config
    comments: list[str]  # header lines

    def __len__(self) -> int:
        return sum(shard.rows for shard in self.shards)

    @property
    def degree(self) -> int:
        """The spherical-harmonics degree."""
        with opened(self.path / self.shards[0].file) as file:
            return math.isqrt(file.get_slice("sh").get_shape()[1]) - 1

    @property
    def has_levels(self) -> bool:
        """Whether the Gaussians have octree levels."""
        return self.progress.lod_gate(self.config) is not None

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians."""
        schedule = Schedule(self.config.schedule)
        optimiser = TableAdam(self.config.optimiser, schedule, self.space.extent, "cpu")
        for shard in self.shards:
            for first in range(0, shard.rows, gaussians.BLOCK):
                last = min(first + gaussians.BLOCK, shard.rows)
                with opened(self.path / shard.file) as file:
                    rows = {name: file.get_slice(name)[first:last] for name in file.keys()}  # noqa: SIM118
                with located(str(self.path)):
                    table = GaussianTable(rows)
                with torch.no_grad():
                    optimiser.catch_up(table, None, self.progress.step)
                yield _in_unit(table.columns, self.space, self.has_levels, self.comments)


def _in_unit(columns: Mapping[str, Tensor], space: Space, has_levels: bool, comments: list[str]) -> Gaussians:
    """Return trained Gaussians in the capture's unit, a power of two, so that positions keep their bits."""
    values = {name: columns[name] for name in PARAMETERS}
    values["means"], values["scales"] = values["means"] * space.unit, values["scales"] + math.log(space.unit)
    levels = columns["level"].float() if has_levels else None
    return Gaussians(**values, levels=levels, comments=comments)


def largest_of_run(source: RunSource, most: int, device: torch.device) -> Model:
    """Return a model of so many Gaussians of a checkpoint, those of the largest opacity times length.

    It has no SH beyond the DC. Memory holds no others.
    """
    chosen = joined(list(Selected(source, Selection(most=most, sh_degree=0)).blocks()))
    found = replace(chosen, comments=[triple_line("offset", source.space.offset)])
    table = trained_table(found, source.space, Ranks())
    progress = replace(source.progress, sh_degree=0)
    return model_of(TrainedModel(source.config, progress, source.space, table), device)


def open_source(folder: Path, only: str | None = None) -> RunSource:
    """Open the newest undamaged checkpoint of a run, or the one named `only`, without reading its Gaussians.

    FileNotFoundError: the folder is no run, or holds no checkpoint. CheckpointError: all checkpoints are
    damaged, or the newest is of another version or of another run.
    """
    check_is_run(folder)
    alone = Ranks()
    read = partial(checkpoint.sound_manifest, ranks=alone)
    found = checkpoint.newest(folder / CHECKPOINTS, alone, read, only)
    if found is None:
        raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")
    manifest, path, _ = found
    progress, space, config = parsed(manifest.state, path, folder, alone)
    compare_with_file(config, folder / CONFIG)
    exposed = False
    if manifest.shared is not None:
        with opened(path / manifest.shared.file) as shared:
            exposed = SHARED_EXPOSURES in shared.keys()  # noqa: SIM118
    up = up_of_run(folder, space)
    lines = _comments(config, space, progress.lod_gate(config), progress.least_gated, exposed, up)
    return RunSource(path, manifest.shards, progress, space, config, lines)


def up_of_run(folder: Path, space: Space) -> npt.NDArray[np.float64] | None:
    """Return the upward direction of a run's capture, [3]; None: its cameras are unknown, or damaged."""
    with suppress(ValueError):
        if cameras := stored_cameras(folder).cameras:
            return up_direction([viewmat(camera, space) for camera in cameras])
    return None


def _comments(
    config: Config,
    space: Space,
    gate: LodGate | None,
    least: float,
    exposed: bool,
    up: Iterable[float] | None,
) -> list[str]:
    """Return the header lines of a model's file, but that of its offset."""
    lines = ["comment Generated by BlitzGS", "comment color space: sRGB, display-referred"]
    if config.model.antialiased:
        lines.append(MIP)
    if exposed:
        lines.append("comment exposure: mean of the training photographs")
    if config.model.background:
        lines.append(triple_line("background", config.model.background))
    if up is not None:
        lines.append(triple_line("up", up))
    if gate is not None:
        lines.append(
            f"comment lod reference_distance {gate.reference_distance * space.unit!r} fork {gate.fork!r} "
            f"levels {gate.count} finest {gate.finest}" + (" smooth" if gate.smooth else f" least {least!r}")
        )
    return lines
