# SPDX-License-Identifier: Apache-2.0
"""The exchange of a step: projected splats from their owners to the ranks whose tiles they touch, and back.

Each rank projects its own Gaussians. The counting pass of the projection finds where each row will have to
go, and `read_traffic` shows everyone's counts to all, which is all the host waits for; `send` brings the rows
there; `send_back` returns their gradients along the same routes and adds them up at the owner, by rank, so
that the sum does not depend on who was faster (paper §3.1). `exchange` is the differentiable form for use
with autograd, `plan_route` for rows that are there already.

Rows travel in one of two ways. Ranks with peer access write them straight into the columns that the others
composite from (`blitzgs.distributed.peers`). Otherwise they are packed, carried by one all-to-all and taken
apart. Either way the place of a row among those of its rank follows from the masks and one number per block
of rows, and serves the way back too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileRanges
from blitzgs.distributed.peers import Peers
from blitzgs.ops.route import route_count
from blitzgs.ops.scatter import (
    as_column,
    gather_rows,
    scatter_rows,
    sum_rows,
    words_of,
    words_per_row,
)

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
        visible: int64 [B], rows of each view before the exchange, over all ranks.
    """

    counts: Tensor
    rows: list[list[int]]
    rank: int
    n_isects: int
    visible: Tensor

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


@dataclass
class Route:
    """Where the rows of one rank go.

    Attributes:
        traffic: what goes where over all ranks.
        masks: int64 [P], bit m set for rows that go to rank m.
        halves: float16 [P, 4 + D], what to send for conic, opacity and colour in half precision; None: send
            them as they are.
        peers: how rows travel; None: by collectives.
        bases: int32, places of the rows sent, see `blitzgs.ops.scatter`; set by `send`.
        exchange: which exchange over peers this is; set by `send`.
    """

    traffic: Traffic
    masks: Tensor
    halves: Tensor | None = None
    peers: Peers | None = None
    bases: Tensor | None = None
    exchange: int = 0


def read_traffic(totals: Tensor, n_views: int, ranks: Ranks) -> Traffic:
    """Agree on how many rows go where; the step's only wait for the device.

    Args:
        totals: of `project_count`, with the tiles of each rank; int64 [3 + B + 2 M].
        n_views: B.
        ranks: the job.
    """
    everyone = ranks.share(totals)
    known = ranks.read(everyone)
    first = 3 + n_views
    return Traffic(
        counts=torch.tensor(known[ranks.rank][:3]),
        rows=[numbers[first::2] for numbers in known],
        rank=ranks.rank,
        n_isects=sum(numbers[first + 2 * ranks.rank + 1] for numbers in known),
        visible=everyone[:, 3:first].sum(0),
    )


def plan_route(splats: Splats, ranges: TileRanges, ranks: Ranks, half: bool = False) -> Route:
    """Find the ranks that each row has to reach, from the rows alone; waits for the device.

    Args:
        splats: this rank's rows.
        ranges: who composites which tiles.
        ranks: the job.
        half: send conics (as Cholesky factors, which stay positive definite), opacities and colours in
            float16, and their gradients in bfloat16; positions and depths stay as they are. A row of three
            colours then takes 40 bytes instead of 52 one way, and 20 instead of 36 back. For slow links, so
            always by collectives.
    """
    halves, conics, opacities = None, splats.conics.detach(), splats.opacities.detach()
    if half:
        # Routed by what arrives: rounding may move a splat's border over that of a tile.
        halves = torch.cat((_factor(conics), opacities[:, None], splats.colors.detach()), 1).half()
        conics, opacities, _ = _from_halves(halves, conics.dtype)
    masks, counts = route_count(
        splats.means2d.detach(),
        conics,
        opacities,
        splats.camera_ids,
        [ranges.composited(rank) for rank in range(ranks.world_size)],
        ranges.width,
        ranges.height,
        ranges.tile_size,
    )
    views = torch.arange(ranges.n_views, dtype=torch.int32, device=masks.device)
    seen = (splats.camera_ids == views[:, None]).sum(1)
    # As `project_count` would have it; nobody asks for the first three.
    totals = torch.cat((counts.new_zeros(3), seen, counts.flatten()))
    traffic = read_traffic(totals, ranges.n_views, ranks)
    return Route(traffic, masks, halves, None if half else ranks.peers)


def send(splats: Splats, route: Route, ranks: Ranks) -> Splats:
    """Carry rows to the ranks whose tiles they touch.

    Args:
        splats: this rank's rows.
        route: of these rows; remembers their places.
        ranks: the job.

    Returns:
        The rows that touch the tiles this rank composites, grouped by source rank. Where peers write them,
        they are valid until the next exchange.
    """
    if route.peers is not None:
        return _write_rows(splats, route, route.peers)
    columns = [splats.means2d, splats.depths, splats.camera_ids, splats.ids]
    if route.halves is None:
        columns += [splats.conics, splats.opacities, splats.colors]
    else:
        columns += [route.halves]
    sent, received = route.traffic.sent, route.traffic.received
    packed, route.bases = scatter_rows(columns, route.masks, sent)
    words = sum(map(words_per_row, columns))
    arrived = ranks.all_to_all(packed, [words * n for n in sent], [words * n for n in received])
    means2d, depths, camera_ids, ids, *rest = gather_rows(arrived, columns, received)
    conics, opacities, colors = rest if route.halves is None else _from_halves(rest[0], means2d.dtype)
    return Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)


