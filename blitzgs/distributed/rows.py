# SPDX-License-Identifier: Apache-2.0
"""What travels between ranks: projected rows, how many go where, and where peers write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.peers import Peers

# Columns of a row as peers write them: those of `Splats`, with dtype, words and shape of an element.
_COLUMNS = (
    (torch.float32, 2, (2,)),
    (torch.float32, 3, (3,)),
    (torch.float32, 1, ()),
    (torch.float32, 3, (3,)),
    (torch.float32, 1, ()),
    (torch.int32, 1, ()),
    (torch.int64, 2, ()),
)
_ROW_WORDS = sum(words for _, words, _ in _COLUMNS)
# Gradients of means2d, conics, opacities and colors as they return; `rasterize_bwd_packed_` has them first.
_GRADIENT_WORDS = 9
# Projects, and sends rows to the peers: see `PeerSpace.fill`.
Projection = Callable[[int], tuple[Tensor, list[Tensor]]]
Sending = Callable[[list[Tensor], Tensor, list[Tensor], int], list[Tensor]]
# A buffer holds a multiple of this many rows, so that every column begins at a full memory transaction.
_ALIGNMENT = 32


class Splats(NamedTuple):
    """Projected Gaussians as compositing sees them; P rows.

    Attributes:
        means2d: [P, 2] pixels.
        conics: [P, 3], inverse 2D covariance (a, b, c).
        opacities: [P].
        colors: [P, D].
        depths: [P].
        camera_ids: int32 [P].
        ids: int64 [P], persistent: what breaks ties of depth.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    camera_ids: Tensor
    ids: Tensor


@dataclass(frozen=True)
class Traffic:
    """How many rows go where: what the host has to know before rows are written and exchanged.

    Attributes:
        counts: int64 [3] on the CPU: this rank's visible Gaussians, rows and tiles they touch.
        rows: rows[s][d] that rank s sends to rank d.
        rank: this rank.
        most: most rows that any rank has, sends or gets.
        n_isects: row-tile intersections among the rows received, or a few more.
        visible: int64 [B], rows of each view before the exchange, over all ranks; over shared memory valid
            until the next exchange.
    """

    counts: Tensor
    rows: list[list[int]]
    rank: int
    most: int
    n_isects: int
    visible: Tensor

    @classmethod
    def of(cls, known: Sequence[Sequence[int]], visible: Tensor, rank: int) -> Traffic:
        """Read it from every rank's totals."""
        first = 3 + len(visible)
        rows = [list(numbers[first::2]) for numbers in known]
        most = max(*(n[1] for n in known), *map(sum, rows), *map(sum, zip(*rows, strict=True)))
        return cls(
            counts=torch.tensor(known[rank][:3]),
            rows=rows,
            rank=rank,
            most=most,
            n_isects=sum(numbers[first + 2 * rank + 1] for numbers in known),
            visible=visible,
        )

    @property
    def sent(self) -> list[int]:
        """Rows for each rank."""
        return self.rows[self.rank]

    @property
    def received(self) -> list[int]:
        """Rows from each rank."""
        return [row[self.rank] for row in self.rows]


