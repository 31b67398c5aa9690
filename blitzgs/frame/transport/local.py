# SPDX-License-Identifier: Apache-2.0
"""The transport for one rank, which sends nothing."""

from __future__ import annotations

from torch import Tensor

from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import Arrived, ExchangeResult, Mark, unmarked
from blitzgs.ops.capacity import Attempt, CapacityEstimate, Sizes
from blitzgs.ops.host import HostCopy
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs


class LocalTransport:
    """The transport for one rank; with an estimate, the host queues compositing before it waits."""

    def __init__(self, capacity: CapacityEstimate | None = None) -> None:
        """Use a capacity estimate; None: a new one without any sizes."""
        self.capacity = capacity or CapacityEstimate()

    def project_and_send(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        attempt: Attempt,
        mark: Mark = unmarked,
    ) -> LocalExchange:
        """See `Transport.project_and_send`."""
        if assignment is not None:
            raise ValueError("a local transport serves one rank, which composites all tiles")
        return LocalExchange(inputs, attempt, mark)


class LocalExchange:
    """See `Exchange`."""

    def __init__(self, inputs: ProjectionInputs, attempt: Attempt, mark: Mark) -> None:
        """Project."""
        # On the CPU the sizes are known at once, so no estimate is needed.
        self._attempt, self._capacity = attempt, attempt.sizes if inputs.gaussians[0].is_cuda else None
        self._projected = projected = inputs.run(self._capacity)
        self._visible = projected.totals[VIEW_TOTALS : VIEW_TOTALS + inputs.n_views]
        splats = projected.for_compositing
        self._copy = HostCopy(projected.totals)
        mark("project")
        if self._capacity is None:
            self.arrived = Arrived(splats, None, int(self._copy.read()[2]))
        else:
            self.arrived = Arrived(splats, projected.n_splats, self._capacity.isects)
        self.gradient_table: Tensor | None = None
        mark("exchange")

    def finish(self) -> ExchangeResult | None:
        """See `Exchange.finish`."""
        needed = Sizes(*self._copy.read()[:VIEW_TOTALS].tolist())
        fits = self._capacity is None or self._capacity.holds(needed)
        self._attempt.end(needed, fits)
        if not fits:
            return None  # the splats are undefined
        own = self._projected.first(needed)
        return ExchangeResult(own.splats, own.for_compositing, self._visible, None, None)
