# SPDX-License-Identifier: Apache-2.0
"""The survey of views: what each Gaussian contributes to them, on any number of ranks, without a colour."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.exchange import send_back_sums
from blitzgs.distributed.ownership import Share
from blitzgs.model import GaussianTable
from blitzgs.ops.project import RowRoom, Rows
from blitzgs.pipeline import RenderOptions, Views, list_rows, tile_grid, unmarked


class Survey(NamedTuple):
    """What this rank's P rows contribute to their views.

    Attributes:
        rows: the projected Gaussians.
        weights: int64 [P], sum of alpha T over the pixels in units of 2^-32.
        pixels: int32 [P], the pixels at which a row is composited.
    """

    rows: Rows
    weights: Tensor
    pixels: Tensor


def survey(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    share: Share | None = None,
    room: RowRoom | None = None,
) -> Survey:
    """Find what each Gaussian contributes to views of a table whose rows are up to date; no colour is shaded.

    Args:
        table: the Gaussians.
        views: at most 32 views.
        options: how to render; of the colours, those of degree 0 are worked out and not used.
        share: who composites which tiles; every rank of the job calls this with its table. None: this rank
            alone. Not in half precision: what is surveyed is the image.
        room: as for `forward`.

    Returns:
        The rows of this rank's Gaussians with the sums over all tiles, wherever they were composited: the
        same bits at any number of ranks.
    """
    room = room or RowRoom()
    options = replace(options, sh_degree=0)
    share = None if share is None else replace(share, half=False)
    with torch._C._AutoDispatchBelowAutograd():
        while True:
            with ExitStack() as waiting:
                found = _survey(table, views, options, share, room, waiting)
            if found is not None:
                return found


def _survey(
    table: GaussianTable,
    views: Views,
    options: RenderOptions,
    share: Share | None,
    room: RowRoom,
    waiting: ExitStack,
) -> Survey | None:
    """Queue all of it, then wait for the numbers of rows; None: the room was too small, and has learnt."""
    projection, splats, isect_rows, tile_offsets = list_rows(
        table, views, options, None, share, room, unmarked, waiting
    )
    if projection.space is not None:
        # Nobody reads the colours, but the next exchange must not find their stream at work.
        projection.space.meet_colors()
    sums: tuple[Tensor, Tensor] = torch.ops.blitzgs.contributions(
        splats.means2d, splats.conics, splats.opacities, isect_rows, tile_offsets,
        *tile_grid(views, options, share), projection.n_rows,
    )  # fmt: skip
    known = projection.settle()
    if known is None:
        return None
    weights, pixels = sums
    if projection.n_rows is not None:
        weights, pixels = (column[: len(known.splats.depths)] for column in sums)
    if share is not None and known.route is not None:
        returned = send_back_sums(torch.stack((weights, pixels.long()), 1), known.route, share.ranks)
        weights, pixels = returned[:, 0], returned[:, 1].int()
    return Survey(known.rows, weights, pixels)