@dataclass(frozen=True)
class PeerSpace:
    """Where the rows of one exchange lie in the peers' memory, see `blitzgs.distributed.peers`.

    Attributes:
        peers: the memory.
        traffic: what goes where.
        capacity: length of the columns of arriving rows.
        exchange: number of this exchange; only the last one's rows are there.
    """

    peers: Peers
    traffic: Traffic
    capacity: int
    exchange: int

    @classmethod
    def fill(
        cls, n_views: int, ranks: Ranks, project: Projection, send: Sending
    ) -> tuple[list[Tensor], list[Tensor], Tensor, PeerSpace]:
        """Have the rows of all ranks written to each other, and agree on how many. Collective.

        All is queued, up to the meeting that ends it, before the host waits for the numbers: they come while
        rows travel. Each rank has room for as many rows of its own as the buffers have for those that arrive,
        so that all ranks know, on the device too, whether everything fits.

        Args:
            n_views: B.
            ranks: the job, with peers.
            project: `project_count` with room for so many rows: returns its totals, with the tiles of each
                rank, int64 [3 + B + 2 M], and its rows.
            send: `project_rows_to_peers_`: given the rows, all ranks' totals, the buffers and how many rows
                each has room for; returns, as that, places, filled and what has to live.

        Returns:
            This rank's rows, with room behind them; what `send` returned; int64 [M], how many of the rows
            from each rank are of the first part of its Gaussians; and where the rows are.
        """
        peers = ranks.peers
        assert peers is not None and peers.second is not None
        while True:
            room = len(peers.buffers[0]) // (_ROW_WORDS + _GRADIENT_WORDS) // _ALIGNMENT * _ALIGNMENT
            totals, rows = project(room)
            everyone, sums, known = peers.share(totals)
            told = torch.cuda.Event()
            told.record()
            sent = send(rows, everyone, peers.buffers, room)
            fronts = peers.share(sent[1][0]).everyone[:, ranks.rank]
            ranks.reading(told.synchronize)
            traffic = Traffic.of(known.tolist(), sums[3 : 3 + n_views], ranks.rank)
            if traffic.most <= room:
                peers.exchanges += 1
                return rows, sent, fronts, cls(peers, traffic, room, peers.exchanges)
            torch.cuda.current_stream().wait_stream(peers.second)
            needed = -(-traffic.most // _ALIGNMENT) * _ALIGNMENT
            ranks.reading(partial(peers.reserve, (_ROW_WORDS + _GRADIENT_WORDS) * needed))

    def arrived(self) -> Splats:
        """Return the rows that arrive here; they may be read after the next meeting."""
        peers, count = self.peers, sum(self.traffic.received)
        if len(peers.columns) == 0 or len(peers.columns[0]) != self.capacity:
            peers.columns = _columns(peers.buffers[peers.rank], self.capacity)
        return Splats(*(column[:count] for column in peers.columns))

    def meet_colors(self) -> None:
        """Wait, in stream order, for the colours of all ranks."""
        assert self.peers.second is not None
        torch.cuda.current_stream().wait_stream(self.peers.second)
        self.peers.meet()

    def write_back(self, packed: Tensor, fronts: Tensor | None = None, back: bool = False) -> Tensor:
        """Write the gradients of the rows that arrived from other ranks to these.

        Args:
            packed: [R, 9 or more], of `rasterize_bwd_packed_`.
            fronts: int64 [M], only of so many rows from each, from the first on; None: of all.
            back: instead, only of the rest.

        Returns:
            [S, 9], those of the rows this rank sent, undefined where it sent them to itself; they may be read
            after the next meeting.

        Raises:
            RuntimeError: a later exchange has begun.
        """
        if self.exchange != self.peers.exchanges:
            raise RuntimeError(
                "send_back: a later exchange has overwritten this one's rows: run the backward pass of a "
                "frame before the next forward pass"
            )
        offset, me = self.capacity * _ROW_WORDS, self.peers.rank
        before = [sum(row[:me]) for row in self.traffic.rows]
        torch.ops.blitzgs.return_to_peers_(
            packed,
            _GRADIENT_WORDS,
            self.traffic.received,
            self.peers.buffers,
            offset,
            before,
            me,
            fronts,
            back,
        )
        count = sum(self.traffic.sent)
        mine = self.peers.buffers[me][offset : offset + count * _GRADIENT_WORDS]
        return mine.view(torch.float32).view(count, _GRADIENT_WORDS)


def _columns(buffer: Tensor, capacity: int) -> list[Tensor]:
    """Return the columns of a buffer, each of `capacity` rows."""
    columns, begin = [], 0
    for dtype, words, shape in _COLUMNS:
        end = begin + capacity * words
        columns.append(buffer[begin:end].view(dtype).view(capacity, *shape))
        begin = end
    return columns
