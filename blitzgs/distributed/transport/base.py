# SPDX-License-Identifier: Apache-2.0
"""What all transports have in common: the phases of an exchange, and what travels.

Every rank projects the Gaussians it owns. Each splat (a Gaussian in a view) then has to reach the ranks that
composite tiles which it touches, and its gradient has to return (paper §3.1). The calls of one frame, on
every rank::

    exchange = transport.start(inputs, assignment, capacity)   # project; agree on which splat goes where
    arrived = exchange.receive()                               # what this rank composites
    table = exchange.gradient_table()                          # where compositing is to zero gradients
    counts = exchange.finish()                                 # None: there was too little room
    exchange.expect_gradients()                                # before the backward pass of compositing
    gradients = exchange.return_gradients(parts)               # those of this rank's own splats

The last two may be repeated. Leaving an exchange (it is a context manager) waits for what the device still
writes into memory that belongs to it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.ownership import TileAssignment
from blitzgs.ops.capacity import CapacityEstimate, Sizes
from blitzgs.ops.projection import VIEW_TOTALS, ProjectedSplats, ProjectionInputs
from blitzgs.ops.splat_gradients import SplatGradients


class Splats(NamedTuple):
    """Projected Gaussians as compositing sees them; P splats.

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

    @classmethod
    def of(cls, splats: ProjectedSplats, ids: Tensor) -> Splats:
        """Return what is composited of projected splats with these ids."""
        return cls(
            splats.means2d,
            splats.conics,
            splats.opacities,
            splats.colors,
            splats.depths,
            splats.camera_ids,
            ids,
        )

    def first(self, count: int) -> Splats:
        """Return the first `count` of them."""
        return Splats(*(column[:count] for column in self))


@dataclass(frozen=True)
class Traffic:
    """How many splats go where, over all ranks.

    Attributes:
        counts: int64 [3] on the CPU: this rank's visible Gaussians, splats and tiles they touch.
        splats: splats[s][d] that rank s sends to rank d.
        rank: this rank.
        most: most splats that any rank has, sends or gets.
        n_isects: tile entries of the splats received, or a few more.
        most_isects: the most that any rank has of these.
        most_blocks: the most blocks of which some view may see a part that any rank has.
    """

    counts: Tensor
    splats: list[list[int]]
    rank: int
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
        blocks = max(numbers[VIEW_TOTALS - 1] for numbers in totals)
        return cls(torch.tensor(totals[rank][:3]), splats, rank, most, isects[rank], max(isects), blocks)

    @property
    def sent(self) -> list[int]:
        """Splats for each rank."""
        return self.splats[self.rank]

    @property
    def received(self) -> list[int]:
        """Splats from each rank."""
        return [row[self.rank] for row in self.splats]

    @property
    def starts(self) -> list[int]:
        """Where this rank's splats begin among those that each rank receives."""
        return [sum(column[: self.rank]) for column in zip(*self.splats, strict=True)]


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
        projected: this rank's own, no more than there are.
        splats: what this rank composites, no more than there are.
        visible: int64 [B], splats of each view over all ranks; valid until the next exchange.
        traffic: what went where; None: there is one rank.
    """

    projected: ProjectedSplats
    splats: Splats
    visible: Tensor
    traffic: Traffic | None


class Phase(IntEnum):
    """How far an exchange is."""

    STARTED = 0
    RECEIVED = 1
    FINISHED = 2
    CLOSED = 3


class Exchange(ABC):
    """One frame's splats. The methods are called in the order of `Phase`; see the module.

    Attributes:
        needed: the sizes that the frame needs; there once `finish` was called.
    """

    needed: Sizes

    def __init__(self) -> None:
        """Begin."""
        self._phase = Phase.STARTED

    def receive(self) -> Arrived:
        """Return the splats that this rank composites. Collective."""
        self._advance(Phase.STARTED, Phase.RECEIVED, "receive")
        return self._receive()

    def gradient_table(self) -> Tensor | None:
        """Return the memory, [R, 12], that compositing has to zero for the gradients of what arrived.

        None: any memory will do.
        """
        self._require(Phase.RECEIVED, "gradient_table")
        return self._gradient_table()

    def finish(self) -> HostCounts | None:
        """Wait for the numbers.

        Returns:
            None where there was too little room: the frame has to be started again, with room for `needed`.
        """
        self._advance(Phase.RECEIVED, Phase.FINISHED, "finish")
        return self._finish()

    def expect_gradients(self) -> None:
        """Check that gradients of this frame can still be returned.

        Raises:
            RuntimeError: a later frame has taken the place of this one's splats.
        """
        self._require(Phase.FINISHED, "expect_gradients")
        self._check_current()

    def cleared_table(self) -> Tensor:
        """Return `gradient_table` for another backward pass, zeros, once no rank reads it. Collective."""
        self._require(Phase.FINISHED, "cleared_table")
        return self._cleared_table()

    def return_gradients(self, parts: Sequence[Tensor]) -> SplatGradients:
        """Return the gradients of this rank's own splats. Collective.

        Args:
            parts: gradients of the splats that arrived, as in `SplatGradients`; in `gradient_table` where
                there is one.
        """
        self._require(Phase.FINISHED, "return_gradients")
        return self._return_gradients(parts)

    def return_sums(self, sums: Tensor) -> Tensor:
        """Return integer sums over the tiles of each rank to the splats' owners, and add them up. Collective.

        Args:
            sums: int64 [R, C], of the splats that arrived here.

        Returns:
            int64 [P, C], of this rank's own splats; zero for splats that touch no tile. The total depends on
            nothing but the splats, as integers add up exactly.
        """
        self._require(Phase.FINISHED, "return_sums")
        return self._return_sums(sums)

    def close(self) -> None:
        """Wait for what the device still writes into memory of this exchange. Safe to call twice."""
        return None  # a transport that has such memory overrides this

    def __enter__(self) -> Exchange:
        return self

    def __exit__(self, *_: object) -> None:
        if self._phase != Phase.FINISHED:
            self._phase = Phase.CLOSED
        self.close()

    def _require(self, phase: Phase, call: str) -> None:
        if self._phase != phase:
            raise RuntimeError(
                f"{call}() needs an exchange that is {phase.name}, this one is {self._phase.name}"
            )

    def _advance(self, before: Phase, after: Phase, call: str) -> None:
        self._require(before, call)
        self._phase = after

    @abstractmethod
    def _receive(self) -> Arrived: ...

    @abstractmethod
    def _finish(self) -> HostCounts | None: ...

    @abstractmethod
    def _return_gradients(self, parts: Sequence[Tensor]) -> SplatGradients: ...

    @abstractmethod
    def _return_sums(self, sums: Tensor) -> Tensor: ...

    def _gradient_table(self) -> Tensor | None:
        return None

    def _cleared_table(self) -> Tensor:
        raise RuntimeError("this transport has no gradient table of its own")

    def _check_current(self) -> None:
        return None


class Transport(ABC):
    """Brings the splats of many frames, one after the other.

    Attributes:
        capacity: an estimate of what a frame needs; the same on all ranks where they have to agree on it.
    """

    def __init__(self, capacity: CapacityEstimate | None = None) -> None:
        """Take an estimate, or begin with one that knows nothing."""
        self.capacity = capacity or CapacityEstimate()

    @abstractmethod
    def start(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """Project this rank's Gaussians and, on several ranks, agree on which splat goes where. Collective.

        Args:
            inputs: what is projected; with the Gaussians' ids.
            assignment: who composites which tiles; None: this rank alone.
            capacity: how much to make room for; None: the host waits for the numbers first.
        """
