# SPDX-License-Identifier: Apache-2.0
"""Work follows the active set: the rows of a table that a batch of views may see."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.blocks import (
    BLOCK_ROWS,
    ActiveRows,
    GateRules,
    PendingSteps,
    cull_blocks,
    morton_keys,
    update_block_bounds_,
)


def morton_order(means: Tensor) -> Tensor:
    """Return the permutation (int64 [N]) that puts neighbours in space next to each other.

    Rows on the same spot of the curve keep their order; rows that are not finite come last.

    Args:
        means: float32 [N, 3].
    """
    return torch.sort(morton_keys(means), stable=True).indices


class BlockIndex:
    """Bounds of blocks of 256 consecutive rows of one table, kept up to date while an optimiser moves them.

    Build a new index whenever rows were added, removed or reordered; sort the table by `morton_order` first,
    or blocks are large and save no work (the active set is right in any order).
    """

    def __init__(self, table: GaussianTable, schedule: Tensor | None = None) -> None:
        """Bound every block of the table.

        Args:
            table: the rows.
            schedule: of the lazy optimiser, from `blitzgs.ops.lazy_adam.schedule_table`, when steps may be
                pending; None: rows do not move by themselves.
        """
        self._schedule = schedule
        count = -(-len(table) // BLOCK_ROWS)
        self._bounds = torch.empty(count, 8, dtype=torch.float32, device=table.device)
        self._level_ranges = _level_ranges(table["level"], count)
        self.update(table, None)

    @classmethod
    def of_bounds(cls, bounds: Tensor, level_ranges: Tensor, schedule: Tensor | None) -> BlockIndex:
        """Return an index of blocks whose `bounds` and `level_ranges` are known."""
        index = cls.__new__(cls)
        index._schedule, index._bounds, index._level_ranges = schedule, bounds, level_ranges
        return index

    @property
    def bounds(self) -> Tensor:
        """What holds all places and sizes of each block's rows, float32 [blocks, 8]; see `cull_blocks`."""
        return self._bounds

    @property
    def level_ranges(self) -> Tensor:
        """The coarsest and the finest level of each block, uint8 [blocks, 2]."""
        return self._level_ranges

    def active(
        self,
        table: GaussianTable,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        near_plane: float,
        far_plane: float,
        eps2d: float = 0.3,
        rules: GateRules | None = None,
        room: int | None = None,
    ) -> ActiveRows:
        """Return the rows that the views may see, and the views of each.

        The result depends on each row's own state alone, neither on the order of the rows nor on how they are
        divided among ranks. Arguments as in `blitzgs.ops.blocks.cull_blocks`.
        """
        pending = self._pending(table)
        return cull_blocks(
            self._bounds, table["means"], table["scales"], viewmats, Ks, width, height, near_plane, far_plane,
            eps2d, pending, self._level_ranges, rules, room,
        )  # fmt: skip

    def update(self, table: GaussianTable, ids: Tensor | None) -> None:
        """Take note that the optimiser stepped the rows `ids` (int32 [U]; None: any row may have changed).

        Catching up needs no update, because the bounds contain the whole drift of rows that are behind.
        """
        update_block_bounds_(self._bounds, ids, table["means"], table["scales"], self._pending(table))

    def _pending(self, table: GaussianTable) -> PendingSteps | None:
        if self._schedule is None:
            return None
        return PendingSteps(
            table["exp_avg.means"],
            table["exp_avg_sq.means"],
            table["exp_avg.scales"],
            table["exp_avg_sq.scales"],
            table["last_step"],
            table["moment_step"],
            self._schedule,
        )


def _level_ranges(level: Tensor, blocks: int) -> Tensor:
    """Return the coarsest and the finest level of each block, uint8 [blocks, 2]."""
    rest = level[-1:].expand(blocks * BLOCK_ROWS - len(level)) if blocks else level
    of_block = torch.cat((level, rest)).view(-1, BLOCK_ROWS)
    return torch.stack((of_block.amin(dim=1), of_block.amax(dim=1)), dim=1)
