# SPDX-License-Identifier: Apache-2.0
"""Renders views of a table and their gradients without autograd, in the one loop over attempts.

No tensor here is as long as the table: the cost follows the Gaussians that the views see. Between projection
and lists, a transport sends the splats to the ranks that composite them, and later returns their gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport import open_transport
from blitzgs.frame.transport.protocol import (
    Exchange,
    ExchangeResult,
    Transport,
    WayBack,
    stage_ended,
)
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.intersect import TILE_SIZE, TileGrid
from blitzgs.ops.projection_types import (
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
    Splats,
    Views,
)
from blitzgs.ops.rasterize import GradientBuffer, RasterizeSaved, SplatGradients
from blitzgs.table.table import GaussianTable


@dataclass(frozen=True)
class RenderOptions:
    """How Gaussians become an image; lengths in the unit of the table."""

    sh_degree: int  # spherical-harmonics degree that is evaluated
    near_plane: float  # Gaussians with z <= near_plane are not seen
    far_plane: float  # Gaussians with z > far_plane are not seen
    eps2d: float = 0.3  # screen-space blur, pixels squared
    antialiased: bool = False  # compensate that blur in the opacities
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB behind everything
    deterministic: bool = False  # gradients repeat bit for bit on CUDA too (they always do on the CPU)
    fade: tuple[float, ...] = ()  # `blitzgs.view.gate.LodGate.fade`; empty: opacities do not fade

    @property
    def limits(self) -> tuple[float, float, float]:
        """Near plane, far plane and eps2d, which decide whether a view may see a Gaussian."""
        return self.near_plane, self.far_plane, self.eps2d

    def projection(self, views: Views) -> ProjectionOptions:
        """Return the options for projecting into these views."""
        return ProjectionOptions(
            width=views.width,
            height=views.height,
            sh_degree=self.sh_degree,
            near_plane=self.near_plane,
            far_plane=self.far_plane,
            eps2d=self.eps2d,
            antialiased=self.antialiased,
            fade=self.fade,
        )


class Frame(NamedTuple):
    """The images that `render_frame` rendered, and the data that `backward_splats` needs."""

    views: Views
    options: RenderOptions
    projected: ProjectedSplats  # the P splats of the Gaussians that this rank owns
    splats: Splats  # the splats that this rank composited: its own, or those that it received
    assignment: TileAssignment | None  # the tiles of each rank; None: one rank composites all
    way_back: WayBack | None  # returns the gradients of splats to their owners; None: one rank owns all
    visible: Tensor  # int64 [B], Gaussians seen by each view, of all ranks; valid until the next exchange
    active: ActiveRows | None  # rows that were considered, and the views of each; None: all
    renders: Tensor  # [B, H, W, 3]; undefined in pixels that only other ranks composite
    tile_work: Tensor  # int32 [B * T], list entries each composited tile went through
    saved: RasterizeSaved  # the tensors that the backward pass of compositing reads
    gradients: GradientBuffer  # memory in which the gradients of the splats are summed

    @property
    def own_tiles(self) -> tuple[int, int]:
        """The tiles whose loss this rank computes, [first, one past last); -1: all from the first on."""
        return (0, -1) if self.assignment is None else self.assignment.own_tiles

    def over_own_background(self) -> Tensor:
        """Return the renders over the background of the options, if views had others, [B, H, W, 3]."""
        given = self.saved.backgrounds
        own = _backgrounds(self.options.background, len(self.views), self.renders.device)
        if given is own or given is None:
            return self.renders
        change = -given if own is None else own - given
        return torch.addcmul(self.renders, self.saved.composited[0][..., None], change[:, None, None])


def render_frame(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | Callable[[Sizes | None], ActiveRows] | None = None,
    assignment: TileAssignment | None = None,
    transport: Transport | None = None,
    backward_follows: bool = False,
    backgrounds: Tensor | None = None,
) -> Frame:
    """Render views of a table whose active rows have no pending optimiser steps.

    Args:
        views: at most 32 views.
        options: how to render.
        active: rows to consider, and the views of each; None: all rows in all views. Or a function that finds
            them, given the capacity for the frame (see `run_attempts`).
        assignment: the tiles of each rank; every rank of the job calls this with its table. None: render all
            tiles from this table alone.
        transport: sends the splats to the ranks that composite them. A transport that is used for several
            frames estimates the sizes of a frame from the frames before, so that the device need not wait for
            the host; the result does not depend on it. None: a new one.
        backward_follows: prepare for a backward pass, which is then faster; the backward pass also works
            without.
        backgrounds: the colour behind everything in each view, float32 [B, 3]; None: that of the options.

    Returns:
        The frame; its images do not depend on the order of the table's rows, on inactive rows, or on how many
        ranks shared the work.
    """
    transport = transport or open_transport(None if assignment is None else assignment.ranks)
    grid = tile_grid(views, assignment)
    if backgrounds is None:
        backgrounds = _backgrounds(options.background, len(views), views.viewmats.device)

    def attempt(capacity: Sizes | None) -> tuple[Exchange, Any]:
        rows = active(capacity) if callable(active) else active
        inputs = inputs_of(table, views, options, rows)
        exchange = transport.project_and_send(inputs, assignment, capacity)
        return exchange, (rows, *_composite(exchange, grid, backgrounds, backward_follows))

    result, (rows, lists, images, zeros) = run_attempts(transport, attempt)
    renders, transmittances, last_ids, tile_work, packed_splats, tile_order = images
    splats = result.splats
    columns = [splats.means2d, splats.conics, splats.opacities, splats.colors]
    saved = RasterizeSaved(columns, backgrounds, lists, [transmittances, last_ids, packed_splats, tile_order])
    others = None if result.way_back is None else result.way_back.cleared_table
    return Frame(
        views=views,
        options=options,
        projected=result.projected,
        splats=splats,
        assignment=assignment,
        way_back=result.way_back,
        visible=result.visible,
        active=rows,
        renders=renders,
        tile_work=tile_work,
        saved=saved,
        gradients=GradientBuffer(zeros, others),
    )


def _composite(
    exchange: Exchange, grid: TileGrid, backgrounds: Tensor | None, backward_follows: bool
) -> tuple[list[Tensor], Sequence[Tensor], Tensor | None]:
    """Return the tiles' lists, what `rasterize_fwd` returns, and zeros for the gradients of splats."""
    splats, lists = exchange.arrived, tile_lists(exchange, grid)
    stage_ended("sort")
    geometry = (splats.means2d, splats.conics, splats.opacities)
    arguments = (*geometry, splats.colors, backgrounds, *lists, *grid)
    shared = exchange.gradient_table
    if shared is not None and backward_follows:
        images = torch.ops.blitzgs.rasterize_fwd_(*arguments, shared, exchange.n_splats)
        zeros = shared
    else:
        *images, zeros = torch.ops.blitzgs.rasterize_fwd(
            *arguments, False, backward_follows, exchange.n_splats
        )
        if shared is not None:
            zeros = None  # the gradients must be in `shared`, which the backward pass then zeroes
    stage_ended("raster")
    return lists, images, zeros


