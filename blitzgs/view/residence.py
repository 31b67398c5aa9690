# SPDX-License-Identifier: Apache-2.0
"""Beyond the memory of a GPU: which blocks of a table in the memory of the host are on the device, and when.

A `Residence` keeps a pool on the device, a smaller table with the same columns, in whose slots blocks of 256
rows of the host's table live for a while. Nothing about a row depends on its place, so the ops work on the
pool as they would on the table, and give the same result.

The order of the training views is known. Before a step begins, the bounds of all blocks, which stay on the
device, are tested against the views of that step and of the next ones (`seen_blocks`). While the step runs,
the blocks that the next step sees take the slots of blocks that are needed farthest in the future, on a
stream of their own. The bounds of a block change only when a step moves its rows, and blocks of the present
step keep their slots until it has ended; so what was found before the step is still right after it. Where
both steps together do not fit, the next one waits for the rest of its blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.model import CULL, EXP_AVG_SQS, EXP_AVGS, PARAMETERS, GaussianTable
from blitzgs.ops.blocks import BLOCK_ROWS
from blitzgs.ops.residence import swap_blocks_
from blitzgs.view.blocks import BlockIndex
from blitzgs.view.host_table import HostTable
from blitzgs.view.sight import Cameras, Sight, culled_blocks

# What steps change, and what is therefore written back.
_WRITTEN = (
    *PARAMETERS, *EXP_AVGS, *EXP_AVG_SQS, "last_step", "moment_step", "grad_sum", "grad_count", "max_radii",
)  # fmt: skip
_FREE = -1


class ResidenceError(RuntimeError):
    """What views see does not fit into the pool; names the sizes and what to do."""


class Traffic(NamedTuple):
    """What moved between host and device.

    Attributes:
        steps: of training.
        needed: blocks that views saw.
        loaded: blocks that came because views see them.
        bytes_in: that came, for whatever reason.
        bytes_out: that went back.
    """

    steps: int = 0
    needed: int = 0
    loaded: int = 0
    bytes_in: int = 0
    bytes_out: int = 0

    def since(self, earlier: Traffic) -> Traffic:
        """Return what moved since an earlier count."""
        return Traffic(*(now - then for now, then in zip(self, earlier, strict=True)))

    def values(self) -> dict[str, float]:
        """Return the share of blocks that were there already, and megabytes a step, for a log."""
        return {
            "resident_hits": max(0.0, 1.0 - self.loaded / max(1, self.needed)),
            "moved_mb_per_step": (self.bytes_in + self.bytes_out) / 1e6 / max(1, self.steps),
        }


class Residence:
    """A pool on the device for blocks of a table in the memory of the host.

    Between `bring` and `collect` the table on the host is out of date; `collect` empties the pool.

    Attributes:
        table: on the host.
        pool: on the device; its rows that are in no block of `bring`'s index mean nothing.
        traffic: so far.
    """

    def __init__(
        self, table: HostTable, device: torch.device, budget_bytes: int, schedule: Tensor | None
    ) -> None:
        """Make a pool.

        Args:
            table: on the host, pinned where `device` is a GPU.
            device: of the pool.
            budget_bytes: memory that the pool may take.
            schedule: as for `BlockIndex`, on the device.

        Raises:
            ResidenceError: the budget is less than two blocks.
        """
        self.table, self._device, self._budget = table, device, budget_bytes
        self.traffic = Traffic()
        # First in line for multiprocessors: it needs few of them, and the next step waits for it.
        self._stream = torch.cuda.Stream(device, priority=-1) if device.type == "cuda" else None
        self._storage: dict[str, Tensor] = {}
        self.pool = self._pool_of({name: column[:0] for name, column in table.columns.items()}, 0)
        self._is_open = self._rest_changed = False
        self.reindex(schedule)

    # --- The pool -----------------------------------------------------------------------------------------

    def reindex(self, schedule: Tensor | None) -> None:
        """Take note that rows of the table were added, removed or reordered, or that the schedule changed."""
        self.collect()
        self._schedule = schedule
        self._blocks, self._rest = divmod(len(self.table), BLOCK_ROWS)
        self._make_pool()
        index = BlockIndex(self.table, None if schedule is None else schedule.cpu())
        # The last entry is that of slots without a block: a box that no view sees.
        nothing = torch.full((1, 8), torch.finfo(torch.float32).max)
        nothing[:, 3:6] *= -1
        nothing[:, 6:] = 0
        levels = torch.zeros(1, 2, dtype=torch.uint8)
        self._bounds = torch.cat((index.bounds, nothing)).to(self._device)
        self._level_ranges = torch.cat((index.level_ranges, levels)).to(self._device)
        cull = self.table.cull
        self._culled = None if cull is None else culled_blocks(cull[: self._blocks]).to(self._device)

    def _make_pool(self) -> None:
        """Make room for as many blocks as the budget has; a block of fewer than 256 rows has its own slot."""
        table = self.table
        names = [*_WRITTEN, *(name for name in table if name not in _WRITTEN)]
        sizes = {name: BLOCK_ROWS * table.row_bytes[name] for name in names}
        self._bytes_in = sum(sizes.values())
        self._bytes_out = sum(sizes[name] for name in _WRITTEN)
        has_rest = self._rest > 0
        slots = min(self._blocks, self._budget // self._bytes_in - has_rest)
        if slots < min(1, self._blocks):
            raise ResidenceError(
                f"memory.resident_gb: {self._budget / 1e9:g} GB are less than two blocks of 256 Gaussians, "
                f"which take {2 * self._bytes_in / 1e9:.4f} GB"
            )
        rows = slots * BLOCK_ROWS + self._rest
        room = (slots + has_rest) * BLOCK_ROWS
        if any(not _fits(self._storage.get(name), table.columns[name], room) for name in names):
            # The old pool goes before the new one comes.
            self.pool.columns.clear()
            self._storage.clear()
            self._storage = {
                name: torch.zeros((room, *row.shape), dtype=row.dtype, device=self._device)
                for name, row in ((name, table.row_of(name)) for name in names)
            }
        self.pool = self._pool_of({name: self._storage[name] for name in names}, rows)
        self._block_in = np.full(slots, _FREE, dtype=np.int64)
        self._slot_of = np.full(self._blocks, _FREE, dtype=np.int64)
        self._is_changed = np.zeros(slots, dtype=bool)
        self._last_use = np.zeros(slots, dtype=np.int64)
        self._clock = 0
        self._ready_for: int | None = None

    @staticmethod
    def _pool_of(columns: Mapping[str, Tensor], rows: int) -> GaussianTable:
        """Return a table of the first rows of columns, as tables store them."""
        pool = GaussianTable({name: column[:rows] for name, column in columns.items() if name != CULL})
        if CULL in columns:
            pool.columns[CULL] = columns[CULL][: -(-rows // BLOCK_ROWS) * BLOCK_ROWS]
        return pool

    def _open(self) -> None:
        """Begin to use the pool: the last, partial block comes to stay."""
        if not self._is_open and self._rest:
            for name, column in self.pool.columns.items():
                # The mask of the last block is as long as that of any.
                count = BLOCK_ROWS if name == CULL else self._rest
                column[-count:].copy_(self.table.columns[name][-count:])
        self._is_open = True

    def collect(self) -> None:
        """Write all changes back to the table on the host, and empty the pool."""
        if not self._is_open:
            return
        slots = (self._block_in >= 0).nonzero()[0]
        self._move(slots, np.full(len(slots), _FREE), self._mark())
        for name in _WRITTEN if self._rest_changed else ():
            self.table[name][-self._rest :].copy_(self.pool[name][-self._rest :])
        if self._stream is not None:
            self._stream.synchronize()
        self._is_open, self._rest_changed, self._ready_for = False, False, None

    def catch_up(self, function: Callable[[GaussianTable], None]) -> None:
        """Bring every block through the pool and change its rows there.

        Args:
            function: changes a pool in place; some rows come twice.
        """
        self.collect()
        self._open()
        slots = len(self._block_in)
        for begin in range(0, max(1, self._blocks), max(1, slots)):
            coming = np.arange(begin, min(begin + slots, self._blocks))
            self._move(np.arange(len(coming)), coming, self._mark())
            self._wait()
            function(self.pool)
            self._is_changed[:] = True
            self._rest_changed = self._rest > 0
        self.collect()

    # --- Blocks for views ---------------------------------------------------------------------------------

    def bring(self, step: int, cameras: Cameras, batch_size: int) -> BlockIndex:
        """Have the blocks that the views of a step see in the pool.

        Args:
            step: its number.
            cameras: views of the step and of those that follow, in their order, at most 32.
            batch_size: views of a step.

        Returns:
            Where the pool's blocks are. It changes with the step, and `note` takes it back.

        Raises:
            ResidenceError: they do not fit.
        """
        self._open()
        self._begun = self._mark()
        self._sight = Sight(self._bounds[: self._blocks], cameras, batch_size, self._culled)
        if self._ready_for != step:
            # They have not come ahead, or not all of them.
            self._load(self._sight.by(0), self._begun, required=True)
        self._ready_for = None
        self._wait()
        return self._index()

    def prefetch(self, step: int) -> None:
        """While the step of `bring` runs, load the blocks of the next one, `step`.

        The host has waited for the step's number of splats by now, so its active set has been found: until
        then the masks of blocks that they leave out wholly are read, whose slots may be given away here.
        """
        now = self._sight.by(0)
        slots = self._slot_of[now.nonzero()[0]]
        if (slots < 0).any():
            raise RuntimeError("blocks of this step have left the pool; this is a bug, please report it")
        self._clock += 1
        self._last_use[slots] = self._clock
        self._is_changed[slots] = True
        self._rest_changed = self._rest > 0
        self._count(steps=1, needed=len(slots))
        # Batches of more than half of what can be looked at together show no more than the present one.
        if self._sight.batches > 1 and self._load(self._sight.by(1), self._begun, kept=now):
            self._ready_for = step

    def note(self, index: BlockIndex) -> None:
        """Take back what `bring` returned, after a step has moved rows."""
        self._bounds[self._places] = index.bounds

    def visit(self, cameras: Cameras) -> BlockIndex:
        """Have the blocks that some views see in the pool, to look at them; as `bring`."""
        self._open()
        self._ready_for = None
        self._sight = Sight(self._bounds[: self._blocks], cameras, len(cameras.viewmats))
        wanted = self._sight.by(0)
        self._count(needed=int(wanted.sum()))
        self._load(wanted, self._mark(), required=True)
        self._wait()
        return self._index()

    def rows_of(self, rows: Tensor) -> Tensor:
        """Return the rows of the table that are in rows of the pool, both int32."""
        blocks = self._places[rows.long() // BLOCK_ROWS].int()
        return blocks * BLOCK_ROWS + rows % BLOCK_ROWS

    def _index(self) -> BlockIndex:
        blocks = np.where(self._block_in < 0, len(self._bounds) - 1, self._block_in)
        places = torch.from_numpy(np.append(blocks, self._blocks) if self._rest else blocks)
        if self._stream is not None:
            places = places.pin_memory()
        self._places = places.to(self._device, non_blocking=True)
        return BlockIndex.of_bounds(
            self._bounds[self._places], self._level_ranges[self._places], self._schedule
        )

    def _load(
        self,
        wanted: npt.NDArray[np.bool_],
        after: torch.cuda.Event | None,
        kept: npt.NDArray[np.bool_] | None = None,
        required: bool = False,
    ) -> bool:
        """Let blocks come, as many as there is room for; return whether all are there or on their way."""
        missing = (wanted & (self._slot_of < 0)).nonzero()[0]
        free = (self._block_in < 0).nonzero()[0]
        if len(missing) > len(free):
            held = wanted if kept is None else wanted | kept
            taken = (self._block_in >= 0).nonzero()[0]
            idle = taken[~held[self._block_in[taken]]]
            free = np.append(free, self._first_to_go(idle, len(missing) - len(free)))
        if required and len(missing) > len(free):
            self._refuse(int(wanted.sum()))
        count = min(len(missing), len(free))
        self._move(free[:count], missing[:count], after)
        self._count(loaded=count)
        return count == len(missing)

    def _refuse(self, needed: int) -> None:
        slots = len(self._block_in)
        raise ResidenceError(
            f"views that are rendered together see {needed:,} blocks of 256 Gaussians, "
            f"{needed * self._bytes_in / 1e9:.3f} GB, and the pool has room for {slots:,}, "
            f"{slots * self._bytes_in / 1e9:.3f} GB: raise memory.resident_gb, or lower schedule.batch_size"
        )

    def _first_to_go(self, slots: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
        """Choose slots whose blocks are needed last, and among equals those that were needed longest ago."""
        if len(slots) <= count:
            return slots
        rank = self._sight.next_use(self._block_in[slots]) * (self._clock + 1) - self._last_use[slots]
        return slots[np.argpartition(-rank, count)[:count]]

    # --- Moves --------------------------------------------------------------------------------------------

    def _move(
        self,
        slots: npt.NDArray[np.int64],
        coming: npt.NDArray[np.int64],
        after: torch.cuda.Event | None,
    ) -> None:
        """Let blocks come into slots, whose own blocks go back; -1: none comes. Queued behind an event."""
        if len(slots) == 0:
            return
        old, is_changed = self._block_in[slots], self._is_changed[slots]
        leaving = np.where(is_changed, old, _FREE)
        lists = torch.from_numpy(np.stack((slots, leaving, coming)).astype(np.int32))
        columns = list(self.pool.columns.values()), [self.table.columns[name] for name in self.pool]
        if self._stream is None:
            swap_blocks_(*columns, len(_WRITTEN), *lists)
        else:
            assert after is not None
            self._stream.wait_event(after)
            with torch.cuda.stream(self._stream):
                lists = lists.pin_memory().to(self._device, non_blocking=True)
                swap_blocks_(*columns, len(_WRITTEN), *lists)
        self._slot_of[old[old >= 0]] = _FREE
        self._block_in[slots], self._is_changed[slots] = coming, False
        self._slot_of[coming[coming >= 0]] = slots[coming >= 0]
        self._count(
            bytes_in=int((coming >= 0).sum()) * self._bytes_in,
            bytes_out=int((leaving >= 0).sum()) * self._bytes_out,
        )

    def _count(self, **more: int) -> None:
        counts = {name: getattr(self.traffic, name) + count for name, count in more.items()}
        self.traffic = self.traffic._replace(**counts)

    def _mark(self) -> torch.cuda.Event | None:
        """Return an event behind all that is queued for the device by now; None on the CPU."""
        return None if self._stream is None else torch.cuda.current_stream(self._device).record_event()

    def _wait(self) -> None:
        """Let the device's work wait for the moves."""
        if self._stream is not None:
            torch.cuda.current_stream(self._device).wait_stream(self._stream)


def _fits(storage: Tensor | None, column: Tensor, rows: int) -> bool:
    """Tell whether memory of the pool can hold some rows of a column."""
    return (
        storage is not None
        and len(storage) >= rows
        and storage.shape[1:] == column.shape[1:]
        and storage.dtype == column.dtype
    )
