# SPDX-License-Identifier: Apache-2.0
"""The interface of transports, which send splats to ranks, and the transport for one rank.

Every rank projects the Gaussians that it owns. Each splat (a Gaussian in a view) is then sent to the ranks
that composite tiles which it touches, and its gradient is returned (BlitzGS, section 3.1). The calls of one
frame, on every rank:

    exchange = transport.project_and_send(inputs, assignment, capacity)
    exchange.arrived, exchange.gradient_table, ...           # for compositing
    needed, result = exchange.finish()                       # result None: the capacity was too small
    result.way_back.check_still_valid()                      # before the backward pass of compositing
    gradients = result.way_back.return_gradients(gradients)  # gradients of this rank's own splats

`blitzgs.frame.render` makes the first three, and the last two may be repeated. `collective` and `peer` have
the other transports.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from blitzgs.ops.exchange import PLACE_SPLATS
from blitzgs.ops.host import HostCopy
from blitzgs.ops.project import queue_projection
from blitzgs.ops.projection_types import (
    VIEW_TOTALS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOutputs,
    Sizes,
    Splats,
)

if TYPE_CHECKING:
    from blitzgs.distributed.group import Ranks
    from blitzgs.frame.tiles import TileAssignment
    from blitzgs.ops.rasterize import SplatGradients


_listener: Callable[[str], object] | None = None


@contextlib.contextmanager
def stages_told_to(listener: Callable[[str], object]) -> Iterator[None]:
    """Call `listener` with the name of each stage of a step at its end, in this context; for benchmarks."""
    global _listener
    _listener = listener
    try:
        yield
    finally:
        _listener = None


def stage_ended(stage: str) -> None:
    """Tell the listener, if there is one, that the host has queued a stage of a step."""
    if _listener is not None:
        _listener(stage)


class Traffic(NamedTuple):
    """The numbers of splats that the ranks send each other."""

    own: Sizes  # numbers of this rank's visible Gaussians, splats, tiles that they touch, and blocks
    splats: list[list[int]]  # splats[s][d] is the number of splats that rank s sends to rank d
    sent: list[int]  # number of splats sent to each rank
    received: list[int]  # number of splats received from each rank
    starts: list[int]  # for each rank, the position of this rank's first splat in what that receives
    most: int  # largest number of splats that any rank has, sends or receives
    n_isects: int  # upper bound of the tile entries of the splats received
    most_isects: int  # largest `n_isects` of any rank
    most_blocks: int  # largest number of blocks of which a view may see a part, of any rank

    @classmethod
    def of(cls, totals: list[list[int]], n_views: int, rank: int) -> Traffic:
        """Read the numbers from every rank's `ProjectionOutputs.totals`."""
        first = VIEW_TOTALS + n_views
        columns = list(zip(*totals, strict=True))  # columns[i][s] is number i of rank s
        _, owned, _, blocks = columns[:VIEW_TOTALS]  # as in `Sizes`
        received = columns[first::2]  # by each rank, from each rank
        isects = [sum(column) for column in columns[first + 1 :: 2]]
        splats = [numbers[first::2] for numbers in totals]
        return cls(
            own=Sizes(*totals[rank][:VIEW_TOTALS]),
            splats=splats,
            sent=splats[rank],
            received=list(received[rank]),
            starts=[sum(column[:rank]) for column in received],
            most=max(*owned, *map(sum, splats), *map(sum, received)),
            n_isects=isects[rank],
            most_isects=max(isects),
            most_blocks=max(blocks),
        )

    @property
    def needed(self) -> Sizes:
        """The sizes that every rank must allocate, for transports that need equal sizes on all ranks."""
        return Sizes(self.most, self.most, self.most_isects, self.most_blocks)


class ExchangeResult(NamedTuple):
    """The splats after an exchange, cut to their numbers, which the host knows by now."""

    projected: ProjectedSplats  # this rank's own splats, only valid ones
    splats: Splats  # the splats that this rank composites, only valid ones
    totals: list[int]  # this rank's `ProjectionOutputs.totals`
    visible: Tensor  # int64 [B], splats of each view over all ranks; valid until the next exchange
    way_back: WayBack | None  # returns the gradients; None: there is one rank, which has them already


class Exchange(NamedTuple):
    """The exchange of one frame's splats: queued work, whose sizes the host may not know until `finish`."""

    projected: ProjectionOutputs  # this rank's own splats, with spare capacity if the host does not know more
    arrived: Splats  # splats to composite; too long while the host does not know their number
    n_splats: Tensor | None  # int64 [1], number of valid splats, on the device; None: all are valid
    n_isects: int  # upper bound of the tile entries, or capacity for them; -1: they must be counted
    # Memory, [R, 12], in which the gradients of these splats must be added up, because other ranks read them
    # there; compositing must zero it. None: any memory can be used.
    gradient_table: Tensor | None
    # Waits for the numbers. Returns the sizes that the frame needs, from which `Transport.estimate` learns;
    # and the result, None if the capacity was too small and the frame must be started again.
    finish: Callable[[], tuple[Sizes, ExchangeResult | None]]