def inputs_of(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | None = None,
    colored: bool = True,
) -> ProjectionInputs:
    """Return the inputs of the projection of a table; `colored`: with SH, from which colours are computed."""
    cameras = (views.viewmats, views.Ks)
    gaussians = table.parameters if colored else table.parameters[:4]
    level = table["level"] if options.fade else None
    return ProjectionInputs(gaussians, cameras, options.projection(views), active or (), table["id"], level)


def tile_lists(exchange: Exchange, grid: TileGrid) -> list[Tensor]:
    """Return the splats that each tile composites and where the list of each tile begins (op `intersect`)."""
    splats = exchange.arrived
    lists = torch.ops.blitzgs.intersect(
        splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, splats.ids,
        *grid, exchange.n_isects, exchange.n_splats, unchecked=True,
    )  # fmt: skip
    return list(lists)


def tile_grid(views: Views, assignment: TileAssignment | None) -> TileGrid:
    """Return the grid of tiles, with the range of them that this rank composites."""
    tiles = (0, -1) if assignment is None else assignment.composited_tiles
    return TileGrid(len(views), views.width, views.height, TILE_SIZE, *tiles)


@lru_cache(maxsize=16)
def _backgrounds(colour: tuple[float, float, float], count: int, device: torch.device) -> Tensor | None:
    """Return a colour for each of `count` views, [B, 3]; None: black. Cached: the host waits for uploads."""
    return torch.tensor(colour, device=device).repeat(count, 1) if any(colour) else None


