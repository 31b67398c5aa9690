# SPDX-License-Identifier: Apache-2.0
"""Sends splats by an all-to-all of NCCL or Gloo; their gradients return in the same way."""

from __future__ import annotations

import torch.distributed as dist

from blitzgs.distributed.group import Ranks
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import (
    CapacityEstimate,
    Exchange,
    ExchangeResult,
    Traffic,
    WayBack,
    stage_ended,
)
from blitzgs.ops.exchange import gather_splats, scatter_splats, words_per_splat
from blitzgs.ops.host import to_host
from blitzgs.ops.project import queue_projection
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Sizes, Splats


class CollectiveTransport:
    """The transport for ranks that cannot access each other's memory.

    The ranks exchange the numbers of splats that each sends to each other, for which the host waits. Then
    splats are packed by rank, sent, and unpacked. Gradients return in the same way; their owner adds them up
    in the order of the ranks. For that, the position of each splat among those sent to a rank is stored in 8
    bytes per 32 splats.
    """

    def __init__(self, ranks: Ranks) -> None:
        self.estimate = CapacityEstimate()
        self._ranks = ranks

    def project_and_send(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.project_and_send`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        ranks, tiles, n_views = self._ranks, assignment.composited_by_rank, assignment.ranges.n_views
        # Without capacity the projection waits for the device, which may still wait for other ranks.
        with ranks.watchdog.waiting("project"):
            projected = queue_projection(inputs, capacity, tiles)
        everyone = projected.totals.repeat(ranks.world_size, 1)
        # Newer versions of torch have this function under another name and warn about the old one.
        gather = getattr(dist, "all_gather_single", dist.all_gather_into_tensor)
        with ranks.watchdog.waiting("share_counts"):
            if ranks.world_size > 1:
                gather(everyone.view(-1), projected.totals)
            visible = everyone[:, VIEW_TOTALS : VIEW_TOTALS + n_views].sum(0)
            totals = to_host(everyone).tolist()
        traffic = Traffic.of(totals, n_views, ranks.rank)
        needed = traffic.own._replace(blocks=traffic.most_blocks)
        if capacity is not None and not capacity.holds(needed[:2]):
            projected = queue_projection(inputs, None, tiles)  # no queued work waits for another rank now
        stage_ended("project")
        projected = projected.first(needed)
        own, sent = projected.splats, projected.for_compositing
        columns = [sent.means2d, sent.depths, sent.camera_ids, sent.ids]
        columns += [sent.conics, sent.opacities, sent.colors]
        packed, places = scatter_splats(columns, own.rank_masks, traffic.sent)
        rows = packed.view(-1, sum(map(words_per_splat, columns)))
        arrived = ranks.all_to_all(rows, traffic.sent, traffic.received)
        means2d, depths, camera_ids, ids, conics, opacities, colors = gather_splats(
            arrived.view(-1), columns, traffic.received
        )
        splats, result = Splats(means2d, conics, opacities, colors, depths, camera_ids, ids), None
        # All ranks decide the same, because they have estimated the same number of blocks.
        if capacity is None or needed.blocks <= capacity.blocks:
            way_back = WayBack(ranks, traffic, places)
            result = ExchangeResult(own, splats, totals[ranks.rank], visible, way_back)
        stage_ended("exchange")
        return Exchange(projected, splats, None, traffic.n_isects, None, lambda: (needed, result))
