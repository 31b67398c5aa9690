# SPDX-License-Identifier: Apache-2.0
"""The transport for one rank, which sends nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from blitzgs.frame.capacity import CapacityEstimate
from blitzgs.frame.transport.protocol import Arrived, ExchangeResult, Mark, unmarked
from blitzgs.ops.host import HostCopy
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Sizes

if TYPE_CHECKING:
    from blitzgs.frame.tiles import TileAssignment


class LocalTransport:
    """The transport for one rank; with an estimate, the host queues compositing before it waits."""

    def __init__(self, capacity: CapacityEstimate | None = None) -> None:
        """Use a capacity estimate; None: a new one without any sizes."""
        self.capacity = capacity or CapacityEstimate()

    def project_and_send(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        sizes: Sizes | None,
        mark: Mark = unmarked,
    ) -> LocalExchange:
        """See `Transport.project_and_send`."""
        if assignment is not None:
            raise ValueError("a local transport serves one rank, which composites all tiles")
        return LocalExchange(inputs, sizes, mark)


class LocalExchange:
    """See `Exchange`.

    Attributes:
        projected: the projection, of which `arrived` has the columns that compositing reads.
    """

    def __init__(self, inputs: ProjectionInputs, sizes: Sizes | None, mark: Mark) -> None:
        """Project."""
        # On the CPU the sizes are known at once, so no estimate is needed.
        self._capacity = sizes if inputs.gaussians[0].is_cuda else None
        self.projected = projected = inputs.run(self._capacity)
        self._n_views = inputs.n_views
        self._totals: list[int] | None = None
        splats = projected.for_compositing
        self._copy = HostCopy(projected.totals)
        mark("project")
        if self._capacity is None:
            self.arrived = Arrived(splats, None, self.totals()[2])
        else:
            self.arrived = Arrived(splats, projected.n_splats, self._capacity.isects)
        self.gradient_table: Tensor | None = None
        mark("exchange")

    def totals(self) -> list[int]:
        """Wait for `ProjectionOutputs.totals`."""
        if self._totals is None:
            self._totals = self._copy.read().tolist()
        return self._totals

    def finish(self) -> tuple[Sizes, ExchangeResult | None]:
        """See `Exchange.finish`."""
        needed = Sizes(*self.totals()[:VIEW_TOTALS])
        if self._capacity is not None and not self._capacity.holds(needed):
            return needed, None  # the splats are undefined
        own = self.projected.first(needed, self._copy.read()[:3])
        composited = self.arrived.splats if self._capacity is None else own.for_compositing
        visible = own.totals[VIEW_TOTALS : VIEW_TOTALS + self._n_views]
        return needed, ExchangeResult(own.splats, composited, visible, None, None)
