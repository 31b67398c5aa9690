# SPDX-License-Identifier: Apache-2.0
"""Projection, intersection and compositing of one call, queued together without waiting in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.host import tell_host
from blitzgs.ops.project import RowRoom, Rows, Sizes, color_rows, holds, queue_rows, room_for, rows_of


class Rendered(NamedTuple):
    """What the ops returned; attributes are theirs."""

    rows: Rows
    isect_rows: Tensor
    tile_offsets: Tensor
    composited: tuple[Tensor, ...]


def render_queued(
    arguments: tuple[Any, ...],
    channels: Callable[[Rows], Tensor],
    backgrounds: Tensor | None,
    backward_follows: bool,
    sizes: Sizes | None = None,
) -> Rendered | None:
    """Render without gradients, for ops that are then given the result to differentiate it.

    The host learns how many rows there are when all is queued, while the GPU works.

    Args:
        arguments: of `project_rows`.
        channels: what is composited of the rows, [P, D], whatever their number P; their counts are None.
        backgrounds: [B, D] or None.
        backward_follows: see the op `rasterize_fwd`.
        sizes: how much room to make; None: what calls of this size needed before.

    Returns:
        None where no call before told how much room is needed, or it was too little.
    """
    room = room_for(*arguments) if sizes is None else RowRoom()
    sizes = room.sizes if sizes is None else sizes
    if not all(sizes[:2]):
        return None
    viewmats, (width, height, tile_size) = arguments[5], arguments[9:12]
    grid = (len(viewmats), width, height, tile_size, 0, -1)
    with torch.no_grad(), torch._C._AutoDispatchBelowAutograd():
        queued = (*arguments, [], [], None)
        _, totals, columns = queue_rows(queued, sizes)
        with tell_host(totals) as told:
            color_rows(queued, totals, columns)
            rows = Rows._make((*columns[:12], None))
            splats, n_rows = (rows.means2d, rows.conics, rows.opacities), totals[1:2]
            isect_rows, tile_offsets = torch.ops.blitzgs.intersect(
                *splats, rows.depths, rows.camera_ids, None, *grid, sizes[2], n_rows
            )
            composited = torch.ops.blitzgs.rasterize_fwd(
                *splats, channels(rows), backgrounds, isect_rows, tile_offsets, *grid, None, True,
                backward_follows, n_rows,
            )  # fmt: skip
            counts = told()[:3]
    needed = counts.tolist()
    room.learn(needed)
    if not holds(sizes, needed):
        return None
    return Rendered(rows_of(columns, counts), isect_rows[: needed[2]], tile_offsets, composited)
