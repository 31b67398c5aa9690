# SPDX-License-Identifier: Apache-2.0
"""Numbers that only the host reads, later: added up over the ranks without holding up the step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks


class HostSum:
    """The sum of a tensor over all ranks, on its way to the host. Collective.

    On CUDA everything happens on a stream beside the step's, after what was queued so far; only `read`
    waits. On the CPU the sum is there at once.
    """

    def __init__(self, make: Callable[[], Tensor], inputs: Sequence[Tensor], ranks: Ranks) -> None:
        """Start to add up.

        Args:
            make: computes this rank's summand, a new tensor on `ranks.device`, from `inputs`.
            inputs: what it reads; kept from being overwritten until then.
            ranks: the job.
        """
        self._ranks = ranks
        self._copied: torch.cuda.Event | None = None
        stream = ranks.side_stream()
        if stream is None:
            self._value = ranks.all_reduce(make())
            return
        stream.wait_stream(torch.cuda.current_stream(ranks.device))
        with torch.cuda.stream(stream):
            total = ranks.all_reduce(make())
            self._value = torch.empty(total.shape, dtype=total.dtype, pin_memory=True)
            self._value.copy_(total, non_blocking=True)
            self._copied = torch.cuda.Event()
            self._copied.record(stream)
        for tensor in inputs:
            tensor.record_stream(stream)

    def read(self) -> Tensor:
        """Return the sum, on the CPU, the same bits on every rank; waits for it the first time."""
        if self._copied is not None:
            self._ranks.wait(self._copied)
            self._copied = None
            self._value = self._value.clone()  # the pinned memory serves the next one
        return self._value
