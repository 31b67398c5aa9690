# SPDX-License-Identifier: Apache-2.0
"""The exchange of a step: projected splats from their owners to the ranks whose tiles they touch, and back.

Each rank projects its own Gaussians. The counting pass of the projection finds where each row will have to
go, and `read_traffic` tells everyone (one small collective, which is all the host waits for); `send` carries
the rows there in one all-to-all of packed buffers; `send_back` returns their gradients along the same routes
and adds them up at the owner, by rank, so that the sum does not depend on who was faster (paper §3.1).
`exchange` is the differentiable form for use with autograd, `plan_route` for rows that are there already.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileRanges
from blitzgs.ops.pack import add_rows, pack_rows, unpack_rows
from blitzgs.ops.route import route_count, route_rows


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


class Route(NamedTuple):
    """Where the rows of one rank go and what it gets.

    Attributes:
        rows: int32 [S], rows to send, grouped by destination, ascending within a group.
        sent: rows for each rank.
        received: rows from each rank.
        n_rows: P, rows before the exchange.
        n_isects: row-tile intersections among the rows received.
        visible: int64 [B], rows of each view before the exchange, over all ranks.
        halves: float16 [P, 4 + D], what to send for conic, opacity and colour in half precision; None: send
            them as they are.
    """

    rows: Tensor
    sent: list[int]
    received: list[int]
    n_rows: int
    n_isects: int
    visible: Tensor
    halves: Tensor | None


class Traffic(NamedTuple):
    """What the host has to know before rows are written and exchanged.

    Attributes:
        counts: int64 [3] on the CPU: this rank's visible Gaussians, rows and tiles they touch.
        sent: rows for each rank.
        received: rows from each rank.
        n_isects: row-tile intersections among the rows to receive.
        visible: int64 [B], rows of each view over all ranks.
    """

    counts: Tensor
    sent: list[int]
    received: list[int]
    n_isects: int
    visible: Tensor


def read_traffic(totals: Tensor, n_views: int, ranks: Ranks) -> Traffic:
    """Agree on how many rows go where; the step's only wait for the device.

    Args:
        totals: of `project_count`, with the tiles of each rank; int64 [3 + B + 2 M].
        n_views: B.
        ranks: the job.
    """
    everyone = ranks.gather_counts(totals)
    by_rank = ranks.read(everyone)
    first, mine = 3 + n_views, ranks.rank
    to_me = first + 2 * mine
    return Traffic(
        counts=torch.tensor(by_rank[mine][:3]),
        sent=by_rank[mine][first::2],
        received=[counts[to_me] for counts in by_rank],
        n_isects=sum(counts[to_me + 1] for counts in by_rank),
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
            colours then takes 40 bytes instead of 52 one way, and 20 instead of 36 back.
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
    # What every rank needs to know of the others rides along, so that one exchange is enough.
    seen = count_by_view(splats.camera_ids, ranges.n_views).expand(ranks.world_size, -1)
    arriving = ranks.exchange_counts(torch.cat((counts, seen), 1))
    sent, received = ranks.read(torch.stack((counts, arriving[:, :2])))
    rows_sent = [rows for rows, _ in sent]
    return Route(
        rows=route_rows(masks, rows_sent),
        sent=rows_sent,
        received=[rows for rows, _ in received],
        n_rows=len(masks),
        n_isects=sum(isects for _, isects in received),
        visible=arriving[:, 2:].sum(0),
        halves=halves,
    )


def count_by_view(camera_ids: Tensor, n_views: int) -> Tensor:
    """Count the rows of each view, int64 [B], without waiting for the device."""
    return torch.stack([(camera_ids == view).sum() for view in range(n_views)])


def send(splats: Splats, route: Route, ranks: Ranks) -> Splats:
    """Carry rows to the ranks whose tiles they touch.

    Args:
        splats: this rank's rows.
        route: from `plan_route`.
        ranks: the job.

    Returns:
        The rows that touch the tiles this rank composites, grouped by source rank.
    """
    columns = [splats.means2d, splats.depths, splats.camera_ids, splats.ids]
    if route.halves is None:
        columns += [splats.conics, splats.opacities, splats.colors]
    else:
        columns += [route.halves]
    arrived = ranks.all_to_all(pack_rows(columns, route.rows), route.sent, route.received)
    means2d, depths, camera_ids, ids, *rest = unpack_rows(arrived, columns)
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
    """
    widths = [math.prod(gradient.shape[1:]) for gradient in gradients]
    sent, dtype = list(gradients), gradients[0].dtype
    if route.halves is not None:
        # Gradients span too many magnitudes for float16.
        flat = [g.reshape(len(g), width) for g, width in zip(gradients, widths, strict=True)]
        sent = [torch.cat(flat, 1).bfloat16()]
    every = torch.arange(len(sent[0]), dtype=torch.int32, device=sent[0].device)
    words = ranks.all_to_all(pack_rows(sent, every), route.received, route.sent)
    arrived = words.view(dtype) if route.halves is None else unpack_rows(words, sent)[0].to(dtype)
    total = add_rows(arrived, route.rows, route.sent, route.n_rows)
    parts = total.split(widths, 1)
    return [part.reshape(-1, *g.shape[1:]) for part, g in zip(parts, gradients, strict=True)]


def exchange(splats: Splats, ranges: TileRanges, ranks: Ranks, half: bool = False) -> tuple[Splats, Route]:
    """Differentiable exchange: `plan_route` and `send`, with `send_back` as the backward pass.

    Args:
        splats: this rank's rows; gradients flow to means2d, conics, opacities, colors and depths.
        ranges: who owns which tiles.
        ranks: the job. All ranks must run the backward pass too.
        half: see `plan_route`.

    Returns:
        The rows that touch this rank's tiles, and the route.
    """
    route = plan_route(splats, ranges, ranks, half)
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
