# SPDX-License-Identifier: Apache-2.0
"""The survey of views: what each Gaussian contributes to each view, on any number of ranks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.frame.render import RenderOptions, inputs_of, run_attempts, tile_grid, tile_lists
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport import Exchange, Transport, open_transport
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.projection_types import ProjectedSplats, Sizes, Views
from blitzgs.table.table import GaussianTable


class Survey(NamedTuple):
    """The contributions of this rank's P splats to their views."""

    splats: ProjectedSplats  # the projected Gaussians
    weights: Tensor  # int64 [P], sum of alpha T over the pixels in units of 2^-32
    pixels: Tensor  # int32 [P], the number of pixels at which a splat is composited
    # int64 [P], sum of (alpha T)^2 over these pixels in the same units, if asked for.
    squares: Tensor | None = None


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
    grid = tile_grid(views, options, assignment)

    def attempt(capacity: Sizes | None) -> tuple[Exchange, tuple[Tensor, Tensor, Tensor]]:
        exchange = transport.project_and_send(inputs, assignment, capacity)
        splats, n_splats, _ = exchange.arrived
        lists = tile_lists(exchange.arrived, grid)
        geometry = (splats.means2d, splats.conics, splats.opacities)
        return exchange, torch.ops.blitzgs.contributions(*geometry, *lists, *grid, n_splats, squares)

    result, sums = run_attempts(transport, attempt)
    columns = [column[: len(result.splats.depths)] for column in (sums if squares else sums[:2])]
    if result.way_back is not None:
        returned = result.way_back.return_sums(torch.stack([column.long() for column in columns], 1))
        weights, pixels, *rest = (column.contiguous() for column in returned.unbind(1))
        columns = [weights, pixels.int(), *rest]
    return Survey(result.projected, *columns)
