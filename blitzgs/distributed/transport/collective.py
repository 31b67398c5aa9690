# SPDX-License-Identifier: Apache-2.0
"""Sends splats, and returns their gradients, by an all-to-all of NCCL or Gloo."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.tiles import TileAssignment
from blitzgs.distributed.transport.protocol import Arrived, HostCounts, Mark, Traffic, unmarked
from blitzgs.ops.capacity import Attempt, CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, ProjectionInputs, Splats, splats_of
from blitzgs.ops.scatter import (
    RUN,
    as_column,
    gather_splats,
    scatter_splats,
    sum_splats,
    words_of,
    words_per_splat,
)
from blitzgs.ops.splat_gradients import SplatGradients


class CollectiveTransport:
    """The transport for ranks that do not reach each other's memory.

    The ranks show each other how many splats each has for whom; the host waits for these numbers. Splats are
    then packed by rank, carried, and unpacked; their gradients likewise. They are added up at the owner in
    the order of ranks, so that the sum does not depend on which was faster. The places of splats among those
    of a rank are kept in 8 bytes per 32 splats, and serve the way back too.
    """

    def __init__(self, ranks: Ranks, half: bool = False) -> None:
        """Serve `ranks`; with `half`, send splats through a `HalfCodec`."""
        self.capacity = CapacityEstimate()
        self._ranks, self._codec = ranks, HalfCodec() if half else None

    def start(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        attempt: Attempt,
        mark: Mark = unmarked,
    ) -> CollectiveExchange:
        """See `Transport.start`."""
        if assignment is None:
            raise ValueError("several ranks need an assignment of tiles")
        return CollectiveExchange(self._ranks, self._codec, inputs, assignment, attempt, mark)


class CollectiveExchange:
    """See `Exchange` and `WayBack`."""

    def __init__(
        self,
        ranks: Ranks,
        codec: HalfCodec | None,
        inputs: ProjectionInputs,
        assignment: TileAssignment,
        attempt: Attempt,
        mark: Mark,
    ) -> None:
        """Project, show the other ranks how many splats there are for whom, and carry the splats."""
        self._ranks, self._codec, self._attempt = ranks, codec, attempt
        tiles, n_views = assignment.all_composited, assignment.ranges.n_views
        # Waiting may mean to wait for other ranks, whose collectives are queued before.
        projected = ranks.reading(partial(inputs.run, attempt.sizes, tiles))
        everyone = ranks.share(projected.totals)
        self._visible = everyone[:, VIEW_TOTALS : VIEW_TOTALS + n_views].sum(0)
        self._traffic = traffic = Traffic.of(ranks.read(everyone), n_views, ranks.rank)
        sizes, needed = attempt.sizes, Sizes._make((*traffic.counts.tolist(), traffic.most_blocks))
        if sizes is not None and not sizes.holds(needed[:2]):
            projected = ranks.reading(partial(inputs.run, None, tiles))
        # All ranks decide the same, because they have estimated the same number of blocks.
        attempt.end(needed, sizes is None or needed.blocks <= sizes.blocks)
        mark("project")
        self._own = splats_of(projected.splats[:12], traffic.counts)
        own = projected.composited.first(len(self._own.camera_ids))
        shape = (own.conics, own.opacities, own.colors)
        columns = [own.means2d, own.depths, own.camera_ids, own.ids]
        columns += [codec.encode(*shape)] if codec is not None else shape
        packed, self._places = scatter_splats(columns, self._own.rank_masks, traffic.sent)
        rows = packed.view(-1, sum(map(words_per_splat, columns)))
        arrived = ranks.all_to_all(rows, traffic.sent, traffic.received)
        means2d, depths, camera_ids, ids, *rest = gather_splats(arrived.view(-1), columns, traffic.received)
        conics, opacities, colors = rest if codec is None else codec.decode(rest[0], means2d.dtype)
        splats = Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)
        self.gradient_table: Tensor | None = None
        # After rounding, splats may touch a few more tiles.
        self.arrived = Arrived(splats, None, traffic.n_isects if codec is None else -1)
        mark("exchange")

    def finish(self) -> HostCounts | None:
        """See `Exchange.finish`."""
        if not self._attempt.fits:
            return None
        return HostCounts(self._own, self.arrived.splats, self._visible, self._traffic, self)

    def check_still_valid(self) -> None:
        """Nothing of a frame is overwritten by the next one."""

    def cleared_table(self) -> None:
        """Return None: any memory can be used."""

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`."""
        rows, widths = gradients.side_by_side()
        sent, received = self._traffic.sent, self._traffic.received
        if self._codec is None:
            returned = self._ranks.all_to_all(rows, received, sent)
        else:
            # Gradients span too many magnitudes for float16.
            halves = rows.bfloat16()
            carried = self._ranks.all_to_all(words_of(halves), received, sent)
            returned = as_column(carried, halves).to(rows.dtype)
        sums = sum_splats(returned, self._places, sent, len(self._own.camera_ids), widths)
        return gradients.of_sums(sums)

    def return_sums(self, sums: Tensor) -> Tensor:
        """See `WayBack.return_sums`."""
        return exchange_sums(sums, self._places, self._traffic, len(self._own.camera_ids), self._ranks)


def exchange_sums(sums: Tensor, places: Tensor, traffic: Traffic, splats: int, ranks: Ranks) -> Tensor:
    """Carry integer sums of splats to their owners by a collective: `WayBack.return_sums`.

    Args:
        sums: int64 [R, C], of the splats that arrived here.
        places: of this rank's splats, as `scatter_splats` returns them.
        traffic: what went where.
        splats: P.
        ranks: the job.
    """
    returned = ranks.all_to_all(sums, traffic.received, traffic.sent)
    total = sums.new_zeros(splats, sums.shape[1])
    lanes = torch.arange(RUN, device=sums.device)
    for group, runs in zip(returned.split(traffic.sent), places.unbind(1), strict=True):
        # The splats of a run lie together: the first one's place, and which of them are there (csrc/scatter).
        here = runs[:, None] >> (32 + lanes) & 1
        at = (runs[:, None] & 0xFFFFFFFF) + here.cumsum(1) - here
        which = here.flatten().nonzero().squeeze(1)
        total.index_add_(0, which, group[at.flatten()[which]])
    return total


class HalfCodec:
    """Splats in half precision, for slow links.

    Conics (as Cholesky factors, which stay positive definite), opacities and colours travel in float16, and
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
        """Return conics, opacities and colours; the same bits wherever it is called."""
        values = halves.to(dtype)
        l11, l21, l22 = values[:, :3].unbind(1)
        conics = torch.stack((l11 * l11, l11 * l21, l21 * l21 + l22 * l22), 1)
        return conics, values[:, 3].contiguous(), values[:, 4:].contiguous()
