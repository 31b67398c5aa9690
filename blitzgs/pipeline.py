# SPDX-License-Identifier: Apache-2.0
"""The hot path of training and rendering: views in, images and compact gradients out, without autograd.

`forward` goes from the active Gaussians through projection, tile intersection and compositing to a `Frame`;
`backward_rows` returns along the same route from image gradients to those of the projected rows, and
`backward` on to the gradients of the visible Gaussians alone. Nothing here is as long as the table: cost
follows what the views see. On several ranks an exchange of the projected rows sits between projection and
intersection, and its reverse between their gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.exchange import Route, send, send_back
from blitzgs.distributed.ownership import Share
from blitzgs.distributed.projection import Projection, project_views
from blitzgs.distributed.rows import Splats
from blitzgs.model import GaussianTable
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.project import RowRoom, Rows
from blitzgs.ops.rasterize import GradientRoom, gradient_columns
from blitzgs.ops.scatter import NO_TABLES, RowTables

Mark = Callable[[str], None]


def unmarked(stage: str) -> None:
    """Take no note of the end of a stage."""


@dataclass(frozen=True)
class Views:
    """B pinhole views of one image size, rendered together.

    Attributes:
        viewmats: world to camera, float32 [B, 4, 4].
        Ks: intrinsics in pixels, float32 [B, 3, 3].
        width: pixels.
        height: pixels.
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]


@dataclass(frozen=True)
class RenderOptions:
    """How Gaussians become an image; lengths in the unit of the table.

    Attributes:
        sh_degree: spherical-harmonics degree that is evaluated.
        near_plane: what is nearer is not seen.
        far_plane: what is farther is not seen.
        eps2d: screen-space blur, pixels squared.
        antialiased: compensate that blur in the opacities.
        background: RGB behind everything.
        tile_size: pixels.
        deterministic: gradients repeat bit for bit on CUDA too (they always do on the CPU).
    """

    sh_degree: int
    near_plane: float
    far_plane: float
    eps2d: float = 0.3
    antialiased: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tile_size: int = 16
    deterministic: bool = False


class Frame(NamedTuple):
    """What `forward` rendered and what `backward` needs of it.

    Attributes:
        views: the views.
        options: the options.
        rows: this rank's projected Gaussians, P rows.
        splats: what was composited: the rows, or those that the exchange brought here.
        share: who composites which tiles; None: one rank does all.
        route: of the exchange.
        visible: int64 [B], Gaussians visible in each view, over all ranks; like the gradients of rows valid
            until the next exchange.
        backgrounds: [B, 3]; None: black.
        isect_rows: int32 [I], splats by tile, front to back.
        tile_offsets: int64 [B * T + 1].
        renders: [B, H, W, 3]; like the next two undefined where other ranks composite.
        transmittances: [B, H, W], share of the background that shows.
        last_ids: int32 [B, H, W], for the backward pass.
        tile_work: int32 [B * T], list entries each composited tile went through.
        aux: the backend's own.
        room: for the gradients of the splats.
    """

    views: Views
    options: RenderOptions
    rows: Rows
    splats: Splats
    share: Share | None
    route: Route | None
    visible: Tensor
    backgrounds: Tensor | None
    isect_rows: Tensor
    tile_offsets: Tensor
    renders: Tensor
    transmittances: Tensor
    last_ids: Tensor
    tile_work: Tensor
    aux: Tensor
    room: GradientRoom


class RowGradients(NamedTuple):
    """Gradients of this rank's P rows: columns, maybe views of one table, or where they lie at the ranks.

    Attributes:
        means2d: [P, 2], per pixel; None, like the next three: in `tables`.
        conics: [P, 3].
        opacities: [P].
        colors: [P, 3].
        tables: at the ranks that composited the rows; such are valid until the next exchange, or the next
            backward pass of the frame.
    """

    means2d: Tensor | None
    conics: Tensor | None
    opacities: Tensor | None
    colors: Tensor | None
    tables: RowTables = NO_TABLES