def send_back(gradients: Sequence[Tensor], route: Route, ranks: Ranks) -> list[Tensor]:
    """Return the gradients of received rows to their owners, and add them up there in the order of ranks.

    Args:
        gradients: [R, ...] each, of the rows that `send` returned.
        route: the same as for `send`.
        ranks: the job.

    Returns:
        Gradients [P, ...] of this rank's own rows; zero for rows that touch no tile.

    Raises:
        RuntimeError: another exchange has taken the place of this one.
    """
    if route.bases is None:
        raise RuntimeError("send_back: the route's rows have not been sent")
    flat = [g.reshape(len(g), math.prod(g.shape[1:])) for g in gradients]
    widths, dtype = [g.shape[1] for g in flat], gradients[0].dtype
    sent, received = route.traffic.sent, route.traffic.received
    if route.peers is not None:
        returned = _write_gradients(flat, route, route.peers)
    elif route.halves is None:
        returned = ranks.all_to_all(torch.cat(flat, 1), received, sent).view(-1, sum(widths))
    else:
        # Gradients span too many magnitudes for float16.
        halves = torch.cat(flat, 1).bfloat16()
        returned = as_column(ranks.all_to_all(words_of(halves), received, sent), halves).to(dtype)
    sums = sum_rows(returned, route.masks, route.bases, sent, widths)
    return [part.reshape(-1, *g.shape[1:]) for part, g in zip(sums, gradients, strict=True)]


def _write_rows(splats: Splats, route: Route, peers: Peers) -> Splats:
    """`send`, into the memory of the others."""
    traffic, columns = route.traffic, [words_of(column) for column in splats]
    ends = list(itertools.accumulate(column.shape[1] for column in columns))
    needed = -(-traffic.most // _ALIGNMENT) * _ALIGNMENT
    peers.reserve(2 * needed * ends[-1])  # a gradient is never wider than its row
    # The first half of a buffer is for rows, the second for gradients.
    capacity = len(peers.buffers[0]) // 2 // ends[-1] // _ALIGNMENT * _ALIGNMENT
    before = [sum(row[d] for row in traffic.rows[: peers.rank]) for d in range(peers.world_size)]
    peers.exchanges += 1
    route.exchange = peers.exchanges
    route.bases = torch.ops.blitzgs.scatter_to_peers_(
        columns, route.masks, peers.buffers, capacity, before, traffic.sent
    )
    peers.meet()
    mine, count, arrived = peers.buffers[peers.rank], sum(traffic.received), []
    for like, words, end in zip(splats, columns, ends, strict=True):
        width = words.shape[1]
        begin = capacity * (end - width)
        arrived.append(as_column(mine[begin : begin + count * width].view(count, width), like))
    return Splats(*arrived)


def _write_gradients(flat: list[Tensor], route: Route, peers: Peers) -> Tensor:
    """Write gradients [R, w] to the owners of their rows; return what came back here, [S, sum w]."""
    if route.exchange != peers.exchanges:
        raise RuntimeError(
            "send_back: a later exchange has overwritten this one's rows: run the backward pass of a frame "
            "before the next forward pass"
        )
    traffic, width = route.traffic, sum(column.shape[1] for column in flat)
    offset = len(peers.buffers[0]) // 2
    before = [sum(row[: peers.rank]) for row in traffic.rows]
    torch.ops.blitzgs.return_to_peers_(flat, traffic.received, peers.buffers, offset, before)
    peers.meet()
    count = sum(traffic.sent)
    mine = peers.buffers[peers.rank][offset : offset + count * width]
    return mine.view(torch.float32).view(count, width)


def exchange(splats: Splats, ranges: TileRanges, ranks: Ranks, half: bool = False) -> tuple[Splats, Route]:
    """Differentiable exchange: `plan_route` and `send`, with `send_back` as the backward pass.

    Several may be open at once, so their rows travel by collectives.

    Args:
        splats: this rank's rows; gradients flow to means2d, conics, opacities, colors and depths.
        ranges: who owns which tiles.
        ranks: the job. All ranks must run the backward pass too.
        half: see `plan_route`.

    Returns:
        The rows that touch this rank's tiles, and the route.
    """
    route = plan_route(splats, ranges, ranks, half)
    route.peers = None
    return Splats(*_Exchange.apply(*splats, route, ranks)), route  # type: ignore[no-untyped-call]


class _Exchange(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *columns, route, ranks = arguments
        ctx.route, ctx.ranks = route, ranks
        received = send(Splats(*columns), route, ranks)
        ctx.mark_non_differentiable(received.camera_ids, received.ids)
        return tuple(received)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *own, _, _ = gradients
        returned = send_back(own, ctx.route, ctx.ranks)
        return (*returned, None, None, None, None)


def _factor(conics: Tensor) -> Tensor:
    """Cholesky factors (l11, l21, l22) of conics (a, b, c) [P, 3]."""
    a, b, c = conics.double().unbind(1)
    l11 = a.sqrt()
    l21 = b / l11
    return torch.stack((l11, l21, (c - l21 * l21).clamp(min=0).sqrt()), 1).to(conics.dtype)


def _from_halves(halves: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Conics, opacities and colours of a route's `halves`; the same bits wherever it is called."""
    values = halves.to(dtype)
    l11, l21, l22 = values[:, :3].unbind(1)
    conics = torch.stack((l11 * l11, l11 * l21, l21 * l21 + l22 * l22), 1)
    return conics, values[:, 3].contiguous(), values[:, 4:].contiguous()
