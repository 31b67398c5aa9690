# SPDX-License-Identifier: Apache-2.0
"""Training beyond the memory of a GPU: keeps the blocks that views need in a pool on the device.

A `Pool` is a smaller table with the columns of the host's, whose slots hold blocks of 256 rows for a while
(docs/design.md). The bounds of a block change only when a step moves its rows, and the blocks of the
present step keep their slots until it has ended, so what `seen_blocks` finds before a step is still right
after it. If the blocks of this step and the next do not fit together, the next one loads the rest when it
begins; blocks of later steps come early where that evens out the traffic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.ops.blocks import BLOCK_ROWS, swap_blocks_
from blitzgs.ops.host import to_device
from blitzgs.table.blocks import UNSEEN, BlockIndex, BlockVisibility, Cameras, culled_blocks
from blitzgs.table.host_table import HostTable, fits
from blitzgs.table.table import (
    CULL,
    EXP_AVG_SQS,
    EXP_AVGS,
    PARAMETERS,
    GaussianTable,
    sectors_in,
    stored_rows,
)
from blitzgs.util.errors import UserError, amount

# Columns that steps change and that are therefore written back to the host.
_WRITTEN = (
    *PARAMETERS, *EXP_AVGS, *EXP_AVG_SQS, "last_step", "moment_step", "grad_sum", "grad_count", "max_radii",
)  # fmt: skip
_SETTING = "memory.resident_gb (eval, render: --resident-gb)"
_FREE = -1


class PoolError(UserError):
    """The blocks that views see do not fit into the pool; the message names the sizes and a remedy."""


class Moved(NamedTuple):
    """Counts of what moved between host and device."""

    steps: int = 0  # training steps
    needed: int = 0  # blocks that the views of these steps see
    loaded: int = 0  # blocks that were copied to the device because views see them
    bytes_in: int = 0  # bytes copied to the device, for any reason
    bytes_out: int = 0  # bytes written back to the host

    def since(self, earlier: Moved) -> Moved:
        """Return the difference from an earlier count."""
        return Moved(*(now - then for now, then in zip(self, earlier, strict=True)))

    def values(self) -> dict[str, float]:
        """Return, for the log, the share of needed blocks that were on the device, and megabytes per step."""
        return {
            "resident_hits": max(0.0, 1.0 - self.loaded / max(1, self.needed)),
            "moved_mb_per_step": (self.bytes_in + self.bytes_out) / 1e6 / max(1, self.steps),
        }


class Pool:
    """A pool on the device for blocks of a table in host memory.

    Between `load_for_step` and `write_back` the table on the host is out of date; `write_back` copies all
    changes to it and empties the pool.
    """

    table: HostTable  # on the host
    held: GaussianTable  # on the device; rows outside the blocks of `load_for_step`'s index are undefined
    moved: Moved  # counts since the beginning

    def __init__(
        self, table: HostTable, device: torch.device, budget_bytes: int, pending_table: Tensor | None
    ) -> None:
        """Allocate the pool (PoolError: the budget is less than two blocks).

        `table`: on the host, pinned if `device` is a GPU. `budget_bytes`: of the device that the pool may
        take. `pending_table`: as for `BlockIndex`, on the device.
        """
        self.table, self._device, self._budget = table, device, budget_bytes
        self.moved = Moved()
        # High priority: its kernels need few multiprocessors, and the next step waits for them.
        self._stream = torch.cuda.Stream(device, priority=-1) if device.type == "cuda" else None
        self._storage: dict[str, Tensor] = {}
        self.held = self._held_of({name: column[:0] for name, column in table.columns.items()}, 0)
        self._is_open = self._rest_changed = False
        self.reindex(pending_table)

    # --- The pool -----------------------------------------------------------------------------------------

    def reindex(self, pending_table: Tensor | None) -> None:
        """Rebuild the index after rows were added, removed or reordered, or the schedule changed."""
        self.write_back()
        self._pending_table = pending_table
        self._blocks, self._rest = divmod(len(self.table), BLOCK_ROWS)
        self._make_pool()
        index = BlockIndex(self.table, None if pending_table is None else pending_table.cpu())
        # The last entry is used for slots without a block: a box that no view sees.
        nothing = torch.full((1, 8), torch.finfo(torch.float32).max)
        nothing[:, 3:6] *= -1
        nothing[:, 6:] = 0
        levels = torch.zeros(1, 2, dtype=torch.uint8)
        self._bounds = torch.cat((index.bounds, nothing)).to(self._device)
        self._level_ranges = torch.cat((index.level_ranges, levels)).to(self._device)
        mask = self.table.columns.get(CULL)
        self._culled = (
            None if mask is None else culled_blocks(sectors_in(mask)[: self._blocks]).to(self._device)
        )

    @property
    def bounds(self) -> Tensor:
        """The bounds of all blocks of the table, on the device."""
        return self._bounds[:-1]

    def _make_pool(self) -> None:
        """Allocate as many slots as the budget allows; a last, partial block has its own slot."""
        table = self.table
        names = [*_WRITTEN, *(name for name in table if name not in _WRITTEN)]
        sizes = {name: BLOCK_ROWS * table.row_bytes[name] for name in names}
        self._bytes_in = sum(sizes.values())
        self._bytes_out = sum(sizes[name] for name in _WRITTEN)
        has_rest = self._rest > 0
        slots = min(self._blocks, self._budget // self._bytes_in - has_rest)
        if slots < min(1, self._blocks):
            raise PoolError(
                f"{_SETTING}: {self._budget / 1e9:g} GB are less than two blocks of 256 Gaussians, "
                f"which take {amount(2 * self._bytes_in)}"
            )
        rows = slots * BLOCK_ROWS + self._rest
        allocated_rows = (slots + has_rest) * BLOCK_ROWS
        if any(not fits(self._storage.get(name), table.columns[name], allocated_rows) for name in names):
            # Free the old pool before allocating the new one.
            self.held.columns.clear()
            self._storage.clear()
            self._storage = {n: table.row_of(n).zeros(allocated_rows, self._device) for n in names}
        self.held = self._held_of({name: self._storage[name] for name in names}, rows)
        self._block_in = np.full(slots, _FREE, dtype=np.int64)
        self._slot_of = np.full(self._blocks, _FREE, dtype=np.int64)
        self._is_changed = np.zeros(slots, dtype=bool)
        self._last_use = np.zeros(slots, dtype=np.int64)
        self._clock = 0
        self._ready_for: int | None = None
        self._loading: int | None = None  # blocks that are being loaded for the next step, if that is all

    @staticmethod
    def _held_of(columns: Mapping[str, Tensor], rows: int) -> GaussianTable:
        """Return a table of the first `rows` rows of columns in their stored form."""
        held = GaussianTable({name: column[:rows] for name, column in columns.items() if name != CULL})
        if CULL in columns:
            held.columns[CULL] = columns[CULL][: stored_rows(CULL, rows)]
        return held

    def _open(self) -> None:
        """Begin to use the pool: load the last, partial block, which stays."""
        if not self._is_open and self._rest:
            for name, column in self.held.columns.items():
                count = stored_rows(name, self._rest)
                column[-count:].copy_(self.table.columns[name][-count:])
        self._is_open = True

    def write_back(self) -> None:
        """Write all changes back to the table on the host, and empty the pool."""
        if not self._is_open:
            return
        slots = (self._block_in >= 0).nonzero()[0]
        self._move(slots, np.full(len(slots), _FREE), self._mark())
        for name in _WRITTEN if self._rest_changed else ():
            self.table[name][-self._rest :].copy_(self.held[name][-self._rest :])
        if self._stream is not None:
            self._stream.synchronize()
        self._is_open = self._rest_changed = False
        self._ready_for = self._loading = None

    def catch_up(self, function: Callable[[GaussianTable], None]) -> None:
        """Load every block of the table into the pool, one part after the other, and change its rows there.

        `function`: changes the pool in place, and must tolerate that some rows are passed to it twice.
        """
        self.write_back()
        self._open()
        slots = len(self._block_in)
        for begin in range(0, max(1, self._blocks), max(1, slots)):
            coming = np.arange(begin, min(begin + slots, self._blocks))
            self._move(np.arange(len(coming)), coming, self._mark())
            self._wait()
            function(self.held)
            self._is_changed[:] = True
            self._rest_changed = self._rest > 0
        self.write_back()

    # --- Blocks for views ---------------------------------------------------------------------------------

    def load_for_step(self, step: int, cameras: Cameras, batch_size: int) -> BlockIndex:
        """Load the blocks that the views of a step see into the pool.

        `cameras`: views of this step and of the following steps, in order, at most 32. `batch_size`: views
        per step. Returns the index of the pool's blocks. The step updates its bounds; pass it to
        `store_bounds` afterwards. PoolError: the blocks do not fit into the pool.
        """
        self._open()
        self._begun = self._mark()
        self._visibility = BlockVisibility(self._bounds[: self._blocks], cameras, batch_size, self._culled)
        if self._ready_for != step:
            # `prefetch` has not loaded all of them.
            self._load(self._visibility.blocks_of_batch(0), self._begun, required=True)
        self._ready_for = self._loading = None
        self._wait()
        return self._index()

    def prefetch(self, step: int) -> None:
        """Load the blocks of the next step, number `step`, while the step of `load_for_step` runs.

        Call this after the host has waited for the running step's number of splats: before its active set is
        complete, the device may still read the cull masks of blocks whose slots this method may reuse.
        """
        now = self._visibility.blocks_of_batch(0)
        slots = self._slot_of[now.nonzero()[0]]
        if (slots < 0).any():
            raise RuntimeError("blocks of this step have left the pool; this is a bug, please report it")
        self._clock += 1
        self._last_use[slots] = self._clock
        self._is_changed[slots] = True
        self._rest_changed = self._rest > 0
        self._count(steps=1, needed=len(slots))
        # Of batches with more than half of the 32 views that are tested, only the present one is known.
        if self._visibility.batches > 1:
            following = self._visibility.blocks_of_batch(1)
            before = self.moved.loaded
            if self._load(following, self._begun, kept=now):
                self._ready_for = step
                self._loading = self.moved.loaded - before

    def store_bounds(self, index: BlockIndex) -> None:
        """Store the bounds of the index that `load_for_step` returned, after a step has moved rows.

        All work of the step is queued then, so the host has time to choose blocks of later steps.
        """
        self._bounds[self._table_blocks] = index.bounds
        if self._loading is not None:
            self._load_ahead(self._loading)

    def load_for_views(self, cameras: Cameras) -> BlockIndex:
        """Load the blocks that views see, to render without a training step; else as `load_for_step`."""
        self._open()
        self._ready_for = self._loading = None
        self._visibility = BlockVisibility(self._bounds[: self._blocks], cameras, len(cameras.viewmats))
        wanted = self._visibility.blocks_of_batch(0)
        self._count(needed=int(wanted.sum()))
        self._load(wanted, self._mark(), required=True)
        self._wait()
        return self._index()

    def rows_of(self, rows: Tensor) -> Tensor:
        """Map rows of the pool to rows of the table, both int32."""
        blocks = self._table_blocks[rows.long() // BLOCK_ROWS].int()
        return blocks * BLOCK_ROWS + rows % BLOCK_ROWS

    def _index(self) -> BlockIndex:
        blocks = np.where(self._block_in < 0, len(self._bounds) - 1, self._block_in)
        table_blocks = torch.from_numpy(np.append(blocks, self._blocks) if self._rest else blocks)
        self._table_blocks = to_device(table_blocks, self._device)
        return BlockIndex.of_bounds(
            self._bounds[self._table_blocks], self._level_ranges[self._table_blocks], self._pending_table
        )

    def _load(
        self,
        wanted: npt.NDArray[np.bool_],
        after: torch.cuda.Event | None,
        kept: npt.NDArray[np.bool_] | None = None,
        required: bool = False,
    ) -> bool:
        """Start to load as many blocks as fit; return whether that is all of the wanted blocks."""
        missing = (wanted & (self._slot_of < 0)).nonzero()[0]
        free = self._first_to_go(wanted if kept is None else wanted | kept, len(missing))
        if required and len(missing) > len(free):
            needed, slots = int(wanted.sum()), len(self._block_in)
            raise PoolError(
                f"views that are rendered together see {needed:,} blocks of 256 Gaussians, "
                f"{amount(needed * self._bytes_in)}, and the pool has room for {slots:,}, "
                f"{amount(slots * self._bytes_in)}: raise {_SETTING}, or train with a lower "
                "schedule.batch_size"
            )
        self._move(free, missing[: len(free)], after)
        self._count(loaded=min(len(missing), len(free)))
        return len(missing) <= len(free)

    def _load_ahead(self, loading: int) -> None:
        """Start to load blocks of the steps after the next one, where the next one has all its blocks.

        Views that follow each other may see quite different blocks, and the bus would be idle before. So this
        loads at the lowest steady rate at which all blocks that are known to be needed come in time. They
        take slots whose block is not known to be needed.

        `loading`: blocks that are already being loaded during this step.
        """
        due, batches = self._visibility.next_use, self._visibility.batches
        missing = ((self._slot_of < 0) & (due < UNSEEN)).nonzero()[0]
        # Batch k has k steps, of which this is the first, until its blocks must be there.
        needed = loading + np.bincount(due[missing], minlength=batches).cumsum()[1:]
        rate = int(np.ceil((needed / np.arange(1, batches)).max()))
        if rate == loading:
            return
        slots = self._first_to_go(due < UNSEEN, min(rate - loading, len(missing)))
        coming = missing[np.argsort(due[missing], kind="stable")[: len(slots)]]
        self._move(slots, coming, self._begun)
        self._count(loaded=len(coming))

    def _first_to_go(self, held: npt.NDArray[np.bool_], count: int) -> npt.NDArray[np.int64]:
        """Choose up to `count` slots to load into: empty ones, then those whose blocks are needed last.

        Among equals, those that were used longest ago go first. A block in `held` stays.
        """
        free = (self._block_in < 0).nonzero()[0]
        if count <= len(free):
            return free[: max(0, count)]
        blocks = ((self._slot_of >= 0) & ~held).nonzero()[0]
        idle = self._slot_of[blocks]
        count -= len(free)
        if count < len(idle):
            next_use = self._visibility.next_use[blocks].astype(np.int64)
            rank = self._last_use[idle] - next_use * (self._clock + 1)
            idle = idle[np.argpartition(rank, count)[:count]]
        return np.append(free, idle)

    # --- Moves --------------------------------------------------------------------------------------------

    def _move(
        self, slots: npt.NDArray[np.int64], coming: npt.NDArray[np.int64], after: torch.cuda.Event | None
    ) -> None:
        """Queue a swap behind an event: write the slots' blocks back and load `coming`; -1: load none."""
        if len(slots) == 0:
            return
        old, is_changed = self._block_in[slots], self._is_changed[slots]
        leaving = np.where(is_changed, old, _FREE)
        lists = torch.from_numpy(np.stack((slots, leaving, coming)).astype(np.int32))
        columns = list(self.held.columns.values()), [self.table.columns[name] for name in self.held]
        if self._stream is None:
            swap_blocks_(*columns, len(_WRITTEN), *lists)
        else:
            assert after is not None
            self._stream.wait_event(after)
            with torch.cuda.stream(self._stream):
                lists = to_device(lists, self._device)
                swap_blocks_(*columns, len(_WRITTEN), *lists)
        self._slot_of[old[old >= 0]] = _FREE
        self._block_in[slots], self._is_changed[slots] = coming, False
        self._slot_of[coming[coming >= 0]] = slots[coming >= 0]
        self._count(
            bytes_in=int((coming >= 0).sum()) * self._bytes_in,
            bytes_out=int((leaving >= 0).sum()) * self._bytes_out,
        )

    def _count(self, **more: int) -> None:
        counts = {name: getattr(self.moved, name) + count for name, count in more.items()}
        self.moved = self.moved._replace(**counts)

    def _mark(self) -> torch.cuda.Event | None:
        """Record an event after all work queued so far; None on the CPU."""
        return None if self._stream is None else torch.cuda.current_stream(self._device).record_event()

    def _wait(self) -> None:
        """Make the current stream wait for the swaps."""
        if self._stream is not None:
            torch.cuda.current_stream(self._device).wait_stream(self._stream)
