# SPDX-License-Identifier: Apache-2.0
"""Returns the gradients of splats from the ranks that composited them to the ranks that own them.

See `WayBack` for the interface. The transports `collective` and `peer` make these objects when a frame's
splats have been sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.shared_memory import SharedMemory
from blitzgs.frame.transport.protocol import Traffic
from blitzgs.ops.exchange import RUN
from blitzgs.ops.splat_gradients import SplatGradients


class CollectiveWayBack(NamedTuple):
    """Returns gradients by an all-to-all, and adds them up at the owner in the order of ranks.

    Attributes:
        ranks: the job.
        traffic: numbers of splats sent between the ranks.
        places: positions of this rank's own splats among those that it sent, from `scatter_splats`.
    """

    ranks: Ranks
    traffic: Traffic
    places: Tensor

    def check_still_valid(self) -> None:
        """Do nothing, because a frame does not overwrite the data of an earlier one."""

    def cleared_table(self) -> None:
        """Return None: any memory can be used."""

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`."""
        columns, traffic = gradients.side_by_side(), self.traffic
        returned = self.ranks.all_to_all(columns, traffic.received, traffic.sent)
        return gradients.sum_returned(returned, self.places, traffic.sent, traffic.own.splats)

    def return_sums(self, sums: Tensor) -> Tensor:
        """See `WayBack.return_sums`."""
        return _return_sums(sums, self.places, self.traffic, self.ranks)


class PeerWayBack(NamedTuple):
    """Lets owners read gradients in the memory of the ranks that added them up.

    Attributes:
        ranks: the job.
        memory: the memory that the ranks share.
        generation: number of the frame, `SharedMemory.generation`.
        tables: table of splat gradients of each rank, float32 [length, 12], mapped here.
        traffic: numbers of splats sent between the ranks.
        places: positions of this rank's own splats among those that it sent, as from `scatter_splats`.
    """

    ranks: Ranks
    memory: SharedMemory
    generation: int
    tables: Sequence[Tensor]
    traffic: Traffic
    places: Tensor

    def check_still_valid(self) -> None:
        """See `WayBack.check_still_valid`."""
        if self.generation != self.memory.generation:
            raise RuntimeError(
                "a later exchange has overwritten this one's splats: run the backward pass of a frame before "
                "the next forward pass"
            )

    def cleared_table(self) -> Tensor:
        """See `WayBack.cleared_table`."""
        self.memory.barrier()
        return self.tables[self.ranks.rank][: sum(self.traffic.received)].zero_()

    def return_gradients(self, gradients: SplatGradients) -> SplatGradients:
        """See `WayBack.return_gradients`; the result refers to the tables, in which the owner reads."""
        self.memory.barrier()  # C
        mine = zip(self.tables, self.traffic.starts, self.traffic.sent, strict=True)
        return SplatGradients([table[start : start + n] for table, start, n in mine], self.places)

    def return_sums(self, sums: Tensor) -> Tensor:
        """See `WayBack.return_sums`."""
        return _return_sums(sums, self.places, self.traffic, self.ranks)


def _return_sums(sums: Tensor, places: Tensor, traffic: Traffic, ranks: Ranks) -> Tensor:
    """Send integer sums of splats to their owners and add them up; see `WayBack.return_sums`.

    Args:
        sums: int64 [R, C], sums of the splats that arrived here.
        places: positions of this rank's own splats among those that it sent.
        traffic: numbers of splats sent between the ranks.
        ranks: the job.
    """
    returned = ranks.all_to_all(sums, traffic.received, traffic.sent)
    total = sums.new_zeros(traffic.own.splats, sums.shape[1])
    lanes = torch.arange(RUN, device=sums.device)
    for group, runs in zip(returned.split(traffic.sent), places.unbind(1), strict=True):
        if group.shape[0] == 0:
            continue
        # The splats of a run are consecutive. `runs` has the position of the first one, and bits that tell
        # which splats of the run were sent (csrc/scatter).
        here = runs[:, None] >> (32 + lanes) & 1
        at = (runs[:, None] & 0xFFFFFFFF) + here.cumsum(1) - here
        # Splats that were not sent take any row, times zero: leaving them out would need their number, for
        # which the host would wait.
        rows = group[at.flatten()[: total.shape[0]].clamp(max=group.shape[0] - 1)]
        total += rows * here.flatten()[: total.shape[0], None]
    return total
