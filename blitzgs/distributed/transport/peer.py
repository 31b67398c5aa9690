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
wait in `Ranks.reading`, where the watchdog finds them, and a barrier that lasts longer than that aborts the
process's kernels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileAssignment
from blitzgs.distributed.shared_memory import SharedMemory
from blitzgs.distributed.transport.base import Arrived, Exchange, HostCounts, Splats, Traffic, Transport
from blitzgs.distributed.transport.collective import carry_sums
from blitzgs.ops.capacity import CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, ProjectionInputs, splats_of
from blitzgs.ops.scatter import runs_of
from blitzgs.ops.splat_gradients import SPLAT_GRADIENT, SplatGradients

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


class PeerTransport(Transport):
    """For ranks of one host whose GPUs reach each other's memory."""

    def __init__(self, ranks: Ranks, capacity: CapacityEstimate | None = None) -> None:
        """Serve `ranks`, which have shared memory; the estimate must be the same on all of them."""
        super().__init__(capacity)
        if ranks.memory is None:
            raise ValueError(f"the ranks share no memory; their transport is {ranks.transport}")
        self._ranks, self._memory = ranks, ranks.memory
        self._buffers: PeerBuffers | None = None

    def start(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.start`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        if capacity is not None:
            splats = -(-capacity.splats // _ALIGNMENT) * _ALIGNMENT
            if len(self._memory.buffers[0]) < splats * WORDS_PER_SPLAT:
                self._ranks.reading(partial(self._memory.reserve, splats * WORDS_PER_SPLAT))
        if self._buffers is None or self._buffers.buffers[0] is not self._memory.buffers[0]:
            self._buffers = PeerBuffers(self._memory.buffers, self._ranks.rank)
        return _PeerExchange(self._ranks, self._memory, self._buffers, inputs, assignment, capacity)


class _PeerExchange(Exchange):
    def __init__(
        self,
        ranks: Ranks,
        memory: SharedMemory,
        buffers: PeerBuffers,
        inputs: ProjectionInputs,
        assignment: TileAssignment,
        capacity: Sizes | None,
    ) -> None:
        super().__init__()
        self._ranks, self._memory, self._buffers, self._capacity = ranks, memory, buffers, capacity
        self._n_views = inputs.n_views
        self._traffic: Traffic | None = None
        room = Sizes(buffers.length, buffers.length, 0)
        projected = inputs.run(room, assignment.all_composited)
        self._projected = projected.splats
        self._shared = memory.share(projected.totals)  # barrier A
        self._counted = torch.cuda.Event()
        self._counted.record()
        own = Splats.of(projected.splats, projected.ids)
        self._places, self._plan = torch.ops.blitzgs.send_splats_(
            list(own), projected.splats.rank_masks, self._shared.everyone, ranks.rank, buffers.buffers,
            buffers.length,
        )  # fmt: skip
        memory.barrier()  # B
        memory.generation += 1
        self._generation = memory.generation

    def _receive(self) -> Arrived:
        n_isects = self._read().n_isects if self._capacity is None else self._capacity.isects
        return Arrived(self._buffers.splats, self._plan[:1], n_isects)

    def _gradient_table(self) -> Tensor:
        return self._buffers.tables[self._ranks.rank]

    def _finish(self) -> HostCounts | None:
        traffic = self._read()
        self.needed = Sizes(traffic.most, traffic.most, traffic.most_isects, traffic.most_blocks)
        if traffic.most > self._buffers.length:
            return None
        room = self._capacity
        if room is not None and (traffic.most_isects > room.isects or traffic.most_blocks > room.blocks):
            return None
        projected = splats_of(self._projected[:12], traffic.counts)
        self._places = self._places[: runs_of(len(projected.camera_ids))]
        visible = self._shared.sums[VIEW_TOTALS : VIEW_TOTALS + self._n_views]
        return HostCounts(projected, self._buffers.splats.first(sum(traffic.received)), visible, traffic)

    def _read(self) -> Traffic:
        """Wait for the counts of all ranks."""
        if self._traffic is None:
            self._ranks.reading(self._counted.synchronize)
            self._traffic = Traffic.of(self._shared.host.tolist(), self._n_views, self._ranks.rank)
        return self._traffic

    def _check_current(self) -> None:
        if self._generation != self._memory.generation:
            raise RuntimeError(
                "a later exchange has overwritten this one's splats: run the backward pass of a frame before "
                "the next forward pass"
            )

    def _cleared_table(self) -> Tensor:
        self._memory.barrier()
        return self._buffers.tables[self._ranks.rank][: sum(self._read().received)].zero_()

    def _return_gradients(self, parts: Sequence[Tensor]) -> SplatGradients:
        # The gradients are in the tables, where their owners read them.
        self._memory.barrier()  # C
        traffic = self._read()
        mine = zip(self._buffers.tables, traffic.starts, traffic.sent, strict=True)
        return SplatGradients([table[start : start + n] for table, start, n in mine], self._places)

    def _return_sums(self, sums: Tensor) -> Tensor:
        traffic = self._read()
        return carry_sums(sums, self._places, traffic, int(traffic.counts[1]), self._ranks)
