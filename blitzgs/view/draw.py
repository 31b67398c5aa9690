# SPDX-License-Identifier: Apache-2.0
"""Renders what a viewer asks for, from a model at rest or in the middle of its training, on any ranks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from blitzgs.formats.gaussians import SH_C0
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import Frame, RenderOptions, render_frame, tile_grid
from blitzgs.frame.tiles import TileAssignment, collect_images
from blitzgs.frame.transport.protocol import LocalTransport
from blitzgs.ops.blocks import BLOCK_ROWS, ActiveRows
from blitzgs.ops.host import to_host
from blitzgs.ops.projection_types import Sizes, Views
from blitzgs.ops.rasterize import rasterize
from blitzgs.table.pool import Pool
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.gate import ModelGate
from blitzgs.view.look import Look, Mode, Picture
from blitzgs.view.visible import Subject, TableOrPool, VisibleFinder, VisibleRows

T = TypeVar("T")

# Bytes of a frame for each Gaussian that a view may see (the splat, its copy on another rank, list entries
# and their sorting), and for each pixel.
_ROW_BYTES, _PIXEL_BYTES = 300, 64
# About so many Gaussians are projected, listed and composited at a time (`VisibleFinder.depths`), so that a
# frame of any model takes some hundred megabytes of a GPU. The CPU has more memory and takes longer by layer.
LAYER_ROWS = {"cuda": 2_000_000, "cpu": 16_000_000}
# Where less light than this comes through the layers in front, pixels do not count what is behind.
_OPAQUE = 1e-3
# Colours of the octree levels from coarse to fine, repeated beyond the last.
LEVEL_COLOURS = (
    (0.27, 0.00, 0.33), (0.23, 0.32, 0.55), (0.13, 0.57, 0.55), (0.37, 0.79, 0.38), (0.99, 0.91, 0.14),
    (0.99, 0.55, 0.24), (0.84, 0.19, 0.15), (0.55, 0.00, 0.40), (0.90, 0.55, 0.76), (0.65, 0.65, 0.65),
)  # fmt: skip


class DrawingError(RuntimeError):
    """A picture cannot be drawn; every rank of the job raises this together, and may go on."""


class Drawer:
    """Draws one `Subject`; every rank of the job has one."""

    def __init__(self, subject: Subject, owners: TileOwners, in_layers: bool = True) -> None:
        """Prepare.

        `owners`: divides the tiles among the ranks. `in_layers`: on one rank, composite large models layer by
        layer, which takes less memory. A pixel may then get up to a hundredth of light that a whole pass
        would have left out.
        """
        self._subject, self._owners, self._in_layers = subject, owners, in_layers
        self._transport = LocalTransport() if owners.ranks.world_size == 1 else None
        self._finders: dict[tuple[bool, bool | None], VisibleFinder] = {}

    @torch.no_grad()
    def draw(self, look: Look) -> Picture | None:
        """Render a look, the same on all ranks; rank 0 gets the picture (DrawingError: a rank cannot)."""
        begin, subject, ranks = time.perf_counter(), self._subject, self._owners.ranks
        device = ranks.device
        pose, K = (torch.from_numpy(matrix).float()[None].to(device) for matrix in (look.viewmat, look.K))
        views = Views(pose, K, look.width, look.height)
        options = self._options(look)
        ranges = assignment = None
        if ranks.world_size > 1:
            self._together(lambda: _reserve(subject.gaussians, look, device))
            ranges = self._owners.divide([None], look.width, look.height)
            assignment = TileAssignment(ranks, ranges)
        depths = [options.near_plane, options.far_plane]
        if assignment is None and self._in_layers:
            blocks = LAYER_ROWS[device.type] // BLOCK_ROWS
            depths = self._together(lambda: self._finder(look).depths(views, depths, blocks))
        seen, layered = torch.zeros((), dtype=torch.int64, device=device), None
        for near, far in pairwise(depths):
            layer = replace(options, near_plane=near, far_plane=far)
            count, layered = self._layer(look, views, layer, assignment, layered)
            seen += count.sum()
        assert layered is not None
        behind = subject.options.background if look.background is None else look.background
        image = self._together(lambda: _image(*layered, look.mode, behind, subject.space.unit))
        if ranges is not None:
            collect_images(image, ranges, ranks, destination=0)
        if ranks.rank != 0:
            return None
        values = to_host(image[0]).numpy()
        values = values[..., 0] if values.shape[-1] == 1 else values
        return Picture(values, int(seen), 1000 * (time.perf_counter() - begin))

    def _layer(
        self,
        look: Look,
        views: Views,
        options: RenderOptions,
        assignment: TileAssignment | None,
        front: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Composite the Gaussians between two depths behind what is in front of them.

        Returns how many are seen, int64 [1]; what is composited by now, float32 [1, H, W, C], and the light
        that still comes through it, [1, H, W].
        """
        gaussians, painted = self._subject.gaussians, look.mode == "level"
        table: GaussianTable
        active: ActiveRows | Callable[[Sizes | None], ActiveRows]
        if assignment is None and not isinstance(gaussians, Pool):

            def active(capacity: Sizes | None) -> ActiveRows:
                room = capacity.blocks if capacity is not None and gaussians.device.type == "cuda" else None
                return self._together(lambda: self._found(look, views, options, room)).active

            table = gaussians
        else:
            # All ranks find their rows before any projects: an error of one rank is one of all.
            table, active, _ = self._together(lambda: self._found(look, views, options))
        frame = render_frame(
            _painted(table) if painted else table, views, options, active, assignment, self._transport
        )
        image, light = self._together(lambda: _channels(frame, look.mode)), frame.saved.composited[0]
        if front is not None:
            before, through = front
            shown = through > _OPAQUE if look.mode == "count" else through
            image, light = image.mul_(shown[..., None]).add_(before), light.mul_(through)
        return frame.visible, (image, light)

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

    def _found(
        self, look: Look, views: Views, options: RenderOptions, room: int | None = None
    ) -> VisibleRows:
        found = self._finder(look).find(views, options.limits, room)
        if look.crop is None:
            return found
        return found._replace(active=_cropped(found.active, found.table["means"], look.crop))

    def _options(self, look: Look) -> RenderOptions:
        options, gate = self._subject.options, self._gate(look)
        wanted = options.sh_degree if look.sh_degree is None else look.sh_degree
        return replace(
            options,
            sh_degree=0 if look.mode == "level" else min(options.sh_degree, wanted),
            near_plane=options.near_plane if look.near is None else look.near,
            far_plane=options.far_plane if look.far is None else look.far,
            background=(0.0, 0.0, 0.0),  # `_image` adds the one of the look
            fade=() if gate is None else gate.gate.fade(),
        )

    def _gate(self, look: Look) -> ModelGate | None:
        """Return the gate of a look, with the levels cut off or faded as it asks."""
        lod = self._subject.lod if look.lod else None
        if lod is None or look.smooth is None or look.smooth == lod.gate.smooth:
            return lod
        return lod.with_smooth(look.smooth)

    def _finder(self, look: Look) -> VisibleFinder:
        key = (look.lod, look.smooth)
        if key not in self._finders:
            self._finders[key] = VisibleFinder(self._subject.gaussians, self._gate(look))
        return self._finders[key]