def forward(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | None = None,
    share: Share | None = None,
    room: RowRoom | None = None,
    mark: Mark = unmarked,
    backward_follows: bool = False,
) -> Frame:
    """Render views of a table whose active rows are up to date.

    Args:
        table: the Gaussians.
        views: at most 32 views.
        options: how to render.
        active: rows to consider, and the views of each; None: all.
        share: who composites which tiles; every rank of the job calls this with its table. None: render all
            of the views from this table alone.
        room: for the rows and their lists, of the frames before; the result does not depend on it. None:
            wait for their number. With `share` it is not used: peers keep their own.
        mark: called at the end of each stage: "project", "exchange", "sort", "raster".
        backward_follows: prepare for a backward pass, which is then faster; it works in any case.

    Returns:
        The frame; its images do not depend on the order of the table's rows, on inactive rows, or on how many
        ranks shared the work.
    """
    room = room or RowRoom()
    # Past autograd's Python: an op that is differentiable elsewhere spends 20 us of the host's time there.
    with torch._C._AutoDispatchBelowAutograd():
        while True:
            with ExitStack() as waiting:
                frame = _forward(table, views, options, active, share, room, mark, backward_follows, waiting)
            if frame is not None:
                return frame


def _forward(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | None,
    share: Share | None,
    room: RowRoom,
    mark: Mark,
    backward_follows: bool,
    waiting: ExitStack,
) -> Frame | None:
    """Queue all of it, then wait for the numbers of rows; None: the room was too small, and has learnt."""
    count, grid = len(views), tile_grid(views, options, share)
    projection, splats, isect_rows, tile_offsets = list_rows(
        table, views, options, active, share, room, mark, waiting
    )
    space, n_rows = projection.space, projection.n_rows
    backgrounds = _backgrounds(options.background, count, table.device)
    if space is not None:
        space.meet_colors()
    arguments = (
        splats.means2d, splats.conics, splats.opacities, splats.colors, backgrounds, isect_rows, tile_offsets,
        *grid,
    )  # fmt: skip
    if space is None:
        *composited, zeros = torch.ops.blitzgs.rasterize_fwd(
            *arguments, None, False, backward_follows, n_rows
        )
        gradients = GradientRoom(zeros)
    elif backward_follows:
        zeros = space.table()
        composited = torch.ops.blitzgs.rasterize_fwd_packed_(*arguments, zeros, n_rows)
        gradients = GradientRoom(zeros, space.clear_table)
    else:
        *composited, _ = torch.ops.blitzgs.rasterize_fwd(*arguments, None, False, False, n_rows)
        gradients = GradientRoom(None, space.clear_table)
    mark("raster")
    known = projection.settle()
    if known is None:
        return None
    if n_rows is not None:
        splats = known.splats
    renders, transmittances, last_ids, tile_work, aux = composited
    return Frame(
        views,
        options,
        known.rows,
        splats,
        share,
        known.route,
        known.visible,
        backgrounds,
        isect_rows,
        tile_offsets,
        renders,
        transmittances,
        last_ids,
        tile_work,
        aux,
        gradients,
    )


def list_rows(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | None,
    share: Share | None,
    room: RowRoom,
    mark: Mark,
    waiting: ExitStack,
) -> tuple[Projection, Splats, Tensor, Tensor]:
    """Queue projection, exchange and the tiles' lists of what was brought here: isect_rows, tile_offsets."""
    projection = _project(table, views, options, active, share, room, waiting)
    splats = projection.splats
    mark("project")
    if share is not None and projection.route is not None:
        splats = send(splats, projection.route, share.ranks)
    mark("exchange")
    isect_rows, tile_offsets = torch.ops.blitzgs.intersect(
        splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, splats.ids,
        *tile_grid(views, options, share), projection.n_isects, projection.n_rows,
    )  # fmt: skip
    mark("sort")
    return projection, splats, isect_rows, tile_offsets


def tile_grid(views: Views, options: RenderOptions, share: Share | None) -> tuple[int, ...]:
    """Return the tiles that this rank composites, as the ops take them."""
    tiles = (0, -1) if share is None else share.composited
    return (len(views), views.width, views.height, options.tile_size, *tiles)


@lru_cache(maxsize=16)
def _backgrounds(colour: tuple[float, float, float], count: int, device: torch.device) -> Tensor | None:
    """Return a colour for each of `count` views, [B, 3]; None: black. Kept, as its way to a GPU is a wait."""
    return torch.tensor(colour, device=device).repeat(count, 1) if any(colour) else None


