# SPDX-License-Identifier: Apache-2.0
"""Doubles for tests: a transport that tells its calls, and memory that one rank shares with itself."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from blitzgs.distributed.ownership import TileAssignment
from blitzgs.distributed.shared_memory import Shared
from blitzgs.distributed.transport.base import Arrived, Exchange, HostCounts, Transport
from blitzgs.ops.capacity import CapacityEstimate, Sizes
from blitzgs.ops.projection import ProjectionInputs
from blitzgs.ops.splat_gradients import SplatGradients


class RecordingTransport(Transport):
    """Another transport whose first exchanges find that there was too little room.

    Attributes:
        calls: the names of the calls, in order, those of exchanges included; "start" with its capacity.
    """

    def __init__(
        self, inner: Transport, too_small: int = 0, capacity: CapacityEstimate | None = None
    ) -> None:
        """Wrap a transport; its first `too_small` exchanges do not finish."""
        super().__init__(capacity or inner.capacity)
        self.inner, self.too_small = inner, too_small
        self.calls: list[tuple[str, Sizes | None]] = []

    def start(
        self, inputs: ProjectionInputs, assignment: TileAssignment | None, capacity: Sizes | None
    ) -> Exchange:
        """See `Transport.start`."""
        self.calls.append(("start", capacity))
        return _RecordingExchange(self, self.inner.start(inputs, assignment, capacity))


class _RecordingExchange(Exchange):
    def __init__(self, transport: RecordingTransport, inner: Exchange) -> None:
        super().__init__()
        self._transport, self._inner = transport, inner

    def _note(self, call: str) -> None:
        self._transport.calls.append((call, None))

    def _receive(self) -> Arrived:
        self._note("receive")
        return self._inner.receive()

    def _gradient_table(self) -> Tensor | None:
        return self._inner.gradient_table()

    def _finish(self) -> HostCounts | None:
        self._note("finish")
        counts = self._inner.finish()
        self.needed = self._inner.needed
        if self._transport.too_small > 0:
            self._transport.too_small -= 1
            return None
        return counts

    def _check_current(self) -> None:
        self._inner.expect_gradients()

    def _cleared_table(self) -> Tensor:
        return self._inner.cleared_table()

    def _return_gradients(self, parts: Sequence[Tensor]) -> SplatGradients:
        self._note("return_gradients")
        return self._inner.return_gradients(parts)

    def _return_sums(self, sums: Tensor) -> Tensor:
        return self._inner.return_sums(sums)

    def close(self) -> None:
        """See `Exchange.close`."""
        self._inner.close()


class LoneMemory:
    """What `SharedMemory` is to a single rank, on any device: for tests of transports that use one.

    Attributes:
        barriers: how many there were, those with numbers included.
    """

    def __init__(self, words: int) -> None:
        """Begin with a buffer of so many words."""
        self.buffers = [torch.full((words,), -1, dtype=torch.int32)]
        self.generation = self.barriers = 0

    def barrier(self) -> None:
        """Count it."""
        self.barriers += 1

    def share(self, values: Tensor) -> Shared:
        """Return the rank's own numbers."""
        self.barriers += 1
        return Shared(values[None], values, values[None])

    def reserve(self, words: int) -> None:
        """Enlarge the buffer."""
        self.buffers = [torch.full((words,), -1, dtype=torch.int32)]
