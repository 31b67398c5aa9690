# SPDX-License-Identifier: Apache-2.0
"""What a transport does: it brings splats to the ranks that composite them, and their gradients back.

Every rank projects the Gaussians it owns. Each splat (a Gaussian in a view) then has to reach the ranks that
composite tiles which it touches, and its gradient has to return (paper §3.1). The calls of one frame, on
every rank::

    exchange = transport.start(inputs, assignment, attempt, mark)  # project; send splats to where they go
    exchange.arrived, exchange.gradient_table                      # for compositing
    counts = exchange.finish()                                     # None: there was too little room
    counts.way_back.expect_gradients()                             # before the backward pass of compositing
    gradients = counts.way_back.return_gradients(gradients)        # those of this rank's own splats

The last two may be repeated. One file has each transport: `local`, `collective`, `peer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from blitzgs.distributed.ownership import TileAssignment
from blitzgs.ops.capacity import Attempt, CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, ProjectedSplats, ProjectionInputs, Splats
from blitzgs.ops.splat_gradients import SplatGradients

# Is told the end of each stage of a step, for those who measure.
Mark = Callable[[str], None]


def unmarked(stage: str) -> None:
    """Take no note of the end of a stage."""


@dataclass(frozen=True)
class Traffic:
    """How many splats go where, over all ranks.

    Attributes:
        counts: int64 [3] on the CPU: this rank's visible Gaussians, splats and tiles they touch.
        splats: splats[s][d] that rank s sends to rank d.
        sent: splats for each rank.
        received: splats from each rank.
        starts: where this rank's splats begin among those that each rank receives.
        most: most splats that any rank has, sends or gets.
        n_isects: tile entries of the splats received, or a few more.
        most_isects: the most that any rank has of these.
        most_blocks: the most blocks of which some view may see a part that any rank has.
    """

    counts: Tensor
    splats: list[list[int]]
    sent: list[int]
    received: list[int]
    starts: list[int]
    most: int
    n_isects: int
    most_isects: int
    most_blocks: int

    @classmethod
    def of(cls, totals: Sequence[Sequence[int]], n_views: int, rank: int) -> Traffic:
        """Read it from every rank's `Projected.totals`."""
        first = VIEW_TOTALS + n_views
        splats = [list(numbers[first::2]) for numbers in totals]
        most = max(*(n[1] for n in totals), *map(sum, splats), *map(sum, zip(*splats, strict=True)))
        isects = [sum(column) for column in zip(*(n[first + 1 :: 2] for n in totals), strict=True)]
        return cls(
            counts=torch.tensor(totals[rank][:3]),
            splats=splats,
            sent=splats[rank],
            received=[sent[rank] for sent in splats],
            starts=[sum(column[:rank]) for column in zip(*splats, strict=True)],
            most=most,
            n_isects=isects[rank],
            most_isects=max(isects),
            most_blocks=max(numbers[VIEW_TOTALS - 1] for numbers in totals),
        )

    @property
    def needed(self) -> Sizes:
        """The room that every rank has to have, where they must agree on it."""
        return Sizes(self.most, self.most, self.most_isects, self.most_blocks)


class Arrived(NamedTuple):
    """The splats that this rank composites.

    Attributes:
        splats: with room behind them where their number is not known on the host yet.
        n_splats: int64 [1], their number, on the device; None: there is no room behind them.
        n_isects: how many tile entries there are at most, or may be listed; -1: they have to be counted.
    """

    splats: Splats
    n_splats: Tensor | None
    n_isects: int


class HostCounts(NamedTuple):
    """What the host knows of an exchange in the end.

    Attributes:
        projected: this rank's own splats, no more than there are.
        splats: what this rank composites, no more than there are.
        visible: int64 [B], splats of each view over all ranks; valid until the next exchange.
        traffic: what went where; None: there is one rank.
        way_back: of the gradients; None: they are where they belong, because there is one rank.
    """

    projected: ProjectedSplats
    splats: Splats
    visible: Tensor
    traffic: Traffic | None
    way_back: WayBack | None


class Exchange(Protocol):
    """One frame's splats on their way to the ranks that composite them.

    Attributes:
        arrived: what this rank composites.
        gradient_table: memory, [R, 12], that compositing has to zero for the gradients of what arrived; None:
            any memory will do.
    """

    arrived: Arrived
    gradient_table: Tensor | None

    def finish(self) -> HostCounts | None:
        """Wait for the numbers and end the attempt.

        Returns:
            None where there was too little room: the frame has to be started again.
        """


class WayBack(Protocol):
    """Returns what compositing finds out about the splats of one frame to their owners."""

    def expect_gradients(self) -> None:
        """Check that gradients of this frame can still be returned.

        Raises:
            RuntimeError: a later frame has taken the place of this one's splats.
        """

    def cleared_table(self) -> Tensor | None:
        """Return `gradient_table` for another backward pass, zeros, once no rank reads it. Collective."""

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """Return the gradients of this rank's own splats. Collective.

        Args:
            gradients: of the splats that arrived; in `gradient_table` where there is one.
        """

    def return_sums(self, sums: Tensor) -> Tensor:
        """Return integer sums over the tiles of each rank to the splats' owners, and add them up. Collective.

        Args:
            sums: int64 [R, C], of the splats that arrived here.

        Returns:
            int64 [P, C], of this rank's own splats; zero for splats that touch no tile. The total depends on
            nothing but the splats, as integers add up exactly.
        """


class Transport(Protocol):
    """Brings the splats of many frames, one after the other.

    Attributes:
        capacity: an estimate of what a frame needs; the same on all ranks where they have to agree on it.
    """

    capacity: CapacityEstimate

    def start(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        attempt: Attempt,
        mark: Mark = unmarked,
    ) -> Exchange:
        """Project this rank's Gaussians and bring the splats to where they are composited. Collective.

        Args:
            inputs: what is projected; with the Gaussians' ids.
            assignment: who composites which tiles; None: this rank alone.
            attempt: how much to make room for; without sizes the host waits for the numbers first.
            mark: called at the end of the stages "project" and "exchange".
        """
