# SPDX-License-Identifier: Apache-2.0
"""Sends splats by an all-to-all of NCCL or Gloo; their gradients return in the same way."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import Arrived, CapacityEstimate, ExchangeResult, Traffic, stage_ended
from blitzgs.ops.exchange import PLACE_SPLATS, gather_splats, scatter_splats, words_per_splat
from blitzgs.ops.host import to_host
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Sizes, Splats
from blitzgs.ops.splat_gradients import SplatGradients


class CollectiveTransport:
    """The transport for ranks that cannot access each other's memory.

    The ranks exchange the numbers of splats that each sends to each other, and the host waits for these
    numbers. Then splats are packed by rank, sent, and unpacked. Gradients return in the same way; their owner
    adds them up in the order of the ranks, so the sum does not depend on which rank was faster. The position
    of each splat among those sent to a rank is stored in 8 bytes per 32 splats, and is used again to return
    the gradients.
    """

    def __init__(self, ranks: Ranks) -> None:
        """Send splats between `ranks`."""
        self.estimate = CapacityEstimate()
        self._ranks = ranks

    def project_and_send(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> CollectiveExchange:
        """See `Transport.project_and_send`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        return CollectiveExchange(self._ranks, inputs, assignment, capacity)


class CollectiveExchange:
    """See `Exchange`."""

    def __init__(
        self, ranks: Ranks, inputs: ProjectionInputs, assignment: TileAssignment, capacity: Sizes | None
    ) -> None:
        """Project, exchange the numbers of splats, and send the splats."""
        tiles, n_views = assignment.composited_by_rank, assignment.ranges.n_views
        # Without capacity the projection waits for the device, which may still wait for other ranks.
        with ranks.watchdog.waiting("project"):
            projected = inputs.project(capacity, tiles)
        everyone = projected.totals.repeat(ranks.world_size, 1)
        # Newer versions of torch have this function under another name and warn about the old one.
        gather = getattr(dist, "all_gather_single", dist.all_gather_into_tensor)
        with ranks.watchdog.waiting("share_counts"):
            if ranks.world_size > 1:
                gather(everyone.view(-1), projected.totals)
            visible = everyone[:, VIEW_TOTALS : VIEW_TOTALS + n_views].sum(0)
            totals = to_host(everyone).tolist()
        traffic = Traffic.of(totals, n_views, ranks.rank)
        self._needed = needed = traffic.own._replace(blocks=traffic.most_blocks)
        if capacity is not None and not capacity.holds(needed[:2]):
            projected = inputs.project(None, tiles)  # no queued work waits for another rank now
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
        splats = Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)
        self.gradient_table: Tensor | None = None
        self.arrived = Arrived(splats, None, traffic.n_isects)
        self._result: ExchangeResult | None = None
        # All ranks decide the same, because they have estimated the same number of blocks.
        if capacity is None or needed.blocks <= capacity.blocks:
            way_back = CollectiveWayBack(ranks, traffic, places)
            self._result = ExchangeResult(own, splats, visible, traffic, way_back)
        stage_ended("exchange")

    def finish(self) -> tuple[Sizes, ExchangeResult | None]:
        """See `Exchange.finish`; the host has known all numbers since the splats were sent."""
        return self._needed, self._result


class CollectiveWayBack(NamedTuple):
    """Returns gradients by an all-to-all, and adds them up at the owner in the order of ranks."""

    ranks: Ranks
    traffic: Traffic  # numbers of splats sent between the ranks
    places: Tensor  # positions of this rank's own splats among those that it sent, from `scatter_splats`

    def check_still_valid(self) -> None:
        """Do nothing, because a frame does not overwrite the data of an earlier one."""

    def cleared_table(self) -> None:
        """Return None: any memory can be used."""

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`."""
        columns, traffic = gradients.side_by_side(), self.traffic
        returned = self.ranks.all_to_all(columns, traffic.received, traffic.sent)
        return gradients.sum_returned(returned, self.places, traffic.sent, traffic.own.splats)

    def return_sums(self, sums: Tensor) -> Tensor:
        """See `WayBack.return_sums`."""
        return return_sums(sums, self.places, self.traffic, self.ranks)


def return_sums(sums: Tensor, places: Tensor, traffic: Traffic, ranks: Ranks) -> Tensor:
    """Send integer sums of splats to their owners and add them up; see `WayBack.return_sums`.

    `sums`: int64 [R, C], sums of the splats that arrived here. `places`: positions of this rank's own splats
    among those that it sent.
    """
    returned = ranks.all_to_all(sums, traffic.received, traffic.sent)
    total = sums.new_zeros(traffic.own.splats, sums.shape[1])
    lanes = torch.arange(PLACE_SPLATS, device=sums.device)
    for group, runs in zip(returned.split(traffic.sent), places.unbind(1), strict=True):
        if group.shape[0] == 0:
            continue
        # The splats of a run are consecutive. `runs` has the position of the first one, and bits that tell
        # which splats of the run were sent (csrc/exchange/places.h).
        here = runs[:, None] >> (32 + lanes) & 1
        at = (runs[:, None] & 0xFFFFFFFF) + here.cumsum(1) - here
        # Splats that were not sent take any row, times zero: leaving them out would need their number, for
        # which the host would wait.
        rows = group[at.flatten()[: total.shape[0]].clamp(max=group.shape[0] - 1)]
        total += rows * here.flatten()[: total.shape[0], None]
    return total
