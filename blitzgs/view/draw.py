# SPDX-License-Identifier: Apache-2.0
"""Renders what a viewer asks for, from a model at rest or in the middle of its training, on any ranks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import Frame, RenderOptions, Views
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.tiles import TileAssignment, TileRanges, collect_images
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.rasterize import rasterize
from blitzgs.table.pool import Pool
from blitzgs.table.table import PARAMETERS, GaussianTable, schema
from blitzgs.view.gate import SceneGate
from blitzgs.view.look import Look, Picture
from blitzgs.view.visible import Scene, VisibleFinder

T = TypeVar("T")

# The constant of the first spherical harmonic: colour = 0.5 + _SH_0 * coefficient.
_SH_0 = 0.28209479177387814
# Bytes of a frame for each Gaussian that a view may see (the splat, its copy on another rank, list entries
# and their sorting), and for each pixel.
_ROW_BYTES, _PIXEL_BYTES = 300, 64
# Colours of the octree levels from coarse to fine, repeated beyond the last.
LEVEL_COLOURS = (
    (0.27, 0.00, 0.33), (0.23, 0.32, 0.55), (0.13, 0.57, 0.55), (0.37, 0.79, 0.38), (0.99, 0.91, 0.14),
    (0.99, 0.55, 0.24), (0.84, 0.19, 0.15), (0.55, 0.00, 0.40), (0.90, 0.55, 0.76), (0.65, 0.65, 0.65),
)  # fmt: skip


@dataclass(frozen=True)
class Subject:
    """The model that is drawn, as it is at one moment.

    Attributes:
        scene: this rank's Gaussians. Pending optimiser steps are not applied, so that looking at a training
            does not change it; the rows that wait for them are off by far less than a pixel.
        options: how the model is rendered, at its present spherical-harmonics degree.
        unit: length of a trained unit in the capture's unit.
        lod: the LOD gate; None: there is none.
    """

    scene: Scene
    options: RenderOptions
    unit: float
    lod: SceneGate | None


def table_of_parameters(columns: Mapping[str, Tensor]) -> GaussianTable:
    """Return a table for rendering only: the columns of the optimiser take no memory.

    Args:
        columns: `PARAMETERS`, and "level" and "id" if known.
    """
    sh = columns["sh"]
    count, degree = len(sh), round(sh.shape[1] ** 0.5) - 1
    known = dict(columns)
    if "id" not in known:
        known["id"] = torch.arange(count, device=sh.device)
    for name, column in schema(degree).items():
        if name not in known:
            known[name] = sh.new_zeros((), dtype=column.dtype).expand(count, *column.shape)
    return GaussianTable(known)


class DrawingError(RuntimeError):
    """A picture cannot be drawn; every rank of the job raises this together, and may go on."""


class Drawer:
    """Draws one `Subject`; every rank of the job has one."""

    def __init__(self, subject: Subject, owners: TileOwners) -> None:
        """Prepare; `owners` divides the tiles among the ranks."""
        self._subject, self._owners = subject, owners
        self._finders: dict[tuple[bool, bool | None], VisibleFinder] = {}

    @torch.no_grad()
    def draw(self, look: Look) -> Picture | None:
        """Render one look; every rank of the job calls this with the same look.

        Returns:
            The picture on rank 0; None elsewhere.

        Raises:
            DrawingError: a rank lacks the memory, or cannot find what the view sees.
        """
        begin, subject, ranks = time.perf_counter(), self._subject, self._owners.ranks
        device = ranks.device
        pose, K = (torch.from_numpy(matrix).float()[None].to(device) for matrix in (look.viewmat, look.K))  # noqa: N806
        views = Views(pose, K, look.width, look.height)
        options = self._options(look)
        if ranks.world_size > 1:
            self._together(lambda: _reserve(subject.scene, look, device))
        table, active = self._together(lambda: self._found(look, views, options))
        ranges = assignment = None
        if ranks.world_size > 1:
            ranges = self._owners.divide([None], look.width, look.height, options.tile_size)
            assignment = TileAssignment(ranks, ranges)
        frame = pipeline.forward(table, views, options, active, assignment)
        image = self._together(lambda: _image(frame, look, subject.unit, ranges))
        if ranges is not None:
            collect_images(image, ranges, ranks, destination=0)
        seen = int(frame.visible.sum())
        if ranks.rank != 0:
            return None
        values = image[0].cpu().numpy()
        values = values[..., 0] if values.shape[-1] == 1 else values
        return Picture(values, seen, 1000 * (time.perf_counter() - begin))

    def _together(self, work: Callable[[], T]) -> T:
        """Do this rank's part; an error on one rank is one on all, before they wait for each other."""
        ranks, result, reason = self._owners.ranks, None, None
        try:
            result = work()
        except Exception as error:
            if ranks.world_size == 1:
                raise DrawingError(str(error)) from error
            reason = f"rank {ranks.rank}: {error}"
        if ranks.world_size > 1:
            reasons = [text for text in ranks.all_gather_object(reason) if text is not None]
            if reasons:
                raise DrawingError("; ".join(reasons))
        return cast(T, result)

    def _found(self, look: Look, views: Views, options: RenderOptions) -> tuple[GaussianTable, ActiveRows]:
        table, active, _ = self._finder(look).find(*views.as_arguments(), options.limits)
        if look.crop is not None:
            active = _cropped(active, table["means"], look.crop)
        return (_painted(table) if look.mode == "level" else table), active

    def _options(self, look: Look) -> RenderOptions:
        options, gate = self._subject.options, self._gate(look)
        wanted = options.sh_degree if look.sh_degree is None else look.sh_degree
        return replace(
            options,
            sh_degree=0 if look.mode == "level" else min(options.sh_degree, wanted),
            near_plane=options.near_plane if look.near is None else look.near,
            far_plane=options.far_plane if look.far is None else look.far,
            background=options.background if look.background is None else look.background,
            fade=() if gate is None else gate.gate.fade(),
        )

    def _gate(self, look: Look) -> SceneGate | None:
        """Return the gate of a look, with the levels cut off or faded as it asks."""
        lod = self._subject.lod if look.lod else None
        if lod is None or look.smooth is None or look.smooth == lod.gate.smooth:
            return lod
        return lod.with_smooth(look.smooth)

    def _finder(self, look: Look) -> VisibleFinder:
        key = (look.lod, look.smooth)
        if key not in self._finders:
            self._finders[key] = VisibleFinder(self._subject.scene, self._gate(look))
        return self._finders[key]