def backward_splats(frame: Frame, v_renders: Tensor) -> SplatGradients:
    """Compute the gradients of this rank's projected splats from the gradients of the images.

    `v_renders`: gradient of the loss by the images, [B, H, W, 3]; only this rank's tiles are read.
    RuntimeError: the ranks share memory, and a later frame has overwritten this frame's splats.
    """
    views, options, way_back = frame.views, frame.options, frame.way_back
    grid = TileGrid(len(views), views.width, views.height, TILE_SIZE, *frame.own_tiles)
    if way_back is not None:
        way_back.check_still_valid()
    table = frame.gradients.take(frame.splats.means2d) if v_renders.is_cuda else None
    *parts, _ = torch.ops.blitzgs.rasterize_bwd(
        *frame.saved, v_renders, None, *grid, False, options.deterministic, table
    )
    gradients = SplatGradients(parts if table is None else [table])
    stage_ended("raster back")
    if way_back is not None:
        gradients = way_back.return_gradients(gradients)
    stage_ended("exchange back")
    return gradients


# A failed attempt reports the sizes that it needs, and the next attempt uses them. More attempts than this
# mean that the inputs change or that the program is wrong.
MAX_ATTEMPTS = 4

Outputs = TypeVar("Outputs")


def run_attempts(
    transport: Transport, attempt: Callable[[Sizes | None], tuple[Exchange, Outputs]]
) -> tuple[ExchangeResult, Outputs]:
    """Queue a frame's work, without gradients, until all results had enough memory.

    `attempt`: given the capacity that `transport` estimates (None: the work waits for the sizes), projects
    and sends the splats, and queues the work with those that arrive. It returns the exchange and the outputs
    of this work, and keeps neither: another attempt needs their memory. Returns the splats, cut to their
    numbers, and the outputs of the last attempt. RuntimeError: `MAX_ATTEMPTS` attempts did not suffice.
    """
    for _ in range(MAX_ATTEMPTS):
        capacity = None if transport.estimate is None else transport.estimate.sizes
        # Skip autograd: for an op with a registered gradient formula, its Python takes 20 us of host time.
        with below_autograd():
            exchange, outputs = attempt(capacity)
            needed, result = exchange.finish()
        if transport.estimate is not None:
            transport.estimate.learn(needed)
        if result is not None:
            return result, outputs
        del exchange, outputs  # before the next attempt takes as much memory again
    raise RuntimeError(
        f"{MAX_ATTEMPTS} attempts have each needed more than the one before had asked for: the last had "
        f"{capacity} and needs {tuple(needed)}. The inputs must not change during a call"
    )


class Survey(NamedTuple):
    """The contributions of this rank's P splats to their views."""

    splats: ProjectedSplats  # the projected Gaussians
    weights: Tensor  # int64 [P], sum of alpha T over the pixels in units of 2^-32
    pixels: Tensor  # int32 [P], the number of pixels at which a splat is composited
    squares: Tensor | None = None  # int64 [P], sum of (alpha T)^2 in these units, if asked for


def survey(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    assignment: TileAssignment | None = None,
    transport: Transport | None = None,
    active: ActiveRows | None = None,
    squares: bool = False,
) -> Survey:
    """Measure what each Gaussian contributes to views of a table without pending optimiser steps.

    Args:
        views: at most 32 views.
        options: how to render; no colour is computed.
        assignment: the tiles of each rank; every rank of the job calls this with its table. None: this rank
            composites all tiles.
        transport: as for `render_frame`.
        active: as for `render_frame`.
        squares: whether to sum the squares as well.

    Returns:
        The splats of this rank's Gaussians with the sums over the tiles of all ranks; the bits do not depend
        on the number of ranks.
    """
    transport = transport or open_transport(None if assignment is None else assignment.ranks)
    inputs = inputs_of(table, views, options, active, colored=False)
    grid = tile_grid(views, assignment)

    def attempt(capacity: Sizes | None) -> tuple[Exchange, tuple[Tensor, Tensor, Tensor]]:
        exchange = transport.project_and_send(inputs, assignment, capacity)
        splats, lists = exchange.arrived, tile_lists(exchange, grid)
        geometry = (splats.means2d, splats.conics, splats.opacities)
        return exchange, torch.ops.blitzgs.contributions(*geometry, *lists, *grid, exchange.n_splats, squares)

    result, sums = run_attempts(transport, attempt)
    columns = [column[: len(result.splats.depths)] for column in (sums if squares else sums[:2])]
    if result.way_back is not None:
        returned = result.way_back.return_sums(torch.stack([column.long() for column in columns], 1))
        weights, pixels, *rest = (column.contiguous() for column in returned.unbind(1))
        columns = [weights, pixels.int(), *rest]
    return Survey(result.projected, *columns)
