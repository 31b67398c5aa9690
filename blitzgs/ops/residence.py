# SPDX-License-Identifier: Apache-2.0
"""Blocks of a table in the memory of the host: which some views may see, and their way to a pool and back."""

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

    Slot `slots[i]` gives what it holds to block `leaving[i]` of the table and takes block `coming[i]`. Both
    happen at once, so that on CUDA both directions of the bus are in use. All slots, leaving and coming
    blocks differ, and no block leaves and comes; none of this is checked.

    Args:
        pool: columns [P, ...].
        table: the same columns [N, ...] in the memory of the host; pinned where the pool is on a GPU.
        n_written: how many columns, from the first, are written back; the others never change.
        slots: int32 [M], on the device of the pool.
        leaving: int32 [M], likewise; -1: what the slot holds is dropped.
        coming: int32 [M], likewise; -1: the slot keeps what it holds.

    Raises:
        RuntimeError: columns that differ in dtype or in the shape of a row, are not contiguous or too many,
            or a table that is not in (pinned) memory of the host.
    """
    torch.ops.blitzgs.swap_blocks_(list(pool), list(table), n_written, slots, leaving, coming)


@torch.library.register_fake("blitzgs::seen_blocks")
def _(bounds: Tensor, *_args: object) -> Tensor:
    return bounds.new_empty(len(bounds), dtype=torch.int32)


@torch.library.register_fake("blitzgs::swap_blocks_")
def _(*_args: object) -> None:
    return None
