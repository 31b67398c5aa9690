# SPDX-License-Identifier: Apache-2.0
"""Finds the rows that the views of a step may see, block by block, from conservative bounds of each block.

Also converts the cull mask between the layout by row, which moves with rows, and that of the kernels, copies
rows of columns, and moves blocks between a table on the host and a pool on the GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.projection_types import Views

BLOCK_ROWS = 256
# What bounds how far pending steps move rows: first and second moments of means, then of log scales, float32
# [N, 3]; `last_step` and `moment_step`, int32 [N], as `AdamState` has them; and `AdamSchedule.table`.
PendingSteps = Sequence[Tensor]


class GateRules(NamedTuple):
    """Which rows B views leave out before projection: LOD gate (BlitzGS Eq. 1 and 2) and cull mask (Eq. 3).

    A view with an LOD gate leaves out each row of octree level l that is farther than `reach[l]` from the
    camera centre. A view with a column of the cull matrix leaves out the rows whose bit in that column is
    set.
    """

    level: Tensor  # uint8 [N]; a level beyond the last of `reach` counts as the last
    # One distance for each of 1 to 32 levels, in the unit of the means: up to it the level is kept. Distances
    # must not increase towards finer levels; a negative one removes the level everywhere.
    reach: list[float]
    lod_views: int  # bit v is set when view v has an LOD gate
    cull: Tensor | None = None  # int32 [ceil(N / 256), columns, 8], of `blitzgs.ops.blocks`; None: none
    columns: list[int] = []  # noqa: RUF012  (never changed)  # columns of `cull`, one a view; negative: none


class ActiveRows(NamedTuple):
    """The rows that at least one view may see: the first `length` entries of lists with capacity R.

    `length` stays on the device, so the host need not wait for it; ops that take the lists take `length` too.
    """

    ids: Tensor  # int32 [R], ascending
    views: Tensor  # int32 [R], bit v set when view v may see the row
    length: Tensor  # int32 [1], number of valid entries, on the device of the lists
    # int32 [1] on the same device, number of blocks of which a view may see a part. If the lists had capacity
    # for fewer blocks, they are incomplete and `length` is 0. None: the lists are complete.
    blocks: Tensor | None = None

    def listed(self) -> tuple[Tensor, Tensor]:
        """Return the A valid entries of `ids` and `views`, int32 [A] each; waits for the device."""
        length = int(self.length)
        return self.ids[:length], self.views[:length]

    def considered(self) -> Tensor:
        """Return how many of the listed rows some view still considers, int64 []; does not wait."""
        listed = torch.arange(len(self.views), device=self.views.device) < self.length
        return ((self.views != 0) & listed).sum()


def morton_keys(points: Tensor) -> Tensor:
    """Return each point's position along the Morton curve of the cloud's bounding cube.

    `points`: float32 [N, 3]. Returns int64 [N]; 2^63 - 1 for a point that is not finite.
    """
    return torch.ops.blitzgs.morton_keys(points)


def update_block_bounds_(
    bounds: Tensor, ids: Tensor | None, means: Tensor, scales: Tensor, pending: PendingSteps | None = None
) -> None:
    """Recompute the bounds of the blocks that hold the rows `ids` (None: of all blocks), in place.

    Args:
        bounds: float32 [ceil(N / 256), 8]: lowest and highest corner of where the means can be, largest
            standard deviation, 1 when all rows are finite.
        ids: int32 [U], rows that changed.
        means: float32 [N, 3].
        scales: float32 [N, 3], logarithms of the standard deviations.
        pending: `PendingSteps`; None: there are none.
    """
    with below_autograd():
        torch.ops.blitzgs.update_block_bounds_(bounds, ids, _rows(means, scales, pending))


def cull_blocks(
    bounds: Tensor,
    means: Tensor,
    scales: Tensor,
    views: Views,
    limits: tuple[float, float, float],
    pending: PendingSteps | None = None,
    level_ranges: Tensor | None = None,
    rules: GateRules | None = None,
    capacity_blocks: int | None = None,
) -> ActiveRows:
    """Return the rows that at least one of the views (32 at most) may see; blocks outside all are not read.

    The set is conservative: it contains every row that projection would project, however many of its pending
    steps have been applied by then. A row is dropped from a view only if it certainly misses that view
    (csrc/active/blocks.h).

    Args:
        bounds: from `update_block_bounds_`, of the same rows.
        means: float32 [N, 3].
        scales: float32 [N, 3], logarithms of the standard deviations.
        limits: near plane, far plane (rows at z <= near or z > far are not seen), and eps2d, the blur on the
            screen, pixels squared.
        pending: as given to `update_block_bounds_`.
        level_ranges: uint8 [ceil(N / 256), 2], coarsest and finest level of each block; needed for `rules`.
        rules: also drop the rows that these rules leave out wherever their pending steps may move them;
            `gate_views_` decides about the remaining rows. None: no rules.
        capacity_blocks: capacity of the lists, in blocks of 256 rows, at least 1. None: exactly as many
            blocks as the views may see; the host then waits for this number.

    Raises:
        RuntimeError: as `gate_views_`.
    """
    cameras = (views.viewmats, views.Ks, views.width, views.height)
    gate = () if rules is None else (level_ranges, *rules)
    rows = _rows(means, scales, pending)
    found = torch.ops.blitzgs.cull_blocks(
        bounds, rows, *cameras, *limits, *gate, capacity_blocks=capacity_blocks
    )
    return ActiveRows(*found)


def gate_views_(active: ActiveRows, means: Tensor, viewmats: Tensor, rules: GateRules) -> None:
    """Clear the bits of `active.views` for the (row, view) pairs that B views leave out; no row is removed.

    Args:
        active: rows of the table; their views are changed in place.
        means: float32 [N, 3], of which the listed rows are caught up.
        viewmats: float32 [B, 4, 4], rigid, world to camera, B <= 32.
        rules: which rows each view leaves out.

    Raises:
        RuntimeError: no level, finer levels that reach farther, or a column that the cull matrix lacks.
    """
    level, reach, lod_views, cull, columns = rules
    with below_autograd():
        torch.ops.blitzgs.gate_views_(
            active.ids, active.views, active.length, means, level, viewmats, reach, lod_views, cull, columns
        )


def _rows(means: Tensor, scales: Tensor, pending: PendingSteps | None) -> list[Tensor]:
    """Return the group `rows` of the ops (`hold_rows` of csrc/active/active_op.cpp)."""
    return [means, scales, *(pending or ())]


# Bits of a word of a mask. In the layout by row, each bit is of one column.
WORD_BITS = 32
SECTOR_WORDS = BLOCK_ROWS // WORD_BITS


@torch.no_grad()
def sectors_of_rows(rows: Tensor) -> Tensor:
    """Convert a mask from the layout by row to the layout by block and column (a column is a view).

    Args:
        rows: int32 [N, words]; bit v % 32 of word v / 32 is that of column v.

    Returns:
        int32 [ceil(N / 256), 32 words, 8]: for each block of 256 rows and column the 32 bytes of the rows'
        bits; bit r % 32 of word r / 32 is that of the block's row r. Rows beyond N have zeros.
    """
    return torch.ops.blitzgs.sectors_of_rows(rows)


@torch.no_grad()
def rows_of_sectors(sectors: Tensor, n: int) -> Tensor:
    """Convert a mask of N rows back to the layout by row, int32 [N, words]: undo `sectors_of_rows`."""
    return torch.ops.blitzgs.rows_of_sectors(sectors, n)


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

    `bounds`: from `update_block_bounds_`. `viewmats`, `Ks`: float32 [V, 4, 4] and [V, 3, 3]. `sizes`: int32
    [V, 2], width and height of each of the V views, pixels. The others are the limits of `cull_blocks`.
    Returns int32 [blocks], bit v set when view v may see a part of the block.
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


def take_rows(
    columns: Sequence[Tensor], rows: Tensor, out: Sequence[Tensor] | None = None
) -> Sequence[Tensor]:
    """Return the rows `rows` of each column, as `column.index_select(0, rows)` does.

    For rows whose size is a multiple of 16 bytes, torch's op is slower, because it uses a whole block of
    threads for each.

    Args:
        columns: [N, ...], any dtypes.
        rows: int64 [M], from 0 to N - 1; not checked.
        out: [M, ...], contiguous, get the rows; they may not overlap the columns. None: new tensors.

    Returns:
        [M, ...] of each column.
    """
    if out is None:
        out = [column.new_empty((len(rows), *column.shape[1:])) for column in columns]
    torch.ops.blitzgs.take_rows_(out, columns, rows)
    return out


def put_rows_(columns: Sequence[Tensor], rows: Tensor, fresh: Sequence[Tensor] = ()) -> None:
    """Overwrite rows of columns, in place.

    `columns`: [N, ...], any dtypes, contiguous. `rows`: int64 [M], from 0 to N - 1, each at most once; not
    checked. `fresh`: what the rows become, [M, ...], of the dtype and row shape of each column; none: zeros.
    """
    torch.ops.blitzgs.put_rows_(columns, rows, fresh)
