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
from blitzgs.ops.rasterize import PACKED_GRADIENT
from blitzgs.ops.scatter import RowTables

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
# Projects, and sends rows to the peers: see `PeerSpace.queue`.
Projecting = Callable[[int], tuple[Tensor, list[Tensor]]]
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
        most_isects: the most that any rank has of these.
        visible: int64 [B], rows of each view before the exchange, over all ranks; over shared memory valid
            until the next exchange.
    """

    counts: Tensor
    rows: list[list[int]]
    rank: int
    most: int
    n_isects: int
    most_isects: int
    visible: Tensor

    @classmethod
    def of(cls, known: Sequence[Sequence[int]], visible: Tensor, rank: int) -> Traffic:
        """Read it from every rank's totals."""
        first = 3 + len(visible)
        rows = [list(numbers[first::2]) for numbers in known]
        most = max(*(n[1] for n in known), *map(sum, rows), *map(sum, zip(*rows, strict=True)))
        isects = [sum(column) for column in zip(*(n[first + 1 :: 2] for n in known), strict=True)]
        return cls(
            counts=torch.tensor(known[rank][:3]),
            rows=rows,
            rank=rank,
            most=most,
            n_isects=isects[rank],
            most_isects=max(isects),
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


@dataclass
class PeerSpace:
    """Where the rows of one exchange lie in the peers' memory, see `blitzgs.distributed.peers`.

    Attributes:
        peers: the memory.
        capacity: length of the columns of arriving rows.
        exchange: number of this exchange; only the last one's rows are there.
        n_isects: how many intersections of a rank's rows may be listed; 0: any, but first `settle`.
        apart: whether colours travel on their own.
        arrived_count: int64 [1] on the device, how many rows arrive; none where some rank lacks room.
        admitted: what has to live until the rows' colours are there.
        known: on the CPU, every rank's totals, once `told` has come to pass.
        told: behind the meeting that brings them.
        visible: int64 [B], rows of each view over all ranks.
        traffic: what goes where, from `settle` on.
    """

    peers: Peers
    capacity: int
    exchange: int
    n_isects: int
    apart: bool
    arrived_count: Tensor
    admitted: Tensor
    known: Tensor
    told: torch.cuda.Event
    visible: Tensor
    traffic: Traffic | None = None

    @classmethod
    def queue(
        cls, n_views: int, ranks: Ranks, project: Projecting, send: Sending
    ) -> tuple[list[Tensor], Tensor, PeerSpace]:
        """Queue that all ranks' rows are written to each other, up to the meeting that ends it. Collective.

        Each rank has room for as many rows of its own as the buffers have for those that arrive, so that all
        ranks know, on the device too, whether everything fits.

        Args:
            n_views: B.
            ranks: the job, with peers.
            project: `project_count` with room for so many rows: returns its totals, with the tiles of each
                rank, int64 [3 + B + 2 M], and its rows.
            send: `project_rows_to_peers_`: given the rows, all ranks' totals, the buffers and how many rows
                each has room for; returns, as that, places and what has to live.

        Returns:
            This rank's rows, with room behind them; their places; and where the rows of all are. Until
            `settle` says that they fit, none may be there.
        """
        peers = ranks.peers
        assert peers is not None
        room = len(peers.buffers[0]) // (_ROW_WORDS + PACKED_GRADIENT) // _ALIGNMENT * _ALIGNMENT
        totals, rows = project(room)
        everyone, sums, known = peers.share(totals)
        told = torch.cuda.Event()
        told.record()
        places, admitted = send(rows, everyone, peers.buffers, room)
        peers.meet()
        peers.exchanges += 1
        numbers = peers.exchanges, peers.n_isects, peers.apart
        visible = sums[3 : 3 + n_views]
        return rows, places, cls(peers, room, *numbers, admitted[:1], admitted, known, told, visible)

    def settle(self, ranks: Ranks) -> bool:
        """Wait for the numbers, `traffic`. Collective.

        Returns:
            Whether there was room for all of every rank; where not, there is now.
        """
        peers = self.peers
        if self.traffic is None:
            ranks.reading(self.told.synchronize)
            self.traffic = Traffic.of(self.known.tolist(), self.visible, ranks.rank)
            peers.learn(self.traffic.most_isects)
        most = self.traffic.most
        if most > self.capacity:
            assert peers.second is not None
            torch.cuda.current_stream().wait_stream(peers.second)
            needed = -(-most // _ALIGNMENT) * _ALIGNMENT
            ranks.reading(partial(peers.reserve, (_ROW_WORDS + PACKED_GRADIENT) * needed))
        return most <= self.capacity and (self.n_isects == 0 or self.traffic.most_isects <= self.n_isects)

    @property
    def length(self) -> int:
        """How many rows arrive here or, before `settle`, may."""
        return self.capacity if self.traffic is None else sum(self.traffic.received)

    def arrived(self) -> Splats:
        """Return the rows that arrive here, before `settle` with room; they may be read after the meeting."""
        peers = self.peers
        if len(peers.columns) == 0 or len(peers.columns[0]) != self.capacity:
            peers.columns = _columns(peers.buffers[peers.rank], self.capacity)
        return Splats(*(column[: self.length] for column in peers.columns))

    def meet_colors(self) -> None:
        """Wait, in stream order, for the colours of all ranks, unless they came with the rows."""
        if self.apart:
            assert self.peers.second is not None
            torch.cuda.current_stream().wait_stream(self.peers.second)
            self.peers.meet()

    def table(self) -> Tensor:
        """Return the table for gradients of the rows of `arrived`, [R, 12], see `rasterize_bwd_packed_`.

        It may be written between the meeting for the rows and the one that `share_table` waits for.
        """
        begin = self.capacity * _ROW_WORDS
        words = self.peers.buffers[self.peers.rank][begin : begin + self.length * PACKED_GRADIENT]
        return words.view(torch.float32).view(self.length, PACKED_GRADIENT)

    def check_current(self) -> None:
        """Raise a RuntimeError if a later exchange has begun."""
        if self.exchange != self.peers.exchanges:
            raise RuntimeError(
                "a later exchange has overwritten this one's rows: run the backward pass of a frame before "
                "the next forward pass"
            )

    def clear_table(self) -> Tensor:
        """Return `table`, zeros, once no rank reads it any more. Collective."""
        self.peers.meet()
        return self.table().zero_()

    def share_table(self, places: Tensor) -> RowTables:
        """Let the owners of the rows read the table, and tell where this rank's are in all. Collective.

        Args:
            places: of the rows that this rank sent.
        """
        self.peers.meet()
        traffic, me = self.traffic, self.peers.rank
        assert traffic is not None
        starts = [sum(column[:me]) for column in zip(*traffic.rows, strict=True)]
        return RowTables(places, traffic.sent, starts, self.peers.buffers, self.capacity * _ROW_WORDS)


def _columns(buffer: Tensor, capacity: int) -> list[Tensor]:
    """Return the columns of a buffer, each of `capacity` rows."""
    columns, begin = [], 0
    for dtype, words, shape in _COLUMNS:
        end = begin + capacity * words
        columns.append(buffer[begin:end].view(dtype).view(capacity, *shape))
        begin = end
    return columns