@dataclass(frozen=True)
class WayBack:
    """Returns gradients and sums of one frame's splats to the owners of their Gaussians, by an all-to-all.

    The owners add them up in the order of the ranks.
    """

    ranks: Ranks
    traffic: Traffic  # numbers of splats sent between the ranks
    places: Tensor  # positions of this rank's own splats among those that it sent, from `scatter_splats`

    def check_still_valid(self) -> None:
        """Check that no later frame has overwritten this one's splats (RuntimeError: ranks share memory)."""

    def cleared_table(self) -> Tensor | None:
        """Zero `gradient_table` for another backward pass, when no rank reads it any more. Collective.

        Returns None if there is none, so that any memory can be used.
        """
        return None

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """Return the gradients of this rank's own splats. Collective.

        `gradients`: gradients of the splats that arrived, in `gradient_table` if there is one.
        """
        columns, traffic = gradients.side_by_side(), self.traffic
        returned = self.ranks.all_to_all(columns, traffic.received, traffic.sent)
        return gradients.sum_returned(returned.split(traffic.sent), self.places, traffic.own.splats)

    def return_sums(self, sums: Tensor) -> Tensor:
        """Return integer sums over the tiles of each rank to the splats' owners, and add them up. Collective.

        `sums`: int64 [R, C], of the splats that arrived here. Returns int64 [P, C], of this rank's own
        splats; zero for splats that touch no tile. Integers add up exactly, whatever the number of ranks.
        """
        traffic = self.traffic
        returned = self.ranks.all_to_all(sums, traffic.received, traffic.sent)
        total = sums.new_zeros(traffic.own.splats, sums.shape[1])
        lanes = torch.arange(PLACE_SPLATS, device=sums.device)
        for group, runs in zip(returned.split(traffic.sent), self.places.unbind(1), strict=True):
            if group.shape[0] == 0:
                continue
            # The splats of a run are consecutive. `runs` has the position of the first one, and bits that
            # tell which splats of the run were sent (csrc/exchange/scatter.h).
            here = runs[:, None] >> (32 + lanes) & 1
            at = (runs[:, None] & 0xFFFFFFFF) + here.cumsum(1) - here
            # Splats that were not sent take any row, times zero: leaving them out would need their number,
            # for which the host would wait.
            rows = group[at.flatten()[: total.shape[0]].clamp(max=group.shape[0] - 1)]
            total += rows * here.flatten()[: total.shape[0], None]
        return total


class Transport(Protocol):
    """Sends the splats of many frames, one after the other."""

    @property
    def estimate(self) -> CapacityEstimate | None:
        """Estimate of a frame's sizes, the same on ranks that need equal sizes; None: each frame waits."""

    def project_and_send(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """Project this rank's Gaussians and send the splats to the ranks that composite them. Collective.

        `inputs`: with the Gaussians' ids. `assignment`: the tiles of each rank; None: this rank composites
        all. `capacity`: the sizes to allocate; None: the host first waits for the numbers.
        """


class CapacityEstimate:
    """Estimates the sizes that the next frame needs from the largest recent ones. Threads may share it.

    The host queues all work with the estimate and reads the true sizes while the device works; if it was too
    small, the host queues the work again (`blitzgs.frame.render`).
    """

    def __init__(self, sizes: Sizes | None = None) -> None:
        """Begin with an estimate, or with none; without one the first attempt waits for its sizes."""
        # The present estimate; None before the first frame has ended.
        self.sizes = None if sizes is None else Sizes._make(max(1, size) for size in sizes)
        self._lock = threading.Lock()

    def learn(self, needed: Sequence[int]) -> None:
        """Update the estimate with the sizes that a frame needed."""
        with self._lock:
            before = self.sizes or Sizes(0, 0, 0)
            # Views differ, so the estimate exceeds the largest recent size, and it shrinks slowly.
            both = zip(Sizes(*needed), before, strict=True)
            self.sizes = Sizes(*[max(1, n * 9 // 8, size - size // 256) for n, size in both])


class LocalTransport:
    """The transport for one rank; with an estimate, the host queues compositing before it waits."""

    def __init__(self, estimate: CapacityEstimate | None = None, exact: bool = False) -> None:
        """Use an estimate; None: a new one without any sizes; or none at all if `exact`."""
        self.estimate = None if exact else estimate or CapacityEstimate()

    def project_and_send(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.project_and_send`."""
        if assignment is not None:
            raise ValueError("a local transport serves one rank, which composites all tiles")
        if not inputs.gaussians[0].is_cuda:
            capacity = None  # on the CPU the sizes are known at once
        projected = queue_projection(inputs, capacity)
        splats, copy = projected.for_compositing, HostCopy(projected.totals)
        stage_ended("project")
        known: list[int] = [] if capacity is not None else copy.read().tolist()
        n_splats = None if capacity is None else projected.n_splats
        n_isects = known[2] if capacity is None else capacity.isects
        stage_ended("exchange")

        def finish() -> tuple[Sizes, ExchangeResult | None]:
            on_host = copy.read()
            totals = known or on_host.tolist()
            needed, counts = Sizes(*totals[:VIEW_TOTALS]), on_host[:3]
            if capacity is None:
                own, composited = projected.splats._replace(counts=counts), splats
            elif capacity.holds(needed):
                cut = projected.first(needed, counts)
                own, composited = cut.splats, cut.for_compositing
            else:
                return needed, None  # the splats are undefined
            visible = projected.totals[VIEW_TOTALS:]
            return needed, ExchangeResult(own, composited, totals, visible, None)

        return Exchange(projected, splats, n_splats, n_isects, None, finish)