def backward_rows(frame: Frame, v_renders: Tensor, mark: Mark = unmarked) -> RowGradients:
    """Carry image gradients back to the projected rows.

    Args:
        frame: from `forward`.
        v_renders: gradient of the loss by the images, [B, H, W, 3]; this rank's tiles matter.
        mark: called at the end of each stage: "raster back", "exchange back".

    Raises:
        RuntimeError: the ranks share memory, and a later frame has taken the place of this one's rows.
    """
    views, options, splats, share = frame.views, frame.options, frame.splats, frame.share
    tiles = (0, -1) if share is None else share.tiles
    space = None if frame.route is None else frame.route.space
    arguments = (
        splats.means2d, splats.conics, splats.opacities, splats.colors, frame.backgrounds, frame.isect_rows,
        frame.tile_offsets, frame.renders, frame.transmittances, frame.last_ids, frame.aux, v_renders,
    )  # fmt: skip
    grid = (len(views), views.width, views.height, options.tile_size, *tiles)
    if v_renders.is_cuda:
        if space is not None:
            space.check_current()
        packed = frame.room.take(splats.means2d)
        torch.ops.blitzgs.rasterize_bwd_packed_(*arguments, *grid, options.deterministic, packed)
        columns: Sequence[Tensor] = gradient_columns(packed)
    else:
        *columns, _ = torch.ops.blitzgs.rasterize_bwd(*arguments, None, *grid, False, options.deterministic)
    mark("raster back")
    if space is not None:
        assert frame.route is not None and frame.route.places is not None
        tables = space.share_table(frame.route.places)
        mark("exchange back")
        return RowGradients(None, None, None, None, tables)
    if share is not None and frame.route is not None:
        columns = send_back(columns, frame.route, share.ranks)
    mark("exchange back")
    means2d, conics, opacities, colors = columns
    return RowGradients(means2d, conics, opacities, colors)


def backward(
    table: GaussianTable,
    frame: Frame,
    v_renders: Tensor,
    scale_reg: Tensor | None = None,
    mark: Mark = unmarked,
) -> tuple[Tensor, ...]:
    """Carry image gradients back to the parameters.

    Args:
        table: the table that was rendered, unchanged since.
        frame: from `forward`.
        v_renders: gradient of the loss by the images, [B, H, W, 3]; this rank's tiles matter.
        scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no such
            term.
        mark: called at the end of each stage: "raster back", "exchange back", "project back".

    Returns:
        Gradients of the U visible Gaussians: of means [U, 3], quats [U, 4], scales [U, 3], opacities [U], sh
        [U, K, 3].
    """
    views, options, rows = frame.views, frame.options, frame.rows
    v = backward_rows(frame, v_renders, mark)
    *parameters, _ = torch.ops.blitzgs.project_bwd(
        *table.parameters, views.viewmats, views.Ks, rows.camera_ids, rows.visible_ids, rows.row_offsets,
        views.width, views.height, options.sh_degree, options.eps2d, options.antialiased, True, v.means2d,
        v.conics, None, v.opacities, v.colors, scale_reg, False, *v.tables,
    )  # fmt: skip
    mark("project back")
    return tuple(parameters)


def _project(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    active: ActiveRows | None,
    share: Share | None,
    room: RowRoom,
    waiting: ExitStack,
) -> Projection:
    """Project a table and, on several ranks, agree on which row goes where."""
    # Halves are routed by what arrives: rounding may move a splat's border over that of a tile.
    asking = share if share is not None and not share.half else None
    wanted = [] if asking is None else [asking.ranges.composited(m) for m in range(asking.ranks.world_size)]
    ids, bits, length = active or (None, None, None)
    arguments = (
        *table.parameters, views.viewmats, views.Ks, ids, bits, views.width, views.height,
        options.tile_size, options.sh_degree, options.near_plane, options.far_plane, options.eps2d, 0.0,
        options.antialiased, True, [begin for begin, _ in wanted], [end for _, end in wanted], length,
    )  # fmt: skip
    return project_views(arguments, table["id"], len(views), share, room, waiting)
