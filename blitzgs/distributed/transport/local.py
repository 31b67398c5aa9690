# SPDX-License-Identifier: Apache-2.0
"""One rank: the splats stay where they are."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from blitzgs.distributed.ownership import TileAssignment
from blitzgs.distributed.transport.base import Arrived, Exchange, HostCounts, Splats, Transport
from blitzgs.ops.capacity import Sizes
from blitzgs.ops.host import HostCopy
from blitzgs.ops.projection import VIEW_TOTALS, ProjectionInputs, splats_of
from blitzgs.ops.splat_gradients import SplatGradients


class LocalTransport(Transport):
    """For one rank. With an estimate, compositing is queued before the host knows the number of splats."""

    def start(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.start`."""
        if assignment is not None:
            raise ValueError("a local transport serves one rank, which composites all tiles")
        # On the CPU the numbers are there at once.
        return _LocalExchange(inputs, capacity if inputs.gaussians[0].is_cuda else None)


class _LocalExchange(Exchange):
    def __init__(self, inputs: ProjectionInputs, capacity: Sizes | None) -> None:
        super().__init__()
        self._capacity = capacity
        self._projected = inputs.run(capacity)
        self._copy = HostCopy(self._projected.totals)
        self._visible = self._projected.totals[VIEW_TOTALS : VIEW_TOTALS + inputs.n_views]

    def _receive(self) -> Arrived:
        splats = Splats.of(self._projected.splats, self._projected.ids)
        if self._capacity is None:
            return Arrived(splats, None, int(self._copy.read()[2]))
        return Arrived(splats, self._projected.totals[1:2], self._capacity.isects)

    def _finish(self) -> HostCounts | None:
        totals = self._copy.read()
        counts, self.needed = totals[:3], Sizes._make(totals[:VIEW_TOTALS].tolist())
        if self._capacity is not None and not self._capacity.holds(self.needed):
            return None
        splats = Splats.of(self._projected.splats, self._projected.ids).first(self.needed.splats)
        return HostCounts(splats_of(self._projected.splats[:12], counts), splats, self._visible, None)

    def _return_gradients(self, parts: Sequence[Tensor]) -> SplatGradients:
        return SplatGradients(parts)

    def _return_sums(self, sums: Tensor) -> Tensor:
        return sums

    def close(self) -> None:
        """See `Exchange.close`."""
        self._copy.read()
