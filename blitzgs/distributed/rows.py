# SPDX-License-Identifier: Apache-2.0
"""What travels between ranks: projected rows, how many go where, and where peers write them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

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
# Writes rows to the peers: see `PeerSpace.fill`.
Projection = Callable[[Tensor, Tensor, list[Tensor], int], Any]
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
        n_isects: row-tile intersections among the rows received, or a few more.
        visible: int64 [B], rows of each view before the exchange, over all ranks; over shared memory valid
            until the next exchange.
    """

    counts: Tensor
    rows: list[list[int]]
    rank: int
    n_isects: int
    visible: Tensor

    @classmethod
    def of(cls, known: Sequence[Sequence[int]], visible: Tensor, rank: int) -> Traffic:
        """Read it from every rank's totals."""
        first = 3 + len(visible)
        return cls(
            counts=torch.tensor(known[rank][:3]),
            rows=[list(numbers[first::2]) for numbers in known],
            rank=rank,
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

    @property
    def most(self) -> int:
        """Most rows that any rank sends or gets."""
        return max(*map(sum, self.rows), *map(sum, zip(*self.rows, strict=True)))


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
    def fill(cls, totals: Tensor, n_views: int, ranks: Ranks, project: Projection) -> tuple[Any, PeerSpace]:
        """Begin an exchange: have the rows of all ranks written, and agree on how many. Collective.

        Args:
            totals: of `project_count`, with the tiles of each rank; int64 [3 + B + 2 M].
            n_views: B.
            ranks: the job, with peers.
            project: given all ranks' totals, the same on their way to the CPU, the buffers and how many rows
                each has room for: writes this rank's rows if there is room for everyone's, and waits for the
                totals.

        Returns:
            What `project` returned, and where the rows are.
        """
        peers = ranks.peers
        assert peers is not None
        everyone, sums, known = peers.share(totals)
        visible = sums[3 : 3 + n_views]
        needed = 0
        while True:
            ranks.reading(partial(peers.reserve, (_ROW_WORDS + _GRADIENT_WORDS) * needed))
            room = len(peers.buffers[0]) // (_ROW_WORDS + _GRADIENT_WORDS) // _ALIGNMENT * _ALIGNMENT
            result = ranks.reading(partial(project, everyone, known, peers.buffers, room))
            traffic = Traffic.of(known.tolist(), visible, ranks.rank)
            if traffic.most <= room:
                peers.exchanges += 1
                return result, cls(peers, traffic, room, peers.exchanges)
            needed = -(-traffic.most // _ALIGNMENT) * _ALIGNMENT

    def arrived(self) -> Splats:
        """Return the rows that arrive here; they may be read after the next meeting."""
        peers, count = self.peers, sum(self.traffic.received)
        if len(peers.columns) == 0 or len(peers.columns[0]) != self.capacity:
            peers.columns = _columns(peers.buffers[peers.rank], self.capacity)
        return Splats(*(column[:count] for column in peers.columns))

    def write_back(self, packed: Tensor, fronts: Tensor | None = None, back: bool = False) -> Tensor:
        """Write the gradients of the rows that arrived to their owners.

        Args:
            packed: [R, 9 or more], of `rasterize_bwd_packed_`.
            fronts: int64 [M], only of so many rows from each other rank, from the first on; None: of all.
            back: instead, only of the rest of those.

        Returns:
            [S, 9], those of the rows this rank sent; they may be read after the next meeting.

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
