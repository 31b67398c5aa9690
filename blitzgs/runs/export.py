# SPDX-License-Identifier: Apache-2.0
"""Writes a trained model as a file, block by block, in the capture's unit around its own origin."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.config.fields import Config
from blitzgs.config.files import changed
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.formats import gaussians
from blitzgs.formats.gaussians import MIP, Gaussians, GaussianSource, joined
from blitzgs.formats.models import Format, check_replaces, offset_of
from blitzgs.formats.selection import Selected, Selection
from blitzgs.optim.table_adam import TableAdam
from blitzgs.runs import checkpoint, run_files, trained_model
from blitzgs.runs.cameras import SHARED_EXPOSURES
from blitzgs.runs.checkpoint_files import Shard, opened
from blitzgs.runs.folder import Model, model_of
from blitzgs.runs.resume import compare_with_file
from blitzgs.runs.trained_model import Progress, TrainedModel, check_own
from blitzgs.runs.world import trained_table
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report
from blitzgs.view.gate import LodGate
from blitzgs.view.views import CameraLike, Space

COORDINATES = ("auto", "capture", "centred")
# Positions may be rounded by this share of the median Gaussian's middle axis.
_MAX_ROUNDING = 0.01


@dataclass(frozen=True)
class Exported:
    """What a caller has to tell the user about a written file."""

    # Add this to x, y, z to get coordinates of the capture's world; None: they are already.
    offset: tuple[float, float, float] | None
    sidecar: Path | None  # file that has the offset
    rounding: float  # largest rounding error of a coordinate in float32, in the capture's unit


def export(
    source: GaussianSource,
    space: Space,
    kind: Format,
    path: Path,
    coordinates: str = "auto",
    crs: str | None = None,
) -> Exported:
    """Write a model as a file.

    Viewers read float32. Georeferenced coordinates such as (500000, 4600000) are then rounded to half a
    metre, so a model there is written around its own origin, with the offset as a comment in the header and
    in a file beside it.

    Args:
        source: the Gaussians, in the capture's unit around the model's origin.
        coordinates: "capture" writes the capture's coordinates, "centred" the re-centred ones; "auto" writes
            the capture's if the format resolves them finely enough.
        crs: reference system of world coordinates, for the file of the offset; empty: unknown. None: the
            coordinates are the capture's.

    Raises:
        ValueError: `coordinates` has another value, or there is a value that cannot be shown.
        FileExistsError: the file or that of the offset is needed, and another program has one of its name.
        OSError: the file cannot be written, or is no regular file.
    """
    if coordinates not in COORDINATES:
        raise ValueError(f"coordinates must be one of {', '.join(COORDINATES)}, got {coordinates!r}")
    check_replaces(path, kind)
    offset = np.array(space.offset)
    reach, middle = _measured(source, offset)
    rounding = _spacing(reach[1])
    centred = coordinates == "centred" or (coordinates == "auto" and rounding > _MAX_ROUNDING * middle)
    if coordinates == "auto" and kind.quantised:
        centred |= float(np.linalg.norm(offset)) > 2 * space.extent * space.unit
    _write_moved(source, space.offset, centred, kind.write, path, crs)
    if centred:
        return Exported(space.offset, _sidecar(path), _spacing(reach[0]))
    return Exported(None, None, rounding)


def export_folder(
    source: GaussianSource,
    offset: tuple[float, float, float],
    extent: float,
    write: Callable[[Path, GaussianSource], object],
    path: Path,
) -> Path | None:
    """Write Gaussians around `offset` in the capture's coordinates, if these are near their origin.

    Else they stay around the offset; returns the file that states it. `extent`: size of the capture. `write`
    makes the folder. FileExistsError, OSError: as `export`.
    """
    centred = float(np.linalg.norm(offset)) > 2 * extent
    _write_moved(source, offset, centred, write, path)
    return _sidecar(path) if centred else None


def _write_moved(
    source: GaussianSource,
    offset: tuple[float, float, float],
    centred: bool,
    write: Callable[[Path, GaussianSource], object],
    path: Path,
    crs: str | None = None,
) -> None:
    """Write a model around an offset, stated beside it, or in the coordinates that include the offset."""
    if centred:
        return _write_centred(source, offset, write, path, crs)
    write(path, _shifted(source, np.array(offset), source.comments))
    # The offset of an earlier export to this name would move the model once more.
    if _has_offset(_sidecar(path)):
        _sidecar(path).unlink()


def _shifted(source: GaussianSource, shift: npt.NDArray[np.float64], comments: list[str]) -> GaussianSource:
    step = torch.from_numpy(shift)
    return Changed(
        source, lambda block: replace(block, means=(block.means.double() + step).float()), comments
    )


def export_file(source: GaussianSource, kind: Format, path: Path) -> Exported:
    """Write the model of a file, with its offset; where it is far from the origin, with one that is near it.

    ValueError, OSError: as `export`.
    """
    check_replaces(path, kind)
    offset, shift = np.array(offset_of(source.comments)), np.zeros(3)
    if kind.quantised and len(source):
        some = torch.cat([block.means[::64] for block in source.blocks()]).double()
        low, high = (some.sort(dim=0).values[int(share * (len(some) - 1))].numpy() for share in (0.01, 0.99))
        if np.linalg.norm(low + high) > 2 * np.linalg.norm(high - low) + 200:
            shift = np.round((low + high) / 2)
    if not (offset.any() or shift.any()):
        kind.write(path, source)
        if _has_offset(_sidecar(path)):
            _sidecar(path).unlink()
        return Exported(None, None, 0.0)
    lines = [line for line in source.comments if offset_of([line]) == (0, 0, 0)]
    x, y, z = (offset + shift).tolist()
    _write_centred(_shifted(source, -shift, lines), (x, y, z), kind.write, path)
    return Exported((x, y, z), _sidecar(path), 0.0)


def _write_centred(
    source: GaussianSource,
    offset: tuple[float, float, float],
    write: Callable[[Path, GaussianSource], object],
    path: Path,
    crs: str | None = None,
) -> None:
    """Write a model around an offset, which goes into the header and a file beside."""
    sidecar = _sidecar(path)
    if os.path.lexists(sidecar) and not _has_offset(sidecar):
        raise FileExistsError(
            f"{sidecar} exists and is not the offset of an exported model: choose another name"
        )
    x, y, z = offset
    lines = [*source.comments, f"comment offset {x!r} {y!r} {z!r}"]
    write(path, Changed(source, lambda block: block, lines))
    meaning = f"{'capture' if crs is None else 'world'} coordinates = coordinates in the file + offset"
    content = {"file": path.name, "offset": offset, "meaning": meaning}
    write_file(sidecar, json.dumps(content | ({"crs": crs} if crs else {}), indent=1))


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".offset.json")


def _measured(source: GaussianSource, offset: npt.NDArray[np.float64]) -> tuple[tuple[float, float], float]:
    """Return the largest coordinates without and with the offset, and the median Gaussian's middle axis."""
    near, far, middles = 0.0, 0.0, []
    for block in source.blocks():
        means = block.means.double().numpy()
        near = max(near, float(np.abs(means).max()))
        far = max(far, float(np.abs(means + offset).max()))
        middles.append(block.scales.median(dim=1).values)
    return (near, far), torch.cat(middles).median().exp().item() if middles else math.inf


