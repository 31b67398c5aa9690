# SPDX-License-Identifier: Apache-2.0
"""The active set: the rows of a table that a batch of views may see, found from the bounds of blocks."""

from __future__ import annotations

from functools import cached_property
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.ops.blocks import (
    BLOCK_ROWS,
    WORD_BITS,
    ActiveRows,
    GateRules,
    PendingSteps,
    cull_blocks,
    morton_keys,
    seen_blocks,
    update_block_bounds_,
)
from blitzgs.ops.projection_types import MAX_VIEWS, Views
from blitzgs.table.table import GaussianTable

# The columns of `PendingSteps`.
_PENDING_OF = itemgetter(
    "exp_avg.means", "exp_avg_sq.means", "exp_avg.scales", "exp_avg_sq.scales", "last_step", "moment_step"
)

# `morton_order` takes the span of a cloud between the quantiles `_SHARE` and 1 - `_SHARE` of up to `_SAMPLE`
# rows, and its grid reaches `_REACH` spans beyond them. So the span has at least 2^21 / 65 cells a side.
_SAMPLE, _SHARE, _REACH = 1 << 16, 0.05, 32.0


@torch.no_grad()
def morton_order(means: Tensor) -> Tensor:
    """Return the permutation (int64 [N]) that puts neighbours in space next to each other.

    Rows with the same Morton key keep their order; rows that are not finite come last. Rows far outside the
    cloud count as if they lay at its border, so that they do not coarsen the grid of all others. The result
    is the same on all devices.

    Args:
        means: [N, 3], float32; other dtypes are rounded to it.

    Raises:
        TypeError: `means` is not a tensor.
        ValueError: it has a wrong shape.
    """
    if not isinstance(means, Tensor):
        raise TypeError(f"means must be a torch.Tensor, got {type(means).__name__}")
    if means.dim() != 2 or means.shape[1] != 3:
        raise ValueError(f"means must be [N, 3], got {list(means.shape)}")
    return torch.sort(morton_keys(_without_far(means.float())), stable=True).indices


def sort_rows(table: GaussianTable) -> None:
    """Sort a table in Morton order, so that blocks of rows are small in space."""
    table.permute(morton_order(table["means"]))


