# SPDX-License-Identifier: Apache-2.0
"""Finds the blocks of a host table that views may see, and moves them to and from a pool on the GPU."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def seen_blocks(
    bounds: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    sizes: Tensor,
    near_plane: float,
    far_plane: float,
    eps2d: float = 0.3,
) -> Tensor:
    """Return the views that may see a part of each block.

    A block without the bit of a view has no row that `blitzgs.ops.blocks.cull_blocks` lists for that view.

    Args:
        bounds: float32 [N, 8], from `blitzgs.ops.blocks.update_block_bounds_`.
        viewmats: float32 [V, 4, 4], world to camera, V <= 32.
        Ks: float32 [V, 3, 3], pixels.
        sizes: int32 [V, 2], width and height of each view, pixels.
        near_plane: rows at z <= near_plane are not seen.
        far_plane: rows at z > far_plane are not seen.
        eps2d: screen-space blur, pixels squared.

    Returns:
        int32 [N], bit v set when view v may see a part of the block.

    Raises:
        RuntimeError: wrong shapes or dtypes, or more than 32 views.
    """
    return torch.ops.blitzgs.seen_blocks(bounds, viewmats, Ks, sizes, near_plane, far_plane, eps2d)


@torch.no_grad()
def swap_blocks_(
    pool: Sequence[Tensor],
    table: Sequence[Tensor],
    n_written: int,
    slots: Tensor,
    leaving: Tensor,
    coming: Tensor,
) -> None:
    """Move blocks of 256 rows between slots of a pool and a table in the memory of the host, in place.

    The contents of slot `slots[i]` are written to block `leaving[i]` of the table, and block `coming[i]` is
    read into the slot. One kernel does both at once, so that on CUDA it uses both directions of the bus. All
    slots must differ, and so must all leaving and coming blocks together; none of this is checked.

    Args:
        pool: columns [P, ...].
        table: the same columns [N, ...] in the memory of the host; pinned where the pool is on a GPU.
        n_written: only the first `n_written` columns are written back; the others never change on the device.
        slots: int32 [M], on the device of the pool.
        leaving: int32 [M], on the same device; -1: the slot's contents are discarded.
        coming: int32 [M], on the same device; -1: nothing is read into the slot.

    Raises:
        RuntimeError: columns that differ in dtype or in the shape of a row, are not contiguous or too many,
            or a table that is not in (pinned) memory of the host.
    """
    torch.ops.blitzgs.swap_blocks_(list(pool), list(table), n_written, slots, leaving, coming)
