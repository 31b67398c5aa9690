# SPDX-License-Identifier: Apache-2.0
"""Splats written straight into the memory of the GPUs that composite them, and gradients read there.

Each rank's buffer (`SharedMemory.buffers`) holds, one behind the other, the columns of the splats that arrive
at this rank, and the table in which compositing's backward pass adds up their gradients. Each has room for as
many splats as every rank has for its own, so that all ranks know, on the device too, whether everything fits.

A step is, in stream order on every rank: project; barrier A, which brings the counts of all ranks; write
splats to the other ranks; barrier B; sort; composite, which zeroes the table; the gradient of compositing;
barrier C; read the tables of all ranks. Work that is queued behind a barrier, on any rank, finds done what
any rank queued before it. Hence

- splats and tables are read after the barrier that follows their writing: B for splats, C for gradients;
- the splats of a step overwrite those of the step before after A, and each rank has queued the reading of
  those before its own A;
- a table is zeroed after B, and each rank has queued the reading of the step before's before its own B. A
  second backward pass of one frame has a barrier of its own before the table is zeroed again.

Splats are queued for writing behind A, and for compositing, while the counts are on their way to the host.
Where they do not fit into some rank's buffer no rank writes any: each finds that from the same counts, and
composites nothing. All ranks then enlarge their buffers and start the frame again. So it is where one rank
has more tile entries than all have room for. A rank that dies leaves the others in a barrier: their hosts
wait in `Watchdog.waiting`, so the watchdog finds them, and a barrier that lasts longer than that aborts the
process's kernels.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.shared_memory import SharedMemory
from blitzgs.distributed.tiles import TileAssignment
from blitzgs.distributed.transport.protocol import Arrived, HostCounts, Mark, Traffic, unmarked
from blitzgs.distributed.transport.way_back import PeerWayBack
from blitzgs.ops.capacity import Attempt, CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, ProjectionInputs, Splats, splats_of
from blitzgs.ops.scatter import runs_of
from blitzgs.ops.splat_gradients import SPLAT_GRADIENT

# Columns of a splat as peers write them, those of `Splats` (kSentColumns of csrc/transport/transport.h):
# dtype, words and shape of an element.
_COLUMNS = (
    (torch.float32, 2, (2,)),
    (torch.float32, 3, (3,)),
    (torch.float32, 1, ()),
    (torch.float32, 3, (3,)),
    (torch.float32, 1, ()),
    (torch.int32, 1, ()),
    (torch.int64, 2, ()),
)
_SPLAT_WORDS = sum(words for _, words, _ in _COLUMNS)
WORDS_PER_SPLAT = _SPLAT_WORDS + SPLAT_GRADIENT
# Buffers hold a multiple of this many splats, so that every column begins at a full memory transaction.
_ALIGNMENT = 32


class PeerBuffers:
    """What lies where in the buffers of all ranks.

    Attributes:
        buffers: int32 [words] of each rank, mapped here.
        length: how many splats each has room for.
        splats: columns of this rank's, [length].
        tables: of splat gradients of each rank, float32 [length, 12].
    """

    def __init__(self, buffers: Sequence[Tensor], rank: int) -> None:
        """Divide buffers of one length."""
        self.buffers = list(buffers)
        self.length = len(buffers[0]) // WORDS_PER_SPLAT // _ALIGNMENT * _ALIGNMENT
        columns, begin = [], 0
        for dtype, words, shape in _COLUMNS:
            end = begin + self.length * words
            columns.append(buffers[rank][begin:end].view(dtype).view(self.length, *shape))
            begin = end
        self.splats = Splats(*columns)
        end = begin + self.length * SPLAT_GRADIENT
        self.tables = [
            buffer[begin:end].view(torch.float32).view(self.length, SPLAT_GRADIENT) for buffer in buffers
        ]


class PeerTransport:
    """For ranks of one host whose GPUs reach each other's memory."""

    def __init__(self, ranks: Ranks, capacity: CapacityEstimate | None = None) -> None:
        """Serve `ranks`, which have shared memory; the estimate must be the same on all of them."""
        if ranks.memory is None:
            raise ValueError(f"the ranks share no memory; their transport is {ranks.transport}")
        self.capacity = capacity or CapacityEstimate()
        self._ranks, self._memory = ranks, ranks.memory
        self._buffers: PeerBuffers | None = None

    def start(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        attempt: Attempt,
        mark: Mark = unmarked,
    ) -> PeerExchange:
        """See `Transport.start`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        if attempt.sizes is not None:
            splats = -(-attempt.sizes.splats // _ALIGNMENT) * _ALIGNMENT
            if len(self._memory.buffers[0]) < splats * WORDS_PER_SPLAT:
                with self._ranks.watchdog.waiting("reserve"):
                    self._memory.reserve(splats * WORDS_PER_SPLAT)
        if self._buffers is None or self._buffers.buffers[0] is not self._memory.buffers[0]:
            self._buffers = PeerBuffers(self._memory.buffers, self._ranks.rank)
        return PeerExchange(self._ranks, self._memory, self._buffers, inputs, assignment, attempt, mark)


class PeerExchange:
    """See `Exchange`."""

    def __init__(
        self,
        ranks: Ranks,
        memory: SharedMemory,
        buffers: PeerBuffers,
        inputs: ProjectionInputs,
        assignment: TileAssignment,
        attempt: Attempt,
        mark: Mark,
    ) -> None:
        """Queue the writing of the splats."""
        self._ranks, self._memory, self._buffers, self._attempt = ranks, memory, buffers, attempt
        self._n_views = inputs.n_views
        self._traffic: Traffic | None = None
        capacity = Sizes(buffers.length, buffers.length, 0)
        projected = inputs.run(capacity, assignment.all_composited)
        self._own = projected.splats
        self._shared = memory.share(projected.totals)  # barrier A
        self._counted = torch.cuda.Event()
        self._counted.record()
        self._places, plan = torch.ops.blitzgs.send_splats_(
            list(projected.composited), projected.splats.rank_masks, self._shared.everyone, ranks.rank,
            buffers.buffers, buffers.length,
        )  # fmt: skip
        memory.barrier()  # B
        memory.generation += 1
        self._generation = memory.generation
        mark("project")
        n_isects = self._read().n_isects if attempt.sizes is None else attempt.sizes.isects
        self.arrived = Arrived(buffers.splats, plan[:1], n_isects)
        self.gradient_table: Tensor | None = buffers.tables[ranks.rank]
        mark("exchange")

    def finish(self) -> HostCounts | None:
        """See `Exchange.finish`."""
        traffic, sizes = self._read(), self._attempt.sizes
        fits = traffic.most <= self._buffers.length
        if sizes is not None:
            fits = fits and traffic.most_isects <= sizes.isects and traffic.most_blocks <= sizes.blocks
        self._attempt.end(traffic.needed, fits)
        if not fits:
            return None
        own = splats_of(self._own, traffic.counts)
        visible = self._shared.sums[VIEW_TOTALS : VIEW_TOTALS + self._n_views]
        composited = self._buffers.splats.first(sum(traffic.received))
        way_back = PeerWayBack(
            self._ranks, self._memory, self._generation, self._buffers.tables, traffic,
            self._places[: runs_of(len(own.camera_ids))],
        )  # fmt: skip
        return HostCounts(own, composited, visible, traffic, way_back)

    def _read(self) -> Traffic:
        """Wait for the counts of all ranks."""
        if self._traffic is None:
            with self._ranks.watchdog.waiting("share_counts"):
                self._counted.synchronize()
            self._traffic = Traffic.of(self._shared.host.tolist(), self._n_views, self._ranks.rank)
        return self._traffic
