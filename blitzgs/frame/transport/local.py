# SPDX-License-Identifier: Apache-2.0
"""The transport for one rank, which sends nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from blitzgs.frame.transport.protocol import Arrived, CapacityEstimate, ExchangeResult, Mark, unmarked
from blitzgs.ops.host import HostCopy
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectionInputs, Sizes

if TYPE_CHECKING:
    from blitzgs.frame.tiles import TileAssignment


class LocalTransport:
    """The transport for one rank; with an estimate, the host queues compositing before it waits."""

    def __init__(self, capacity: CapacityEstimate | None = None, exact: bool = False) -> None:
        """Use a capacity estimate; None: a new one without any sizes; or none at all if `exact`."""
        self.capacity = None if exact else capacity or CapacityEstimate()

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
        totals: `ProjectionOutputs.totals`; None until the host has waited for them.
    """

    def __init__(self, inputs: ProjectionInputs, sizes: Sizes | None, mark: Mark) -> None:
        """Project."""
        # On the CPU the sizes are known at once, so no estimate is needed.
        self._capacity = sizes if inputs.gaussians[0].is_cuda else None
        self.projected = projected = inputs.run(self._capacity)
        self.gradient_table: Tensor | None = None
        splats, host = projected.for_compositing, projected.totals
        self._copy = HostCopy(host) if host.is_cuda else None
        self.totals: list[int] | None = None
        mark("project")
        if self._capacity is None:
            self._host = host if self._copy is None else self._copy.read()
            self.totals = self._host.tolist()
            self.arrived = Arrived(splats, None, self.totals[2])
        else:
            self.arrived = Arrived(splats, projected.n_splats, self._capacity.isects)
        mark("exchange")

    def finish(self) -> tuple[Sizes, ExchangeResult | None]:
        """See `Exchange.finish`."""
        if self.totals is None:
            assert self._copy is not None
            self._host = self._copy.read()
            self.totals = self._host.tolist()
        needed, projected = Sizes(*self.totals[:VIEW_TOTALS]), self.projected
        if self._capacity is not None and not self._capacity.holds(needed):
            return needed, None  # the splats are undefined
        counts, visible = self._host[:3], projected.totals[VIEW_TOTALS:]
        if self._capacity is None:
            splats = projected.splats._replace(counts=counts)
            return needed, ExchangeResult(splats, self.arrived.splats, visible, None, None)
        own = projected.first(needed, counts)
        return needed, ExchangeResult(own.splats, own.for_compositing, visible, None, None)
