# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a run for files: in the capture's unit around the model's origin, block by block."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch

from blitzgs.config.fields import Config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.formats import gaussians
from blitzgs.formats.gaussians import MIP, Gaussians, GaussianSource
from blitzgs.optim.table_adam import TableAdam
from blitzgs.runs import checkpoint
from blitzgs.runs import files as run_files
from blitzgs.runs.checkpoint import CheckpointError
from blitzgs.runs.folder import Model
from blitzgs.runs.folder_checks import check_own
from blitzgs.runs.lod import lod_gate
from blitzgs.runs.manifest import DAMAGE, Shard, verified
from blitzgs.runs.shard_file import header_of, read_rows
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import LodGate
from blitzgs.view.views import Space


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
            yield dataclasses.replace(self._change(block), comments=self.comments)


class RunSource(Changed):
    """The Gaussians of a run; the unit is a power of two, so that positions keep their bits."""

    def __init__(self, trained: GaussianSource, space: Space, comments: list[str], config: Config) -> None:
        self.space, self.config = space, config
        super().__init__(trained, self._scaled, comments)

    def _scaled(self, block: Gaussians) -> Gaussians:
        unit = self.space.unit
        return dataclasses.replace(block, means=block.means * unit, scales=block.scales + math.log(unit))


def source_of(model: Model) -> RunSource:
    """Return the source of a model in memory."""
    found = Gaussians(
        means=model.means.cpu(),
        quats=model.quats.cpu(),
        scales=model.scales.cpu(),
        opacities=model.opacities.cpu(),
        sh=model.sh.cpu(),
        levels=None if model.lod is None else model.level.cpu().float(),
    )
    gate = None if model.lod is None else model.lod.gate
    lines = _comments(model.config, model.space, gate, model.exposures is not None)
    return RunSource(found, model.space, lines, model.config)


def open_source(folder: Path, only: str | None = None) -> RunSource:
    """Open the newest undamaged checkpoint of a run, or the one named `only`, without reading its Gaussians.

    FileNotFoundError: the folder is no run, or holds no checkpoint. CheckpointError: all checkpoints are
    damaged, or the newest is of another version or of another run.
    """
    run_files.check_is_run(folder)
    refused = []
    names = checkpoint.names_of(folder / run_files.CHECKPOINTS)
    for name in reversed(names) if only is None else [only]:
        path = folder / run_files.CHECKPOINTS / name
        try:
            manifest = verified(path)
        except DAMAGE as error:
            refused.append(f"checkpoint {path} is damaged: {error}")
            continue
        if refused:
            warnings.warn(f"{'; '.join(refused)}; using {name}", stacklevel=2)
        check_own(folder, path, str(manifest.state.get("run", "")), Ranks())
        progress, space, config = run_files.parsed(manifest.state, path)
        run_files.compare_with_file(config, folder / run_files.CONFIG)
        gate = lod_gate(config, progress)
        trained = _Shards(path, manifest.shards, config, progress.step, space.extent, gate is not None)
        exposed = manifest.shared is not None and "exposures" in header_of(path / manifest.shared.file)
        return RunSource(trained, space, _comments(config, space, gate, exposed), config)
    if refused:
        raise CheckpointError(f"no sound checkpoint in {folder}: {'; '.join(refused)}")
    raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")


@dataclass
class _Shards:
    """The Gaussians of a checkpoint in the trained world, shard after shard, without pending steps."""

    path: Path
    shards: list[Shard]
    config: Config
    step: int
    extent: float
    has_levels: bool
    comments: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(shard.rows for shard in self.shards)

    @property
    def degree(self) -> int:
        return int(header_of(self.path / self.shards[0].file)["sh"].shape[1] ** 0.5) - 1

    def blocks(self) -> Iterator[Gaussians]:
        optimiser = TableAdam(self.config.optimiser, Schedule(self.config.schedule), self.extent, "cpu")
        for shard in self.shards:
            for first in range(0, shard.rows, gaussians.BLOCK):
                last = min(first + gaussians.BLOCK, shard.rows)
                table = GaussianTable(read_rows(self.path / shard.file, first, last))
                with torch.no_grad():
                    optimiser.catch_up(table, None, self.step)
                yield Gaussians(
                    means=table["means"],
                    quats=table["quats"],
                    scales=table["scales"],
                    opacities=table["opacities"],
                    sh=table["sh"],
                    levels=table["level"].float() if self.has_levels else None,
                )


def _comments(config: Config, space: Space, gate: LodGate | None, exposed: bool) -> list[str]:
    """Return the header lines of a model's file, but that of its offset."""
    lines = ["comment Generated by BlitzGS", "comment color space: sRGB, display-referred"]
    if config.model.antialiased:
        lines.append(MIP)
    if exposed:
        lines.append("comment exposure: mean of the training photographs")
    if gate is not None:
        lines.append(
            f"comment lod reference_distance {gate.reference_distance * space.unit!r} fork {gate.fork!r} "
            f"levels {gate.count} finest {gate.finest}" + (" smooth" if gate.smooth else "")
        )
    return lines
