# SPDX-License-Identifier: Apache-2.0
"""Models in other coordinates: a run in the world of its geo.json, a file in the trained world."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.capture import Capture
from blitzgs.capture.lengths import nearest_depths
from blitzgs.capture.world import GEO, WorldFrame, read_world_frame
from blitzgs.config.fields import Config, ModelConfig
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import Gaussians, GaussianSource, is_antialiased, triple_of
from blitzgs.formats.models import offset_of
from blitzgs.ops.harmonics import spherical_harmonics
from blitzgs.runs.folder import Model
from blitzgs.runs.trained_model import MOST_KEPT
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.util.errors import located
from blitzgs.util.output import write_file
from blitzgs.util.rotations import quaternions
from blitzgs.view.gate import LodGate, ModelGate
from blitzgs.view.views import Space, render_options
from blitzgs.view.visible import Subject


def save_world_frame(folder: Path, frame: WorldFrame) -> Path:
    """Write the frame of a run's capture into its folder; returns the file."""
    path = folder / GEO
    write_file(path, json.dumps(frame.as_json(), indent=1))
    return path


def load_world_frame(folder: Path) -> WorldFrame | None:
    """Return the frame of a run's capture (ValueError: its file is damaged); None: nothing says it."""
    path = folder / GEO
    return read_world_frame(path) if path.is_file() else None


@torch.no_grad()
def in_world(model: Model, frame: WorldFrame) -> Model:
    """Return a model whose capture coordinates are those of the world; its images do not change.

    Positions stay relative to the model's origin in float32; the origin and the unit are float64.
    """
    space = model.space
    x, y, z = frame.to_world(np.array(space.offset)).tolist()
    moved = Space((x, y, z), space.unit * frame.scale, space.extent)
    if np.array_equal(frame.rotation, np.eye(3)):
        return replace(model, space=moved)
    rotation = torch.from_numpy(frame.rotation).to(model.means.device)
    return replace(
        model,
        means=(model.means.double() @ rotation.T).float(),
        quats=_product(quaternions(rotation[None])[0], model.quats.double()).float(),
        sh=rotated_harmonics(model.sh, rotation),
        space=moved,
    )


def rotated_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Return coefficients [N, K, 3] of the same colours after a rotation [3, 3] of the world.

    A band of degree l stays in its band; its matrix solves Y(d) c' = Y(R^T d) c at 4 (2 l + 1) directions.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(4 * (2 * degree + 1), 3, generator=generator, dtype=torch.float64).to(sh.device)
    every = torch.eye(sh.shape[1], dtype=torch.float64, device=sh.device)
    after = spherical_harmonics(degree, directions, every)
    before = spherical_harmonics(degree, directions @ rotation.double(), every)
    out = sh.clone()
    for band in range(1, degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, own], before[:, own]).solution.float()
        out[:, own] = torch.einsum("ij,njc->nic", matrix, sh[:, own])
    return out


def _product(left: Tensor, right: Tensor) -> Tensor:
    """Return the products of a quaternion [4] and quaternions [N, 4], w, x, y, z."""
    w, x, y, z = left.tolist()
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return right @ torch.tensor(rows, dtype=right.dtype, device=right.device).T


def trained_columns(found: Gaussians, space: Space, ranks: Ranks) -> dict[str, Tensor]:
    """Return this rank's Gaussians as columns of a table, on the CPU: rank m of M gets the rows m, m + M, ...

    `found` has the capture's coordinates, or those less the offset of its header.
    """
    rows = slice(ranks.rank, None, ranks.world_size)
    shift = torch.from_numpy(np.array(offset_of(found.comments)) - np.array(space.offset))
    levels = torch.zeros(len(found)) if found.levels is None else found.levels
    columns = {
        "means": ((found.means[rows].double() + shift) / space.unit).float(),
        "quats": found.quats[rows],
        # A file may have flat Gaussians and opacities of 0 or 1; no gradient would move them.
        "scales": found.scales[rows].clamp(min=-30) - math.log(space.unit),
        "opacities": found.opacities[rows].clamp(-15, 15),
        "sh": found.sh[rows],
        "level": levels[rows].clamp(0, 255).to(torch.uint8),
        "id": torch.arange(len(found))[rows],
    }
    return {name: column.contiguous() for name, column in columns.items()}


def trained_table(found: Gaussians, space: Space, ranks: Ranks) -> GaussianTable:
    """Return this rank's Gaussians on its device, neighbours beside each other, for rendering only."""
    columns = trained_columns(found, space, ranks)
    order = morton_order(columns["means"])
    return GaussianTable.of_parameters(
        {name: column[order].to(ranks.device) for name, column in columns.items()}
    )


def check_seen(found: Gaussians, path: Path, capture: Capture) -> None:
    """Refuse a file of which no view of a capture shows a Gaussian (ValueError): its world is another."""
    positions = found.means.double().numpy() + offset_of(found.comments) - capture.offset
    if not np.isfinite(nearest_depths(capture.cameras, positions)).any():
        raise ValueError(
            f"{path}: no view of {capture.root} sees one of its {len(found):,} Gaussians: the file must have "
            "the coordinates of that capture, not those of the world or of another program"
        )


def gate_of(found: Gaussians, unit: float) -> tuple[LodGate | None, float]:
    """Return the LOD gate in a header of `blitzgs export`, and the share that a view with it keeps at least.

    `unit` is a trained unit in the file's. Headers of old files do not state the share, which is then 0.
    ValueError: the header states a gate that no run has.
    """
    pattern = (
        r"comment lod reference_distance (\S+) fork (\S+) levels (\d+) finest (\d+)"
        r"( smooth)?(?: least (\S+))?"
    )
    matches = [match for line in found.comments if (match := re.fullmatch(pattern, line.strip()))]
    if not matches or found.levels is None:
        return None, 0.0
    distance, fork, count, finest, smooth, least = matches[0].groups()
    with located(f"the header line {matches[0][0]!r:.100} is damaged, export the file again"):
        gate = LodGate(float(distance) / unit, float(fork), int(count), int(finest), smooth is not None)
        share = float(least or 0)
        if not (gate.finest < gate.count <= 256 and 0 <= share <= 1):
            raise ValueError("no run has these levels")
        if not (0 < gate.reference_distance < math.inf and 1 < gate.fork < math.inf):
            raise ValueError("no run has these distances")
    return gate, share


def config_of_file(found: GaussianSource) -> Config:
    """Return a configuration with what the header of a file states: antialiasing and background."""
    background = triple_of(found.comments, "background")
    if background is not None and not all(0 <= value <= 1 for value in background):
        background = None
    return Config(model=ModelConfig(antialiased=is_antialiased(found), background=background))


def subject_of_file(found: Gaussians, config: Config, space: Space, ranks: Ranks) -> Subject:
    """Return what views of the Gaussians of a file are rendered from. Collective if the file has an LOD gate.

    The same views have the gate as those of the run that the file was exported from.
    """
    table, (gate, least) = trained_table(found, space, ranks), gate_of(found, space.unit)
    options = render_options(config, space, found.degree, gate)
    lod = None if gate is None else ModelGate(gate, MOST_KEPT, table, ranks, least)
    return Subject(table, options, space, lod)
