# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.frame.run import run
from blitzgs.frame.transport.local import LocalExchange, LocalTransport
from blitzgs.frame.transport.protocol import Exchange
from blitzgs.ops.color_rows import VisibleRows, colored_rows
from blitzgs.ops.project_gradient import TableRows
from blitzgs.ops.projection_types import (
    VIEW_TOTALS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOutputs,
    first_rows,
)
from blitzgs.ops.sparse_rows import HandOver


class Rendered(NamedTuple):
    """The outputs of the ops; see each op for its fields.

    Attributes:
        splats: the splats; their `counts` is None.
        isect_splats: the tiles' lists.
        tile_offsets: where they begin.
        composited: what `rasterize_fwd` returned, and alphas.
        rows: the visible rows, if the SH are in tables of which only these are read.
        has_blank_view: whether some view sees no Gaussian.
    """

    splats: ProjectedSplats
    isect_splats: Tensor
    tile_offsets: Tensor
    composited: Sequence[Tensor]
    rows: TableRows | None
    has_blank_view: bool


class ShTables(NamedTuple):
    """SH of which only the rows of visible Gaussians are read.

    Attributes:
        parts: the SH of all Gaussians in parts, [N, L, 3] each; empty: no SH are rendered.
        before: called before rows are read, with the rows, int32 [A], and the number of those that are
            valid, int32 [1] on the device, or None if all are.
        hand_over: takes the gradients of all tables, if autograd is not to have them.
    """

    parts: Sequence[Tensor]
    before: Callable[[Tensor, Tensor | None], object]
    hand_over: HandOver | None


def render_queued(
    inputs: ProjectionInputs,
    channels: Callable[[ProjectedSplats], Tensor],
    backgrounds: Tensor | None,
    backward_follows: bool,
    exact: bool,
    tables: ShTables | None = None,
) -> Rendered:
    """Render without gradients; the differentiable ops take this result instead of computing it again.

    If earlier calls had the same size, the host queues all work first and reads the number of splats while
    the GPU works.

    Args:
        inputs: inputs of `project_splats`.
        channels: returns the values to composite, [P, D], from P splats. P may exceed the number of valid
            splats, and `counts` of these splats is None.
        backgrounds: [B, D] or None.
        backward_follows: see the op `rasterize_fwd`.
        exact: wait for the number of splats, so that no column has spare capacity meanwhile.
        tables: the SH, if they are not part of `inputs`.
    """
    options, means = inputs.options, inputs.gaussians[0]
    grid = [inputs.n_views, options.width, options.height, options.tile_size, 0, -1]
    transport = LocalTransport() if exact else _transport(means.device, means.shape[0], inputs.n_views)

    def composite(exchange: Exchange) -> tuple[LocalExchange, Tensor, list[Tensor], VisibleRows | None]:
        assert isinstance(exchange, LocalExchange)
        _, n_splats, n_isects = exchange.arrived
        splats, rows = exchange.projected.splats, None
        if tables is not None:
            splats, rows = _colored(exchange.projected, inputs, tables, spare=n_splats is not None)
        isect_splats, *composited = torch.ops.blitzgs.list_and_rasterize(
            [splats.means2d, splats.conics, splats.opacities, channels(splats)], splats.depths,
            splats.camera_ids, backgrounds, grid, n_isects, backward_follows, n_splats,
        )  # fmt: skip
        return exchange, splats.colors, [isect_splats, *composited], rows

    result, (exchange, colors, composited, rows) = run(transport, lambda _: inputs, None, composite)
    splats = result.projected
    isect_splats, tile_offsets, *images = composited
    totals = exchange.totals()
    own: list[Tensor] = [] if rows is None else [*rows.inputs.gaussians, rows.numbers, rows.indices]
    columns = [isect_splats, colors, *own]
    visible, count, isects, *_ = totals
    if isect_splats.shape[0] > isects or colors.shape[0] > count:
        # Cut spare capacity off, in one operation.
        columns = first_rows(columns, [isects, count, *[visible] * len(own)])
    isect_splats, colors, *own = columns
    of_tables = None
    if tables is not None and rows is not None:
        *gaussians, numbers, indices = own
        rows = VisibleRows(rows.inputs._replace(gaussians=gaussians), numbers, indices)
        of_tables = TableRows(rows, tables.parts, tables.hand_over)
    has_blank_view = 0 in totals[VIEW_TOTALS:]
    splats = splats._replace(colors=colors)
    return Rendered(splats, isect_splats, tile_offsets, images, of_tables, has_blank_view)


@lru_cache(maxsize=16)
def _transport(_device: torch.device, _gaussians: int, _views: int) -> LocalTransport:
    """Return the transport, with its estimate of sizes, of all calls of this size."""
    return LocalTransport()


def _colored(
    projected: ProjectionOutputs, inputs: ProjectionInputs, tables: ShTables, spare: bool
) -> tuple[ProjectedSplats, VisibleRows]:
    """Colour splats from the tables' rows; spare: whether the splats may have spare capacity."""
    splats, totals = projected.splats, projected.totals if spare else None
    # The low half of the first total, the number of visible Gaussians.
    count = None if totals is None else totals.view(torch.int32)[:1]
    tables.before(splats.visible_ids, count)
    return colored_rows(splats, inputs, tables.parts, totals)
