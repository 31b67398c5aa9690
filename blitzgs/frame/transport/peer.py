# SPDX-License-Identifier: Apache-2.0
"""Writes splats into the memory of the GPUs that composite them; their owners read the gradients there.

Each rank has a buffer (`SharedMemory.buffers`) that all ranks have mapped. The buffer has two parts: the
columns of the splats that arrive at this rank, and the table in which compositing's backward pass adds up
their gradients. Every buffer has room for the same number of splats, which is also the capacity of every
rank's projection. Each rank can therefore compute from the counts, also on the device, whether the splats of
all ranks fit.

In stream order, a step on every rank consists of

- projection;
- barrier A, which brings the counts of all ranks;
- writing splats into the buffers of other ranks;
- barrier B;
- sorting, and compositing, which zeroes the rank's table;
- the gradient of compositing, which is added up in this table;
- barrier C;
- summing this rank's rows of the tables of all ranks, which moves each gradient across a link once.

Work that a rank queues after a barrier begins when all work that any rank queued before it has ended. Hence

- splats are complete when they are read, because they are written before B and read after it; gradients are
  complete, because they are added up before C and read after it;
- no splat is overwritten while a rank reads it: a step writes its splats after its A, and every rank queues
  its reading of the previous step's splats before this A;
- no table is zeroed while a rank reads it: a step zeroes its table after its B, and every rank queues its
  reading of the previous step's tables before this B. A second backward pass of one frame has an additional
  barrier before the table is zeroed again.

The host queues writing and compositing before it knows the counts. If the splats do not fit into the buffer
of some rank, every rank finds this from the same counts, writes no splats and composites nothing. All ranks
then enlarge their buffers and start the frame again. They do the same if one rank has more tile entries than
the common capacity. If a rank dies, the others wait in a barrier. Their hosts wait in `Watchdog.waiting`, so
the watchdog names the dead rank. A barrier on the device that exceeds the timeout aborts the kernels of its
process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.shared_memory import SharedMemory
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import (
    CapacityEstimate,
    Exchange,
    ExchangeResult,
    Traffic,
    WayBack,
    stage_ended,
)
from blitzgs.ops.exchange import PLACE_SPLATS
from blitzgs.ops.host import current_stream
from blitzgs.ops.project import queue_projection
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Sizes, Splats, splats_of
from blitzgs.ops.rasterize import SPLAT_GRADIENT, SplatGradients

# The columns of `Splats` in the order in which ranks write them (kSentColumns of csrc/exchange/transport.h):
# dtype, words and shape of an element.
_COLUMNS: tuple[tuple[torch.dtype, int, tuple[int, ...]], ...] = (
    (torch.float32, 2, (2,)), (torch.float32, 3, (3,)), (torch.float32, 1, ()), (torch.float32, 3, (3,)),
    (torch.float32, 1, ()), (torch.int32, 1, ()), (torch.int64, 2, ()),
)  # fmt: skip
_SPLAT_WORDS = sum(words for _, words, _ in _COLUMNS)
WORDS_PER_SPLAT = _SPLAT_WORDS + SPLAT_GRADIENT
# Buffers hold a multiple of this many splats, so that every column begins at a full memory transaction.
_ALIGNMENT = 32


def room_for(splats: int, words: int) -> int:
    """Return the words that each buffer needs for a number of splats; `words` is its present length.

    All ranks stop and map their memory anew when the buffers grow. A buffer that is too small therefore grows
    by at least a quarter: in a growing model, each record of the number of splats is a little higher than the
    one before.
    """
    needed = -(-splats // _ALIGNMENT) * _ALIGNMENT * WORDS_PER_SPLAT
    return words if needed <= words else max(needed, words * 5 // 4)


class PeerBuffers:
    """The parts of the buffers of all ranks."""

    def __init__(self, buffers: Sequence[Tensor], rank: int) -> None:
        self.buffers = list(buffers)  # int32 [words] of each rank, of equal length, mapped here
        # Capacity of each buffer, in splats.
        self.length = len(buffers[0]) // WORDS_PER_SPLAT // _ALIGNMENT * _ALIGNMENT
        columns, begin = [], 0
        for dtype, words, shape in _COLUMNS:
            end = begin + self.length * words
            columns.append(buffers[rank][begin:end].view(dtype).view(self.length, *shape))
            begin = end
        self.splats = Splats(*columns)  # columns in this rank's buffer, [length]
        end = begin + self.length * SPLAT_GRADIENT
        # Table of splat gradients of each rank, float32 [length, 12].
        self.tables = [
            buffer[begin:end].view(torch.float32).view(self.length, SPLAT_GRADIENT) for buffer in buffers
        ]


class PeerTransport:
    """The transport for ranks of one host whose GPUs can access each other's memory."""

    def __init__(self, ranks: Ranks, estimate: CapacityEstimate | None = None) -> None:
        """Use the shared memory of `ranks`; the estimate must be the same on all ranks."""
        if ranks.memory is None:
            raise ValueError(f"the ranks share no memory; their transport is {ranks.transport}")
        self.estimate = estimate or CapacityEstimate()
        self._ranks, self._memory = ranks, ranks.memory
        self._buffers: PeerBuffers | None = None
        # One event serves all exchanges. The host waits for it before it starts the next exchange; if an
        # exchange was given up, a later record of the event comes after its counts, too.
        self._counted = torch.cuda.Event()

    def project_and_send(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.project_and_send`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        ranks, memory, counted, n_views = self._ranks, self._memory, self._counted, inputs.n_views
        if capacity is not None:
            present = memory.buffers[0].shape[0]
            words = room_for(capacity.splats, present)
            if words > present:
                with ranks.watchdog.waiting("reserve"):
                    memory.reserve(words)
        if self._buffers is None or self._buffers.buffers[0] is not memory.buffers[0]:
            self._buffers = PeerBuffers(memory.buffers, ranks.rank)
        buffers = self._buffers
        room = Sizes(buffers.length, buffers.length, 0)
        projected = queue_projection(inputs, room, assignment.composited_by_rank)
        shared = memory.share(projected.totals)  # barrier A
        counted.record(current_stream(ranks.device))
        places, plan = torch.ops.blitzgs.send_splats_(
            list(projected.for_compositing), projected.splats.rank_masks, shared.everyone, ranks.rank,
            buffers.buffers, buffers.length,
        )  # fmt: skip
        memory.barrier()  # B
        memory.generation += 1
        generation = memory.generation
        stage_ended("project")

        @cache
        def totals() -> list[list[int]]:
            """Wait for the counts of all ranks."""
            with ranks.watchdog.waiting("share_counts"):
                counted.synchronize()
            return shared.host.tolist()

        def finish() -> tuple[Sizes, ExchangeResult | None]:
            traffic = Traffic.of(totals(), n_views, ranks.rank)
            fits = traffic.most <= buffers.length
            if capacity is not None:
                fits &= traffic.most_isects <= capacity.isects and traffic.most_blocks <= capacity.blocks
            if not fits:
                return traffic.needed, None
            own, arrived = (
                splats_of(projected.splats, traffic.own),
                buffers.splats.first(sum(traffic.received)),
            )
            runs = places[: -(-traffic.own.splats // PLACE_SPLATS)]
            way_back = PeerWayBack(ranks, traffic, runs, memory, generation, buffers.tables)
            visible = shared.sums[VIEW_TOTALS : VIEW_TOTALS + n_views]
            return traffic.needed, ExchangeResult(own, arrived, totals()[ranks.rank], visible, way_back)

        n_isects = Traffic.of(totals(), n_views, ranks.rank).n_isects if capacity is None else capacity.isects
        stage_ended("exchange")
        table = buffers.tables[ranks.rank]
        return Exchange(projected, buffers.splats, plan[:1], n_isects, table, finish)


@dataclass(frozen=True)
class PeerWayBack(WayBack):
    """Sums gradients that lie in the memory of the ranks that composited the splats."""

    memory: SharedMemory  # the memory that the ranks share
    generation: int  # number of the frame, `SharedMemory.generation`
    tables: Sequence[Tensor]  # table of splat gradients of each rank, float32 [length, 12], mapped here

    def check_still_valid(self) -> None:
        """See `WayBack.check_still_valid`."""
        if self.generation != self.memory.generation:
            raise RuntimeError(
                "a later exchange has overwritten this one's splats: run the backward pass of a frame before "
                "the next forward pass"
            )

    def cleared_table(self) -> Tensor:
        """See `WayBack.cleared_table`."""
        self.memory.barrier()
        return self.tables[self.ranks.rank][: sum(self.traffic.received)].zero_()

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`."""
        self.memory.barrier()  # C
        mine = zip(self.tables, self.traffic.starts, self.traffic.sent, strict=True)
        rows = [table[start : start + n] for table, start, n in mine]
        splats = self.traffic.own.splats
        return SplatGradients(torch.ops.blitzgs.sum_splats(rows, self.places, splats, [SPLAT_GRADIENT]))
