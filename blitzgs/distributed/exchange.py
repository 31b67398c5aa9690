# SPDX-License-Identifier: Apache-2.0
"""The exchange of a step: projected splats from their owners to the ranks whose tiles they touch, and back.

Each rank projects its own Gaussians. The projection also finds where each row will have to go, and
`read_traffic` shows everyone's counts to all, which is all the host waits for; `send` brings the rows there;
`send_back` returns their gradients along the same routes, to be added up at the owner, by rank, so
that the sum does not depend on who was faster (paper §3.1). `exchange` is the differentiable form for use
with autograd, `plan_route` for rows that are there already.

Rows travel in one of two ways. Where the ranks share memory (`blitzgs.distributed.peers`), each writes its
rows into the columns that the others composite from, and the host waits for the numbers when compositing is
queued: `PeerSpace` does so. Nothing is sent back then: the projection's backward pass reads the gradients
where the ranks that composited the rows added them up (`PeerSpace.share_table`), so that they travel while
the optimiser works. Otherwise rows are packed, carried by one all-to-all and taken apart, and their gradients
likewise. Either way the places of rows among those of a rank are kept in 8 bytes per 32 rows, and serve the
way back too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileRanges
from blitzgs.distributed.rows import PeerSpace, Splats, Traffic
from blitzgs.ops.route import route_count
from blitzgs.ops.scatter import (
    RUN,
    as_column,
    gather_rows,
    scatter_rows,
    sum_rows,
    words_of,
    words_per_row,
)

# Colours travel with their rows where no rank has this many to send or get: too little to be worth a meeting
# more.
LEAST_ROWS = 1 << 18


@dataclass
class Route:
    """Where the rows of one rank go.

    Attributes:
        traffic: what goes where over all ranks.
        masks: int64 [P], bit m set for rows that go to rank m.
        halves: float16 [P, 4 + D], what to send for conic, opacity and colour in half precision; None: send
            them as they are.
        places: int64, of the rows sent, see `blitzgs.ops.scatter`; None: not sent yet.
        space: where peers write; None: rows travel by collectives.
    """

    traffic: Traffic
    masks: Tensor
    halves: Tensor | None = None
    places: Tensor | None = None
    space: PeerSpace | None = None

    @property
    def pays_apart(self) -> bool:
        """Whether colours had better travel on their own, where peers write; as all ranks see it."""
        return self.traffic.most >= LEAST_ROWS


def read_traffic(totals: Tensor, n_views: int, ranks: Ranks) -> Traffic:
    """Agree on how many rows go where; waits for the device.

    Args:
        totals: as for `PeerSpace.queue`.
        n_views: B.
        ranks: the job.
    """
    everyone = ranks.share(totals)
    visible = everyone[:, 3 : 3 + n_views].sum(0)
    return Traffic.of(ranks.read(everyone), visible, ranks.rank)


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
    return Route(traffic, masks, halves)


def send(splats: Splats, route: Route, ranks: Ranks) -> Splats:
    """Carry rows to the ranks whose tiles they touch.

    Args:
        splats: this rank's rows.
        route: of these rows, without peers; remembers their places.
        ranks: the job.

    Returns:
        The rows that touch the tiles this rank composites, grouped by source rank.
    """
    columns = [splats.means2d, splats.depths, splats.camera_ids, splats.ids]
    if route.halves is None:
        columns += [splats.conics, splats.opacities, splats.colors]
    else:
        columns += [route.halves]
    sent, received = route.traffic.sent, route.traffic.received
    packed, route.places = scatter_rows(columns, route.masks, sent)
    words = sum(map(words_per_row, columns))
    arrived = ranks.all_to_all(packed, [words * n for n in sent], [words * n for n in received])
    means2d, depths, camera_ids, ids, *rest = gather_rows(arrived, columns, received)
    conics, opacities, colors = rest if route.halves is None else _from_halves(rest[0], means2d.dtype)
    return Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)


def send_back(gradients: Sequence[Tensor], route: Route, ranks: Ranks) -> list[Tensor]:
    """Return the gradients of received rows to their owners, and add them up there in the order of ranks.

    Args:
        gradients: [R, ...] each, of the rows that `send` returned.
        route: the same as for `send`, without peers.
        ranks: the job.

    Returns:
        Gradients [P, ...] of this rank's own rows; zero for rows that touch no tile.
    """
    flat = [g.reshape(len(g), math.prod(g.shape[1:])) for g in gradients]
    widths, dtype = [g.shape[1] for g in flat], gradients[0].dtype
    sent, received = route.traffic.sent, route.traffic.received
    if route.halves is None:
        returned = ranks.all_to_all(torch.cat(flat, 1), received, sent).view(-1, sum(widths))
    else:
        # Gradients span too many magnitudes for float16.
        halves = torch.cat(flat, 1).bfloat16()
        returned = as_column(ranks.all_to_all(words_of(halves), received, sent), halves).to(dtype)
    if route.places is None:
        raise RuntimeError("send_back: the route's rows have not been sent")
    sums = sum_rows(returned, route.places, sent, len(route.masks), widths)
    return [part.reshape(-1, *g.shape[1:]) for part, g in zip(sums, gradients, strict=True)]


def send_back_sums(sums: Tensor, route: Route, ranks: Ranks) -> Tensor:
    """Return integer sums over the tiles of each rank to the owners of the rows, and add them up there.

    Integers, so that the total depends on nothing but the rows.

    Args:
        sums: int64 [R, C], of the rows that arrived here.
        route: of this rank's rows; they may have travelled either way.
        ranks: the job.

    Returns:
        int64 [P, C], of this rank's own rows; zero for rows that touch no tile.
    """
    if route.places is None:
        raise RuntimeError("send_back_sums: the route's rows have not been sent")
    sent = route.traffic.sent
    returned = ranks.all_to_all(sums, route.traffic.received, sent)
    total = sums.new_zeros(len(route.masks), sums.shape[1])
    lanes = torch.arange(RUN, device=sums.device)
    for group, runs in zip(returned.split(sent), route.places.unbind(1), strict=True):
        # A run of rows lies together: its first place, and which of the rows are there (csrc/scatter).
        here = runs[:, None] >> (32 + lanes) & 1
        at = (runs[:, None] & 0xFFFFFFFF) + here.cumsum(1) - here
        rows = here.flatten().nonzero().squeeze(1)
        total.index_add_(0, rows, group[at.flatten()[rows]])
    return total


def exchange(splats: Splats, ranges: TileRanges, ranks: Ranks, half: bool = False) -> tuple[Splats, Route]:
    """Differentiable exchange: `plan_route` and `send`, with `send_back` as the backward pass.

    Several may be open at once, so rows travel by collectives.

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
    @once_differentiable
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