def _spacing(largest: float) -> float:
    """Return half the distance between neighbouring float32 numbers at a coordinate."""
    return float(np.spacing(np.float32(largest))) / 2


def _has_offset(sidecar: Path) -> bool:
    """Tell whether a file is the offset of an exported model."""
    try:
        content = json.loads(sidecar.read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and {"file", "offset", "meaning"} <= content.keys()


@torch.no_grad()
def without_antialiasing(model: Model, cameras: Sequence[CameraLike]) -> Model:
    """Return a model for viewers without antialiasing: its opacities contain the compensation.

    The antialiased mode scales a splat's opacity by rho = sqrt(det(cov) / det(cov + eps2d I)), which depends
    on the view. This function multiplies each opacity by the mean of rho over the given views (the training
    views, for example), weighted with the splat's area in pixels. Nearer and farther views keep errors of
    opposite sign.
    """
    opacities = model.opacities.sigmoid()
    areas = torch.zeros_like(opacities, dtype=torch.float64)
    compensated = torch.zeros_like(areas)
    for camera in cameras:
        _, _, meta = model.splat([camera], antialiased=True)
        ids = meta["gaussian_ids"].long()
        a, b, c = meta["conics"].double().unbind(-1)
        area = (a * c - b * b).clamp_min(1e-12).rsqrt()
        rho = meta["opacities"].double() / opacities[ids].double().clamp_min(1e-12)
        areas.index_add_(0, ids, area)
        compensated.index_add_(0, ids, area * rho.clamp(0, 1))
    # A Gaussian that no view sees stays as it is.
    factor = torch.where(areas > 0, compensated / areas.clamp_min(1e-300), 1.0)
    baked = (opacities.double() * factor).clamp(1e-6, 1 - 1e-6)
    config = changed(model.config, "model", antialiased=False)
    return replace(model, opacities=baked.logit().float(), config=config)


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


class RunSource(Changed):
    """The Gaussians of a run; the unit is a power of two, so that positions keep their bits."""

    def __init__(
        self,
        trained: GaussianSource,
        space: Space,
        comments: list[str],
        config: Config,
        progress: Progress | None = None,
    ) -> None:
        self.space, self.config, self.progress = space, config, progress
        super().__init__(trained, self._scaled, comments)

    def _scaled(self, block: Gaussians) -> Gaussians:
        unit = self.space.unit
        return dataclasses.replace(block, means=block.means * unit, scales=block.scales + math.log(unit))


def source_of(model: Model) -> RunSource:
    """Return the source of a model in memory."""
    columns: dict[str, Any] = {name: getattr(model, name).cpu() for name in PARAMETERS}
    found = Gaussians(**columns, levels=None if model.lod is None else model.level.cpu().float())
    gate = None if model.lod is None else model.lod.gate
    lines = _comments(model.config, model.space, gate, model.exposures is not None)
    return RunSource(found, model.space, lines, model.config)


def largest_of_run(source: RunSource, most: int, device: torch.device) -> Model:
    """Return a model of so many Gaussians of a checkpoint, those of the largest opacity times length.

    It has no SH beyond the DC. Memory holds no others.
    """
    assert source.progress is not None
    chosen = joined(list(Selected(source, Selection(most=most, sh_degree=0)).blocks()))
    x, y, z = source.space.offset
    found = replace(chosen, comments=[f"comment offset {x!r} {y!r} {z!r}"])
    table = trained_table(found, source.space, Ranks())
    progress = replace(source.progress, sh_degree=0)
    return model_of(TrainedModel(source.config, progress, source.space, table), device)


def open_source(folder: Path, only: str | None = None) -> RunSource:
    """Open the newest undamaged checkpoint of a run, or the one named `only`, without reading its Gaussians.

    FileNotFoundError: the folder is no run, or holds no checkpoint. CheckpointError: all checkpoints are
    damaged, or the newest is of another version or of another run.
    """
    run_files.check_is_run(folder)
    alone = Ranks()
    found = checkpoint.newest(
        folder / run_files.CHECKPOINTS, alone, lambda path: checkpoint.sound_manifest(path, alone), only
    )
    if found is None:
        raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")
    manifest, path, _ = found
    check_own(folder, path, str(manifest.state.get("run", "")), alone)
    progress, space, config = trained_model.parsed(manifest.state, path)
    compare_with_file(config, folder / run_files.CONFIG)
    gate = progress.lod_gate(config)
    trained = _Shards(path, manifest.shards, config, progress.step, space.extent, gate is not None)
    exposed = False
    if manifest.shared is not None:
        with opened(path / manifest.shared.file) as shared:
            exposed = SHARED_EXPOSURES in shared.keys()  # noqa: SIM118
    return RunSource(trained, space, _comments(config, space, gate, exposed), config, progress)


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
        with opened(self.path / self.shards[0].file) as file:
            return math.isqrt(file.get_slice("sh").get_shape()[1]) - 1

    def blocks(self) -> Iterator[Gaussians]:
        optimiser = TableAdam(self.config.optimiser, Schedule(self.config.schedule), self.extent, "cpu")
        for shard in self.shards:
            for first in range(0, shard.rows, gaussians.BLOCK):
                last = min(first + gaussians.BLOCK, shard.rows)
                with opened(self.path / shard.file) as file:
                    rows = {name: file.get_slice(name)[first:last] for name in file.keys()}  # noqa: SIM118
                table = GaussianTable(rows)
                with torch.no_grad():
                    optimiser.catch_up(table, None, self.step)
                columns: dict[str, Any] = {name: table[name] for name in PARAMETERS}
                yield Gaussians(**columns, levels=table["level"].float() if self.has_levels else None)


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
