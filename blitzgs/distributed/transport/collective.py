# SPDX-License-Identifier: Apache-2.0
"""Splats carried by an all-to-all of NCCL or Gloo, and their gradients by another."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TileAssignment
from blitzgs.distributed.transport.protocol import Arrived, HostCounts, Mark, Traffic, unmarked
from blitzgs.ops.capacity import Attempt, CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, Projected, ProjectionInputs, Splats, splats_of
from blitzgs.ops.scatter import (
    RUN,
    as_column,
    gather_splats,
    scatter_splats,
    sum_splats,
    words_of,
    words_per_splat,
)
from blitzgs.ops.splat_gradients import SplatGradients, columns_of


class CollectiveTransport:
    """For ranks that do not reach each other's memory.

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
        ranks, tiles = self._ranks, assignment.all_composited
        # Waiting may mean to wait for other ranks, whose collectives are queued before.
        projected = ranks.reading(partial(inputs.run, attempt.sizes, tiles))
        everyone = ranks.share(projected.totals)
        visible = everyone[:, VIEW_TOTALS : VIEW_TOTALS + inputs.n_views].sum(0)
        traffic = Traffic.of(ranks.read(everyone), inputs.n_views, ranks.rank)
        room, needed = attempt.sizes, Sizes._make((*traffic.counts.tolist(), traffic.most_blocks))
        if room is not None and not room.holds(needed[:2]):
            projected = ranks.reading(partial(inputs.run, None, tiles))
        # All ranks find the same, as they have estimated the same number of blocks.
        attempt.end(needed, room is None or needed.blocks <= room.blocks)
        mark("project")
        exchange = CollectiveExchange(ranks, self._codec, projected, traffic, visible, attempt)
        mark("exchange")
        return exchange


class CollectiveExchange:
    """See `Exchange` and `WayBack`."""

    def __init__(
        self,
        ranks: Ranks,
        codec: HalfCodec | None,
        projected: Projected,
        traffic: Traffic,
        visible: Tensor,
        attempt: Attempt,
    ) -> None:
        """Carry the splats."""
        self._ranks, self._codec, self._traffic, self._visible = ranks, codec, traffic, visible
        self._attempt = attempt
        self._own = splats_of(projected.splats[:12], traffic.counts)
        own = projected.composited.first(len(self._own.camera_ids))
        shape = (own.conics, own.opacities, own.colors)
        columns = [own.means2d, own.depths, own.camera_ids, own.ids]
        columns += [codec.encode(*shape)] if codec is not None else shape
        sent, received = traffic.sent, traffic.received
        packed, self._places = scatter_splats(columns, self._own.rank_masks, sent)
        words = sum(map(words_per_splat, columns))
        arrived = ranks.all_to_all(packed, [words * n for n in sent], [words * n for n in received])
        means2d, depths, camera_ids, ids, *rest = gather_splats(arrived, columns, received)
        conics, opacities, colors = rest if codec is None else codec.decode(rest[0], means2d.dtype)
        splats = Splats(means2d, conics, opacities, colors, depths, camera_ids, ids)
        self.gradient_table: Tensor | None = None
        # Rounding may let splats touch some tiles more.
        self.arrived = Arrived(splats, None, traffic.n_isects if codec is None else -1)

    def finish(self) -> HostCounts | None:
        """See `Exchange.finish`."""
        if not self._attempt.fits:
            return None
        return HostCounts(self._own, self.arrived.splats, self._visible, self._traffic, self)

    def expect_gradients(self) -> None:
        """Nothing of a frame is overwritten by the next one."""

    def cleared_table(self) -> None:
        """Any memory will do."""

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`."""
        columns, absolute = [*columns_of(gradients.parts)], gradients.means2d_abs
        columns += [] if absolute is None else [absolute]
        flat = [g.reshape(len(g), math.prod(g.shape[1:])) for g in columns]
        widths, dtype = [g.shape[1] for g in flat], flat[0].dtype
        sent, received = self._traffic.sent, self._traffic.received
        if self._codec is None:
            returned = self._ranks.all_to_all(torch.cat(flat, 1), received, sent).view(-1, sum(widths))
        else:
            # Gradients span too many magnitudes for float16.
            halves = torch.cat(flat, 1).bfloat16()
            carried = self._ranks.all_to_all(words_of(halves), received, sent)
            returned = as_column(carried, halves).to(dtype)
        sums = sum_splats(returned, self._places, sent, len(self._own.camera_ids), widths)
        parts = [s.reshape(-1, *g.shape[1:]) for s, g in zip(sums, columns, strict=True)]
        return SplatGradients(parts[:4], None, None if absolute is None else parts[4])

    def return_sums(self, sums: Tensor) -> Tensor:
        """See `WayBack.return_sums`."""
        return carry_sums(sums, self._places, self._traffic, len(self._own.camera_ids), self._ranks)


def carry_sums(sums: Tensor, places: Tensor, traffic: Traffic, splats: int, ranks: Ranks) -> Tensor:
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
    gradients in bfloat16; positions and depths stay as they are. A splat of three colours then takes 40 bytes
    instead of 52 one way, and 20 instead of 36 back. The tiles that a splat touches are found before it is
    rounded: one whose border moves over that of a tile may be missing there, where its alpha is about 1/255.
    """

    def encode(self, conics: Tensor, opacities: Tensor, colors: Tensor) -> Tensor:
        """Return what is sent for them, float16 [P, 4 + D]."""
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