def _reserve(scene: Scene, look: Look, device: torch.device) -> None:
    """Allocate the memory of a frame, which torch keeps for it: without, one rank would fail in its middle.

    Raises:
        RuntimeError: it cannot.
    """
    if device.type == "cuda":
        rows = len(scene.held if isinstance(scene, Pool) else scene)
        size = rows * _ROW_BYTES + look.width * look.height * _PIXEL_BYTES
        torch.empty(size, dtype=torch.uint8, device=device)


def _cropped(
    active: ActiveRows, means: Tensor, box: tuple[tuple[float, float, float], tuple[float, float, float]]
) -> ActiveRows:
    """Leave out the rows whose means are outside a box; entries beyond the list's length may be anything."""
    low, high = (torch.tensor(corner, device=means.device, dtype=means.dtype) for corner in box)
    rows = active.ids.long().clamp(0, max(0, len(means) - 1))
    centres = means[rows]
    inside = ((centres >= low) & (centres <= high)).all(1)
    return active._replace(views=active.views * inside)


def _painted(table: GaussianTable) -> GaussianTable:
    """Return a table of the same Gaussians, coloured by their octree levels."""
    colours = torch.tensor(LEVEL_COLOURS, device=table.device)
    levels = table["level"].long() % len(colours)
    sh = ((colours - 0.5) / _SH_0)[levels][:, None]
    columns = {name: table[name] for name in (*PARAMETERS[:4], "level", "id")}
    return table_of_parameters(columns | {"sh": sh})


def _image(frame: Frame, look: Look, unit: float, ranges: TileRanges | None) -> Tensor:
    """Return what to show of a rendered frame: uint8 [1, H, W, 3], or float32 [1, H, W, 1]."""
    transmittances, last_ids, *_ = frame.saved.composited
    if look.mode == "alpha":
        return (1 - transmittances)[..., None].contiguous()
    if look.mode == "count":
        return last_ids[..., None].float().contiguous()
    if look.mode == "depth":
        splats, lists = frame.splats, frame.saved.lists
        tiles = (0, -1) if frame.assignment is None else frame.assignment.composited_tiles
        depth, alphas = rasterize(
            splats.means2d, splats.conics, splats.opacities, splats.depths[:, None], *lists,
            n_cameras=1, width=look.width, height=look.height, tile_size=frame.options.tile_size,
            tile_begin=tiles[0], tile_end=tiles[1],
        )  # fmt: skip
        mean = depth * unit / alphas[..., None].clamp_min(1e-10)
        return mean.where(alphas[..., None] > 0.05, 0.0).contiguous()
    colours = frame.renders.clamp(0, 1).mul(255).add_(0.5)
    return colours.to(torch.uint8)


def intrinsics(width: int, height: int, vertical_fov: float) -> np.ndarray:
    """Return the intrinsics [3, 3] in pixels of a centred camera with square pixels; the angle in radians."""
    focal = 0.5 * height / math.tan(0.5 * vertical_fov)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=np.float64)