def _without_far(points: Tensor) -> Tensor:
    """Return points [N, 3] whose finite coordinates lie at most `_REACH` spans outside the quantiles.

    The span is the largest distance of the quantiles on an axis. If it is 0 or unknown, no point moves.
    """
    if len(points) == 0:
        return points
    sample = points[:: -(-len(points) // _SAMPLE)]
    # The finite values of each axis in order, then infinite ones. The same on all devices.
    ordered = sample.where(sample.isfinite(), torch.inf).sort(dim=0).values
    last = (sample.isfinite().sum(dim=0) - 1).clamp(min=0).double()
    low, high = ordered.gather(0, torch.stack((_SHARE * last, (1 - _SHARE) * last)).round().long())
    reach = _REACH * (high - low).amax()
    known = reach > 0
    low, high = (low - reach).where(known, -torch.inf), (high + reach).where(known, torch.inf)
    return points.where(~points.isfinite(), points.clamp(low, high))


class BlockIndex:
    """Bounds of blocks of 256 consecutive rows of one table, updated as an optimiser moves rows.

    Build a new one whenever rows were added, removed or reordered. The active set is right in any order, but
    without `morton_order` blocks are large and none is skipped.
    """

    def __init__(self, table: GaussianTable, pending_table: Tensor | None = None) -> None:
        """Compute all bounds; `pending_table` is `AdamSchedule.table`, if rows may have pending steps."""
        self._pending_table = pending_table
        count = -(-len(table) // BLOCK_ROWS)
        # The bounds of each block, float32 [blocks, 8]; see `update_block_bounds_` for their layout.
        self.bounds = torch.empty(count, 8, dtype=torch.float32, device=table.device)
        # The coarsest and the finest level of each block, uint8 [blocks, 2].
        level = table["level"]
        rest = level[-1:].expand(count * BLOCK_ROWS - len(level)) if count else level
        of_block = torch.cat((level, rest)).view(-1, BLOCK_ROWS)
        self.level_ranges = torch.stack((of_block.amin(dim=1), of_block.amax(dim=1)), dim=1)
        self.update(table, None)

    @classmethod
    def of_bounds(cls, bounds: Tensor, level_ranges: Tensor, pending_table: Tensor | None) -> BlockIndex:
        """Make an index from `bounds` and `level_ranges` that are known already."""
        index = cls.__new__(cls)
        index.bounds, index.level_ranges, index._pending_table = bounds, level_ranges, pending_table
        return index

    def active(
        self,
        table: GaussianTable,
        views: Views,
        limits: tuple[float, float, float],
        rules: GateRules | None = None,
        capacity_blocks: int | None = None,
    ) -> ActiveRows:
        """Return the rows that the views may see, and for each row the views that may see it.

        Whether a row is in the result depends on that row alone, not on the order of the rows or on their
        division among ranks. Arguments as in `blitzgs.ops.blocks.cull_blocks`.
        """
        rows = (self.bounds, table["means"], table["scales"])
        pending = self._pending(table)
        return cull_blocks(*rows, views, limits, pending, self.level_ranges, rules, capacity_blocks)

    def update(self, table: GaussianTable, ids: Tensor | None) -> None:
        """Recompute the bounds after an optimiser step of the rows `ids` (int32 [U]; None: of any rows).

        No update is needed after `catch_up`, because the bounds contain all movement by pending steps.
        """
        update_block_bounds_(self.bounds, ids, table["means"], table["scales"], self._pending(table))

    def _pending(self, table: GaussianTable) -> PendingSteps | None:
        if self._pending_table is None:
            return None
        return (*_PENDING_OF(table.columns), self._pending_table)


def spread(bounds: Tensor, limit: float) -> Tensor:
    """Return how large blocks are together, float64 []: the sum of the mean widths of their boxes.

    The number of boxes that a plane cuts is proportional to this, if the plane lies anywhere with the same
    probability (Crofton's formula). A step reads the rows of the blocks that the border of a view cuts.

    `bounds`: float32 [blocks, 8], as `BlockIndex.bounds`. `limit`: a larger width counts as this one: single
    far rows have no more weight.
    """
    widths = (bounds[:, 3:6].double() - bounds[:, :3]).clamp(min=0).sum(dim=1) / 2
    return widths.clamp(max=limit).sum()


_MAX_WORDS = 1 << 26  # words of a mask that are processed together
UNSEEN = MAX_VIEWS  # above the numbers of all batches


class Cameras(NamedTuple):
    """Views of any sizes, on the device, and the limits they share."""

    viewmats: Tensor  # float32 [V, 4, 4], world to camera
    Ks: Tensor  # float32 [V, 3, 3], pixels
    sizes: Tensor  # int32 [V, 2], width and height, pixels
    limits: tuple[float, float, float]  # near plane, far plane and eps2d, as in `cull_blocks`
    columns: Tensor | None = None  # their columns in the cull matrix, int64 [V]; None: no mask


class BlockVisibility:
    """Tests which blocks the views of several batches may see; the host gets the result meanwhile."""

    def __init__(
        self, bounds: Tensor, cameras: Cameras, batch_size: int, culled: Tensor | None = None
    ) -> None:
        """Queue the test.

        `bounds`: of N blocks, float32 [N, 8]. `cameras`: views of consecutive batches, at most 32.
        `batch_size`: views per batch. `culled`: `culled_blocks` of the same blocks; None: there is no mask.
        """
        self._batch_size = batch_size
        self.batches = len(cameras.viewmats) // batch_size
        seen = seen_blocks(bounds, cameras.viewmats, cameras.Ks, cameras.sizes, *cameras.limits)
        if culled is not None and cameras.columns is not None:
            seen &= ~_culling_views(culled, cameras.columns)
        self._event: torch.cuda.Event | None = None
        if seen.is_cuda:
            host = torch.empty(seen.shape, dtype=seen.dtype, pin_memory=True)
            host.copy_(seen, non_blocking=True)
            self._event = torch.cuda.current_stream(seen.device).record_event()
            seen = host
        self._seen = seen

    def _read(self) -> npt.NDArray[np.uint32]:
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._seen.numpy().view(np.uint32)

    def blocks_of_batch(self, batch: int) -> npt.NDArray[np.bool_]:
        """Return which blocks a batch (0 is the first) may see, bool [N]; waits for the device."""
        bits = ((1 << self._batch_size) - 1) << batch * self._batch_size
        found: npt.NDArray[np.bool_] = (self._read() & np.uint32(bits & 0xFFFFFFFF)) != 0
        return found

    @cached_property
    def next_use(self) -> npt.NDArray[np.uint8]:
        """The first batch that may see each block, [N]; `UNSEEN` if none may. Waits for the device."""
        seen = self._read()
        # The exponent of the lowest set bit as a float32 is the number of the first view; 0 without a bit.
        exponents = (seen & (~seen + np.uint32(1))).astype(np.float32).view(np.int32) >> 23
        batch_of = np.full(127 + MAX_VIEWS, UNSEEN, dtype=np.uint8)
        batch_of[127:] = np.arange(MAX_VIEWS) // self._batch_size
        found: npt.NDArray[np.uint8] = batch_of[exponents]
        return found


def culled_blocks(cull: Tensor) -> Tensor:
    """Return, as bits, the views that leave out all rows of each block, int32 [N, columns / 32].

    `cull`: int32 [N, columns, 8], see `blitzgs.ops.blocks`; of whole blocks.
    """
    bits = torch.arange(WORD_BITS, device=cull.device)
    length = max(1, _MAX_WORDS // max(1, cull[:1].numel()))
    parts = [cull.new_empty(0, cull.shape[1] // WORD_BITS)]
    for some in cull.split(length):
        is_culled = (some == -1).all(2).view(len(some), cull.shape[1] // WORD_BITS, WORD_BITS)
        parts.append((is_culled.long() << bits).sum(2).int())
    return torch.cat(parts)


def _culling_views(culled: Tensor, columns: Tensor) -> Tensor:
    """Return for each block the bits of the views (of columns [V]) that leave out all its rows, int32 [N]."""
    # In place and in 32 bits, because these are as many numbers as the table has blocks, for each view.
    found = culled[:, columns // WORD_BITS]
    found >>= (columns % WORD_BITS).int()
    found &= 1
    found <<= torch.arange(len(columns), dtype=torch.int32, device=columns.device)
    return found.sum(1, dtype=torch.int32)
