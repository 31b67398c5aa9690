# SPDX-License-Identifier: Apache-2.0
"""Test doubles: a transport that records its calls, shared memory for a single rank, and what a GPU does."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.distributed.shared_memory import Shared
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.protocol import (
    CapacityEstimate,
    Exchange,
    ExchangeResult,
    Mark,
    Transport,
    unmarked,
)
from blitzgs.ops.projection_types import ProjectionInputs, Sizes


class RecordingTransport:
    """Wraps a transport; its first exchanges fail as if the capacity were too small.

    Attributes:
        calls: "start", with its capacity, and "finish", in order.
    """

    def __init__(
        self, inner: Transport, too_small: int = 0, capacity: CapacityEstimate | None = None
    ) -> None:
        """Wrap a transport; its first `too_small` exchanges do not finish."""
        self.capacity = capacity or inner.capacity
        self.inner, self.too_small = inner, too_small
        self.calls: list[tuple[str, Sizes | None]] = []

    def project_and_send(
        self,
        inputs: ProjectionInputs,
        assignment: TileAssignment | None,
        sizes: Sizes | None,
        mark: Mark = unmarked,
    ) -> RecordingExchange:
        """See `Transport.project_and_send`."""
        self.calls.append(("start", sizes))
        return RecordingExchange(self, self.inner.project_and_send(inputs, assignment, sizes, mark))


class RecordingExchange:
    """An exchange of a `RecordingTransport`."""

    def __init__(self, transport: RecordingTransport, inner: Exchange) -> None:
        """Wrap an exchange."""
        self._transport, self._inner = transport, inner
        self.arrived, self.gradient_table = inner.arrived, inner.gradient_table

    def finish(self) -> tuple[Sizes, ExchangeResult | None]:
        """See `Exchange.finish`."""
        self._transport.calls.append(("finish", None))
        needed, result = self._inner.finish()
        if self._transport.too_small > 0:
            self._transport.too_small -= 1
            return needed, None
        return needed, result


class LoneMemory:
    """A `SharedMemory` of a single rank, on any device, for tests of transports that need one."""

    def __init__(self, words: int) -> None:
        """Begin with a buffer of this number of words."""
        self.buffers = [torch.full((words,), -1, dtype=torch.int32)]
        self.generation = 0

    def barrier(self) -> None:
        """Return at once: there is no other rank."""

    def share(self, values: Tensor) -> Shared:
        """Return the rank's own numbers."""
        return Shared(values[None], values, values[None])

    def reserve(self, words: int) -> None:
        """Enlarge the buffer."""
        self.buffers = [torch.full((words,), -1, dtype=torch.int32)]


class IdleEvent:
    """Replaces `torch.cuda.Event` on a CPU, where nothing is pending."""

    def record(self, stream: object = None) -> None:
        """Return at once."""

    def synchronize(self) -> None:
        """Return at once."""


def rasterize_into(*arguments):
    """Replaces `rasterize_fwd_` on a CPU."""
    *rest, table, n_splats = arguments
    table[: int(n_splats)] = 0
    return torch.ops.blitzgs.rasterize_fwd(*rest, False, False, n_splats)[:6]
