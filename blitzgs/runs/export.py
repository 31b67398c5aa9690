# SPDX-License-Identifier: Apache-2.0
"""Writes a model as a file, in the capture's coordinates or around an origin that float32 does not round."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.config.files import changed
from blitzgs.formats.gaussians import Gaussians, GaussianSource, triple_line
from blitzgs.formats.models import (
    Format,
    check_replaces,
    offset_file,
    offset_of,
    stated_offset,
)
from blitzgs.formats.packed import Lost
from blitzgs.formats.ply import MAX_ROUNDING
from blitzgs.runs.folder import Model
from blitzgs.runs.source import Changed
from blitzgs.util.output import write_file
from blitzgs.view.views import CameraLike, Space

T = TypeVar("T")
COORDINATES = ("auto", "capture", "centred")


@dataclass(frozen=True)
class Exported:
    """What a caller has to tell the user about a written file."""

    # Add this to x, y, z to get coordinates of the capture's world; None: they are already.
    offset: tuple[float, float, float] | None
    sidecar: Path | None  # file that has the offset
    rounding: float  # without an offset, largest rounding error of a coordinate, in the capture's unit
    lost: Lost  # what the format cannot hold


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

    The source is in the capture's unit around the model's origin. `coordinates`: "capture" writes the
    capture's, "centred" the re-centred ones; "auto" the capture's if the format resolves them finely enough.
    `crs`: reference system of world coordinates, for the file of the offset; empty: unknown. None: the
    coordinates are the capture's. ValueError: there is a value that cannot be shown. FileExistsError: the
    file or that of the offset is needed, and another program has one of its name. OSError: the file cannot be
    written, or is no regular file.
    """
    check_replaces(path, kind)
    offset = np.array(space.offset)
    farthest, middle = _measured(source, offset)
    rounding = float(np.spacing(np.float32(farthest))) / 2
    centred = coordinates == "centred" or (coordinates == "auto" and rounding > MAX_ROUNDING * middle)
    if coordinates == "auto" and kind.quantised:
        centred |= float(np.linalg.norm(offset)) > 2 * space.extent * space.unit
    if centred:
        sidecar, lost = _write(source, np.zeros(3), space.offset, kind.write, path, kind.position, crs)
        return Exported(space.offset, sidecar, 0.0, lost or Lost())
    _, lost = _write(source, offset, None, kind.write, path)
    return Exported(None, None, rounding, lost or Lost())


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
    shift = np.zeros(3) if centred else np.array(offset)
    return _write(source, shift, offset if centred else None, write, path)[0]


def export_file(source: GaussianSource, kind: Format, path: Path, crs: str | None = None) -> Exported:
    """Write the model of a file, with its offset; where it is far from the origin, with one that is near it.

    `crs`, ValueError, OSError: as for `export`.
    """
    check_replaces(path, kind)
    offset, shift = np.array(offset_of(source.comments)), np.zeros(3)
    if kind.quantised and len(source):
        some = torch.cat([block.means[::64] for block in source.blocks()]).double()
        low, high = (some.sort(dim=0).values[int(share * (len(some) - 1))].numpy() for share in (0.01, 0.99))
        if np.linalg.norm(low + high) > 2 * np.linalg.norm(high - low) + 200:
            shift = np.round((low + high) / 2)
    x, y, z = (offset + shift).tolist()
    stated = (x, y, z) if offset.any() or shift.any() else None
    sidecar, lost = _write(source, -shift, stated, kind.write, path, kind.position, crs)
    return Exported(stated, sidecar, 0.0, lost or Lost())


def _write(
    source: GaussianSource,
    shift: npt.NDArray[np.float64],
    offset: tuple[float, float, float] | None,
    write: Callable[[Path, GaussianSource], T],
    path: Path,
    position: str = Format.position,
    crs: str | None = None,
) -> tuple[Path | None, T]:
    """Write Gaussians moved by `shift`; return the file beside, and what `write` returns.

    If they are around an offset, header and the file beside state it, the latter with `Format.position`; else
    there is none.
    """
    sidecar = offset_file(path)
    lines = [line for line in source.comments if offset_of([line]) == (0, 0, 0)]
    if offset is not None:
        if os.path.lexists(sidecar) and stated_offset(sidecar) is None:
            raise FileExistsError(
                f"{sidecar} exists and is not the offset of an exported model: choose another name"
            )
        lines.append(triple_line("offset", offset))
    step = torch.from_numpy(shift)

    def moved(block: Gaussians) -> Gaussians:
        return replace(block, means=(block.means.double() + step).float()) if shift.any() else block

    found = write(path, Changed(source, moved, lines))
    if offset is None:
        # The offset of an earlier export to this name would move the model once more.
        if stated_offset(sidecar) is not None:
            sidecar.unlink()
        return None, found
    meaning = f"{'capture' if crs is None else 'world'} coordinates = {position} + offset"
    content = {"file": path.name, "offset": offset, "meaning": meaning}
    write_file(sidecar, json.dumps(content | ({"crs": crs} if crs else {}), indent=1))
    return sidecar, found


def _measured(source: GaussianSource, offset: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the largest coordinate, with the offset, and the median Gaussian's middle axis."""
    farthest, middles = 0.0, []
    for block in source.blocks():
        farthest = max(farthest, float(np.abs(block.means.double().numpy() + offset).max()))
        middles.append(block.scales.median(dim=1).values)
    return farthest, torch.cat(middles).median().exp().item() if middles else math.inf


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
