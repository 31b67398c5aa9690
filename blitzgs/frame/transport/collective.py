# SPDX-License-Identifier: Apache-2.0
"""Sends splats by an all-to-all of NCCL or Gloo; their gradients return in the same way (`way_back`)."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import Arrived, ExchangeResult, Mark, Traffic, unmarked
from blitzgs.frame.transport.way_back import CollectiveWayBack
from blitzgs.ops.capacity import Attempt, CapacityEstimate
from blitzgs.ops.host import to_host
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Splats
from blitzgs.ops.scatter import gather_splats, scatter_splats, words_per_splat


class CollectiveTransport:
    """The transport for ranks that cannot access each other's memory.

    The ranks exchange the numbers of splats that each sends to each other, and the host waits for these
    numbers. Then splats are packed by rank, sent, and unpacked. Gradients return in the same way; their owner
    adds them up in the order of the ranks, so the sum does not depend on which rank was faster. The position
    of each splat among those sent to a rank is stored in 8 bytes per 32 splats, and is used again to return
    the gradients.
    """

    def __init__(self, ranks: Ranks, half: bool = False) -> None:
        """Send splats between `ranks`; with `half`, in half precision by a `HalfCodec`."""
        self.capacity = CapacityEstimate()
        self._ranks, self._codec = ranks, HalfCodec() if half else None

    def project_and_send(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        attempt: Attempt,
        mark: Mark = unmarked,
    ) -> CollectiveExchange:
        """See `Transport.project_and_send`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        return CollectiveExchange(self._ranks, self._codec, inputs, assignment, attempt, mark)


class CollectiveExchange:
    """See `Exchange`."""

    def __init__(
        self,
        ranks: Ranks,
        codec: HalfCodec | None,
        inputs: ProjectionInputs,
        assignment: TileAssignment,
        attempt: Attempt,
        mark: Mark,
    ) -> None:
        """Project, exchange the numbers of splats, and send the splats."""
        sizes, tiles, n_views = attempt.sizes, assignment.composited_by_rank, assignment.ranges.n_views
        # Without sizes the projection waits for the device, which may still wait for other ranks.
        with ranks.watchdog.waiting("project"):
            projected = inputs.run(sizes, tiles)
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
        if sizes is not None and not sizes.holds(needed[:2]):
            projected = inputs.run(None, tiles)  # no queued work waits for another rank now
        # All ranks decide the same, because they have estimated the same number of blocks.
        attempt.end(needed, sizes is None or needed.blocks <= sizes.blocks)
        mark("project")
        projected = projected.first(needed)
        own, sent = projected.splats, projected.for_compositing
        shape = (sent.conics, sent.opacities, sent.colors)
        columns = [sent.means2d, sent.depths, sent.camera_ids, sent.ids]
        columns += [codec.encode(*shape)] if codec is not None else shape
        packed, places = scatter_splats(columns, own.rank_masks, traffic.sent)
        rows = packed.view(-1, sum(map(words_per_splat, columns)))
        arrived = ranks.all_to_all(rows, traffic.sent, traffic.received)
        means2d, depths, camera_ids, ids, *rest = gather_splats(arrived.view(-1), columns, traffic.received)
        conics, opacities, colors = rest if codec is None else codec.decode(rest[0], means2d.dtype)
        splats = Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)
        self.gradient_table: Tensor | None = None
        # After rounding, splats may touch a few more tiles.
        self.arrived = Arrived(splats, None, traffic.n_isects if codec is None else -1)
        self._result: ExchangeResult | None = None
        if attempt.fits:
            way_back = CollectiveWayBack(ranks, traffic, places, half=codec is not None)
            self._result = ExchangeResult(own, splats, visible, traffic, way_back)
        mark("exchange")

    def finish(self) -> ExchangeResult | None:
        """See `Exchange.finish`; the host has known all numbers since the splats were sent."""
        return self._result


class HalfCodec:
    """Encodes splats in half precision, for slow links.

    Conics (as Cholesky factors, which stay positive definite), opacities and colours are sent in float16, and
    gradients in bfloat16; positions and depths are not rounded. A splat with three colours then takes 40
    bytes instead of 52, and its gradient 20 instead of 36. The tiles that a splat touches are found before it
    is rounded. If rounding moves its border into a further tile, it is missing there, where its alpha is
    about 1/255.
    """

    def encode(self, conics: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        """Return the values to send, float16 [P, 4 + D]."""
        a, b, c = conics.double().unbind(1)
        l11 = a.sqrt()
        l21 = b / l11
        l22 = (c - l21 * l21).clamp(min=0).sqrt()
        factors = torch.stack((l11, l21, l22), 1).to(conics.dtype)
        return torch.cat((factors, opacities[:, None], colors), 1).half()

    def decode(self, halves: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """Return conics, opacities and colours; the same bits on every rank."""
        values = halves.to(dtype)
        l11, l21, l22 = values[:, :3].unbind(1)
        conics = torch.stack((l11 * l11, l11 * l21, l21 * l21 + l22 * l22), 1)
        return conics, values[:, 3].contiguous(), values[:, 4:].contiguous()