def _reserve(gaussians: TableOrPool, look: Look, device: torch.device) -> None:
    """Allocate the memory of a frame, which torch keeps for it: or one rank would fail in its middle."""
    if device.type == "cuda":
        rows = len(gaussians.held if isinstance(gaussians, Pool) else gaussians)
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
    levels = table["level"].int() % len(colours)
    sh = ((colours - 0.5) / SH_C0)[levels][:, None]
    columns = {name: table[name] for name in (*PARAMETERS[:4], "level", "id")}
    return GaussianTable.of_parameters(columns | {"sh": sh})


def _channels(frame: Frame, mode: Mode) -> Tensor:
    """Return what the Gaussians of a frame add to each pixel of a mode, float32 [1, H, W, C]."""
    transmittances, last_ids, *_ = frame.saved.composited
    if mode == "alpha":
        return (1 - transmittances)[..., None]
    if mode == "count":
        return last_ids[..., None].float()
    if mode != "depth":
        return frame.renders
    splats, grid = frame.splats, tile_grid(frame.views, frame.assignment)
    depth, _ = rasterize(
        splats.means2d, splats.conics, splats.opacities, splats.depths[:, None], *frame.saved.lists,
        **grid._asdict(),
    )  # fmt: skip
    return depth


def _image(
    channels: Tensor, light: Tensor, mode: Mode, background: tuple[float, float, float], unit: float
) -> Tensor:
    """Return what to show: uint8 [1, H, W, 3], or float32 [1, H, W, 1]."""
    light = light[..., None]
    if mode == "depth":
        mean = channels * unit / (1 - light).clamp_min(1e-10)
        return mean.where(light < 0.95, 0.0)
    if mode in ("alpha", "count"):
        return channels.contiguous()
    behind = torch.tensor(background, device=channels.device)
    return channels.addcmul(light, behind).clamp_(0, 1).mul_(255).add_(0.5).to(torch.uint8)


def intrinsics(width: int, height: int, vertical_fov: float) -> np.ndarray:
    """Return the intrinsics [3, 3] in pixels of a centred camera with square pixels; the angle in radians."""
    focal = 0.5 * height / math.tan(0.5 * vertical_fov)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=np.float64)
