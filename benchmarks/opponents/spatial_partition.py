# SPDX-License-Identifier: Apache-2.0
"""Spatial partition: divides a scene into a uniform grid of blocks with halos, trains each, and merges them.

The grid divides the box around the capture's points, without the farthest 2 % at each end, in the plane in
which the cameras fly (the two main axes of their centres). The outermost cells extend to infinity. Each cell
is enlarged by a halo, a share of the cell's edge on each side. A block is trained from the points in its
enlarged cell. Its cameras are those that

- are inside the enlarged cell (VastGaussian's position rule), or
- have at least a quarter of the points in their picture inside it (VastGaussian's visibility rule, with
  points instead of its projected boxes; Lin et al. 2024, section 3.2).

Configuration, unit of length and extent are those of the whole scene. The merged model takes from each block
the Gaussians inside the cell without the halo.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore
from blitzgs.config.fields import Config
from blitzgs.distributed.group import Ranks
from blitzgs.table.table import REQUIRED, GaussianTable
from blitzgs.training.agreement import Agreement
from blitzgs.training.trainer import Trainer

Float64 = npt.NDArray[np.float64]
LEFT_OUT = 0.02  # share of the points outside the divided box, on each side
HALO = 0.2  # width of the halo on each side, as a share of a cell's edge
LEAST_SEEN = 0.25  # share of the points in a camera's picture from which the camera belongs to a block
LEAST_POINTS = 4  # smallest number of points from which a block is trained
_SAMPLED_POINTS = 20_000  # number of points by which the visibility rule is computed


class Grid:
    """A grid of `columns` x `rows` cells over the points of a capture, numbered row by row."""

    def __init__(self, capture: Capture, columns: int, rows: int) -> None:
        """Divide the box around most points on the plane of the cameras' flight.

        ValueError: the training cameras, or the points, are on one line.
        """
        self.shape = np.array([columns, rows])
        centres = camera_centres(np.stack([capture.cameras[i].world_to_camera for i in capture.train]))
        self._middle = centres.mean(axis=0)
        _, spread, axes = np.linalg.svd(centres - self._middle, full_matrices=False)
        if len(centres) < 3 or spread[1] < 1e-6 * max(spread[0], 1e-300):
            raise ValueError(f"{capture.root}: the training cameras span no plane to lay a grid over")
        self._axes = axes[:2]
        flat = (capture.points - self._middle) @ self._axes.T
        self._low, high = np.quantile(flat, [LEFT_OUT, 1 - LEFT_OUT], axis=0)
        self._edge = (high - self._low) / self.shape
        if not (self._edge > 0).all():
            raise ValueError(f"{capture.root}: the points span no plane to lay a grid over")

    @property
    def cells(self) -> int:
        """The number of cells."""
        return int(self.shape.prod())

    def coordinates(self, points: Float64) -> Float64:
        """Return the positions of points [N, 3] of the re-centred capture, in cells from a corner, [N, 2]."""
        return ((points - self._middle) @ self._axes.T - self._low) / self._edge

    def inside(self, coordinates: Float64, cell: int, halo: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return which coordinates [N, 2] are in a cell that is enlarged by `halo` of its edge, [N]."""
        place = np.array([cell % self.shape[0], cell // self.shape[0]])
        low = np.where(place == 0, -np.inf, place - halo)
        high = np.where(place == self.shape - 1, np.inf, place + 1 + halo)
        return ((coordinates >= low) & (coordinates < high)).all(axis=1)


@dataclass(frozen=True)
class Block:
    """The cameras and points on which one cell is trained."""

    cell: int
    cameras: list[int]  # indices in the capture
    points: npt.NDArray[np.bool_]  # bool [M], the points of the capture from which the training starts


def divide(capture: Capture, grid: Grid) -> list[Block]:
    """Return the blocks of a capture, one for each cell; a camera may belong to several, or to none."""
    places = grid.coordinates(capture.points)
    grown = np.stack([grid.inside(places, cell, HALO) for cell in range(grid.cells)])
    step = max(1, len(capture.points) // _SAMPLED_POINTS)
    sampled, within = capture.points[::step], grown[:, ::step].astype(np.float64)
    cameras: list[list[int]] = [[] for _ in range(grid.cells)]
    for index in capture.train:
        camera = capture.cameras[index]
        centre = grid.coordinates(camera_centres(camera.world_to_camera[None]))
        seen = _in_picture(sampled, camera)
        shares = within @ seen / max(int(seen.sum()), 1)
        for cell in range(grid.cells):
            if shares[cell] >= LEAST_SEEN or grid.inside(centre, cell, HALO)[0]:
                cameras[cell].append(index)
    return [Block(cell, cameras[cell], grown[cell]) for cell in range(grid.cells)]


def coverage(capture: Capture, blocks: list[Block]) -> dict[str, int]:
    """Count the training cameras, those in some block, those in several, and all assignments to blocks."""
    counts = np.zeros(len(capture.cameras), np.int64)
    for block in blocks:
        counts[block.cameras] += 1
    return {
        "cameras": len(capture.train),
        "covered": int((counts > 0).sum()),
        "in_several": int((counts > 1).sum()),
        "assignments": int(counts.sum()),
    }


@dataclass(frozen=True)
class Merged:
    """A model that was merged from blocks."""

    table: GaussianTable  # in the unit of the whole scene
    sh_degree: int  # with which the model is rendered
    # Of each cell "cameras", "points", "seconds" of training, "images" trained on, "gaussians" trained and
    # "kept" of them, "peak"; those that could not be trained have zeros.
    blocks: list[dict[str, Any]]
    merge_seconds: float


class _BlockTrainer(Trainer):
    """A trainer that leaves its model in memory."""

    def finish(self, agreement: Agreement) -> dict[str, Any]:
        """Apply all pending steps; write nothing."""
        self.state.catch_up()
        return {}


def train(
    config: Config, capture: Capture, images: ImageStore, ranks: Ranks, grid: Grid, blocks: list[Block]
) -> Merged:
    """Train every block (of `divide`) that has cameras and points on one rank, and merge the models.

    ValueError: no block could be trained. InterruptedError: stopped by a signal.
    """
    records, parts, degree = [], [], 0
    merge_seconds = 0.0
    for block in blocks:
        record = {"cell": block.cell, "cameras": len(block.cameras), "points": int(block.points.sum())}
        records.append(record | dict.fromkeys(("images", "seconds", "gaussians", "kept", "peak"), 0))
        if len(block.cameras) < config.schedule.batch_size or record["points"] < LEAST_POINTS:
            continue
        trainer = _train_block(config, capture, images, ranks, block)
        state, begin = trainer.state, time.monotonic()
        degree = max(degree, state.progress.sh_degree)
        places = grid.coordinates(state.table["means"].double().cpu().numpy() * state.space.unit)
        own = torch.from_numpy(grid.inside(places, block.cell)).to(ranks.device)
        parts.append({name: state.table[name][own].cpu() for name in REQUIRED})
        merge_seconds += time.monotonic() - begin
        records[-1] |= {
            "images": state.images_seen,
            "seconds": state.progress.seconds,
            "gaussians": len(state.table),
            "kept": int(own.sum()),
            "peak": max(state.progress.peak_gaussians, len(state.table)),
        }
        print(f"block {block.cell + 1} of {grid.cells}: {records[-1]}", flush=True)
    if not parts:
        raise ValueError(f"{capture.root}: no block of the grid has cameras and points enough to train")
    begin = time.monotonic()
    columns: dict[str, Tensor] = {name: torch.cat([part[name] for part in parts]) for name in REQUIRED}
    columns["id"] = torch.arange(len(columns["id"]))  # blocks number their Gaussians alike
    table = GaussianTable.create({name: column.to(ranks.device) for name, column in columns.items()})
    merge_seconds += time.monotonic() - begin
    return Merged(table, degree, records, merge_seconds)


def _train_block(config: Config, capture: Capture, images: ImageStore, ranks: Ranks, block: Block) -> Trainer:
    chosen = {
        name: None if (column := getattr(capture, name)) is None else column[block.points]
        for name in ("points", "colors", "track_lengths", "errors")
    }
    part = dataclasses.replace(capture, train=block.cameras, test=[], **chosen)
    with tempfile.TemporaryDirectory() as folder:
        trainer = _BlockTrainer(config, part, images, Path(folder), ranks)
        if trainer.train() is None:
            raise InterruptedError("stopped by a signal")
    return trainer


def makespan(seconds: list[float], gpus: int) -> float:
    """Return the time after which `gpus` GPUs have trained all blocks, if the longest blocks start first."""
    ends = [0.0] * gpus
    for value in sorted(seconds, reverse=True):
        ends[ends.index(min(ends))] += value
    return max(ends)


def _in_picture(points: Float64, camera: Any) -> npt.NDArray[np.bool_]:
    """Return which points [N, 3] are inside a camera's picture, also if something hides them."""
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    x, y, depth = pixels[:, 0], pixels[:, 1], seen[:, 2]
    return (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width * depth) & (y < camera.height * depth)
