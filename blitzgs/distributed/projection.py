# SPDX-License-Identifier: Apache-2.0
"""Projection on any number of ranks: rows queued for compositing, wherever they are composited.

Where there is room for them, rows are projected, sent and listed before the host knows how many there are: it
learns that, and whether the room was enough, when compositing is queued (`Projection.settle`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.exchange import Route, plan_route, read_traffic
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import Share
from blitzgs.distributed.rows import PeerSpace, Splats
from blitzgs.ops.host import tell_host
from blitzgs.ops.project import RowRoom, Rows, color_rows, emit_rows, holds, queue_rows, rows_of
from blitzgs.ops.scatter import runs_of


class Known(NamedTuple):
    """What the host knows of a projection in the end.

    Attributes:
        rows: this rank's.
        splats: what was composited, where rows did not travel by collectives.
        route: where rows went; None: they stayed.
        visible: int64 [B], rows of each view over all ranks.
    """

    rows: Rows
    splats: Splats
    route: Route | None
    visible: Tensor


class Projection(NamedTuple):
    """Rows on their way to compositing.

    Attributes:
        splats: the rows, or what the other ranks' projections write here; with room behind them.
        route: where rows have to be sent; None: they stay, or go there by themselves.
        space: where they arrive then; None: by collectives.
        n_rows: int64 [1], how many splats there are, on the device; None: there is no room behind them.
        n_isects: how many intersections there are at most, or may be listed.
        settle: waits for the numbers; None: there was too little room for something.
    """

    splats: Splats
    route: Route | None
    space: PeerSpace | None
    n_rows: Tensor | None
    n_isects: int
    settle: Callable[[], Known | None]


def project_views(
    arguments: Sequence[Any],
    ids: Tensor,
    n_views: int,
    share: Share | None,
    room: RowRoom,
    waiting: ExitStack,
) -> Projection:
    """Project this rank's Gaussians and, on several ranks, agree on which row goes where.

    Args:
        arguments: of the op `project_count`, from means to active_count, with the tiles of each rank.
        ids: int64 [N], persistent, of the Gaussians.
        n_views: B.
        share: who composites which tiles; None: this rank alone.
        room: for the rows and their lists, of the frames before.
        waiting: left when all was queued that needs the rows.
    """
    if share is None:
        return _project_here(arguments, ids, n_views, room, waiting)
    if share.ranks.peers is not None and not share.half:
        return _project_to_peers(arguments, ids, n_views, share.ranks, waiting)
    return _project_and_route(arguments, ids, n_views, share)


def _project_here(
    arguments: Sequence[Any], ids: Tensor, n_views: int, room: RowRoom, waiting: ExitStack
) -> Projection:
    """Project for one rank: where there is room, without waiting for the number of rows."""
    sizes = room.sizes
    planned, totals, columns = queue_rows(arguments, sizes, ids)
    told = waiting.enter_context(tell_host(totals))
    visible = totals[3 : 3 + n_views]
    if not columns:
        counts = told()[:3]
        needed = counts.tolist()
        room.learn(needed)
        columns = emit_rows(arguments, planned, counts, ids)
        known = Known(rows_of(columns, counts), _splats_of(columns), None, visible)
        return Projection(known.splats, None, None, None, needed[2], lambda: known)
    color_rows(arguments, totals, columns)

    def settle() -> Known | None:
        counts = told()[:3]
        needed = counts.tolist()
        room.learn(needed)
        if not holds(sizes, needed):
            return None
        count = needed[1]
        splats = Splats(*(column[:count] for column in _splats_of(columns)))
        return Known(rows_of(columns, counts), splats, None, visible)

    return Projection(_splats_of(columns), None, None, totals[1:2], sizes[2], settle)


def _splats_of(columns: Sequence[Tensor]) -> Splats:
    """Return what is composited of the columns of `queue_rows`."""
    rows = Rows._make((*columns[:12], None))
    return Splats(
        rows.means2d, rows.conics, rows.opacities, rows.colors, rows.depths, rows.camera_ids, columns[12]
    )


def _project_to_peers(
    arguments: Sequence[Any], ids: Tensor, n_views: int, ranks: Ranks, waiting: ExitStack
) -> Projection:
    """Project, and write rows to the ranks that composite them, through memory that these share."""
    peers = ranks.peers
    assert peers is not None and peers.second is not None
    second = peers.second
    colors_stream = second.cuda_stream if peers.apart else 0
    width, height, _, sh_degree = arguments[9:13]

    def project(capacity: int) -> tuple[Tensor, list[Tensor]]:
        return torch.ops.blitzgs.project_count(*arguments, capacity, capacity, ids)[2:]

    def send(rows: list[Tensor], everyone: Tensor, buffers: list[Tensor], capacity: int) -> list[Tensor]:
        return torch.ops.blitzgs.project_rows_to_peers_(
            *arguments[:7], width, height, sh_degree, everyone, ranks.rank, rows, buffers, capacity,
            colors_stream,
        )  # fmt: skip

    def release(error: type[BaseException] | None, *_: object) -> None:
        """Keep the rows' memory from others as long as colours are written into it."""
        if error is not None:
            torch.cuda.current_stream().wait_stream(second)

    waiting.push(release)
    while True:
        columns, places, space = PeerSpace.queue(n_views, ranks, project, send)
        if space.n_isects > 0 or space.settle(ranks):
            break

    def settle() -> Known | None:
        if not space.settle(ranks):
            return None
        traffic = space.traffic
        assert traffic is not None
        rows = rows_of(columns, traffic.counts)
        route = Route(traffic, rows.rank_masks, places=places[: runs_of(len(rows.camera_ids))], space=space)
        peers.apart = route.pays_apart
        return Known(rows, space.arrived(), route, traffic.visible)

    n_isects = space.n_isects if space.traffic is None else space.traffic.n_isects
    return Projection(space.arrived(), None, space, space.arrived_count, n_isects, settle)


def _project_and_route(arguments: Sequence[Any], ids: Tensor, n_views: int, share: Share) -> Projection:
    """Project, and agree on which row will travel where by collectives."""
    planned, totals, _ = queue_rows(arguments, (0, 0, 0), ids)
    if share.half:
        with tell_host(totals) as told:
            counts = told()[:3]
    else:
        traffic = read_traffic(totals, n_views, share.ranks)
        counts = traffic.counts
    columns = emit_rows(arguments, planned, counts, ids)
    rows, splats = rows_of(columns, counts), _splats_of(columns)
    if share.half:
        route = plan_route(splats, share.ranges, share.ranks, share.half)
    else:
        route = Route(traffic, rows.rank_masks)
    known = Known(rows, splats, route, route.traffic.visible)
    return Projection(splats, route, None, None, route.traffic.n_isects, lambda: known)
