# SPDX-License-Identifier: Apache-2.0
"""The world of a run: its file `geo.json`, and the model in world coordinates."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.cameras import Float64
from blitzgs.capture.colmap import rotation_to_quat
from blitzgs.capture.world import GEO, WorldFrame, read_frame
from blitzgs.ops.harmonics import spherical_harmonics
from blitzgs.runs.folder import Model
from blitzgs.util.output import write_file
from blitzgs.view.views import Space


def save_frame(folder: Path, frame: WorldFrame) -> Path:
    """Write the frame of a run's capture into its folder; returns the file."""
    path = folder / GEO
    write_file(path, json.dumps(frame.as_json(), indent=1))
    return path


def load_frame(folder: Path) -> WorldFrame | None:
    """Return the frame of a run's capture (ValueError: its file is damaged); None: nothing says it."""
    path = folder / GEO
    return read_frame(path) if path.is_file() else None


@torch.no_grad()
def in_world(model: Model, frame: WorldFrame) -> Model:
    """Return a model whose capture coordinates are those of the world; its images do not change.

    Positions stay relative to the model's origin in float32; the origin and the unit are float64.
    """
    space = model.space
    origin = frame.to_world(np.array(space.offset))
    moved = Space(
        (origin[0].item(), origin[1].item(), origin[2].item()), space.unit * frame.scale, space.extent
    )
    if np.array_equal(frame.rotation, np.eye(3)):
        return replace(model, space=moved)
    rotation = torch.from_numpy(frame.rotation).to(model.means.device)
    return replace(
        model,
        means=(model.means.double() @ rotation.T).float(),
        quats=_product(rotation_to_quat(frame.rotation), model.quats.double()).float(),
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


def _product(left: Float64, right: Tensor) -> Tensor:
    """Return the products of a quaternion [4] and quaternions [N, 4], w, x, y, z."""
    w, x, y, z = left.tolist()
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return right @ torch.tensor(rows, dtype=right.dtype, device=right.device).T
