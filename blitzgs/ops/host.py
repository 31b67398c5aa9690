# SPDX-License-Identifier: Apache-2.0
"""Copies small tensors to the host, for sizes that the host must know."""

from __future__ import annotations

from collections import defaultdict
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs._torch import current_stream_numbers


class PinnedNumbers(NamedTuple):
    """A piece of pinned memory of the host, into which the device writes numbers, with an event."""

    memory: Tensor  # [n] numbers
    written: torch.cuda.Event  # of one device; recorded by the user after the work that writes
    idle: list[PinnedNumbers]  # the pieces of this length, dtype and device that are not in use

    @classmethod
    def take(cls, n: int, dtype: torch.dtype, device: torch.device) -> PinnedNumbers:
        """Return memory for `n` numbers, idle memory if possible: pinning takes longer than a copy."""
        idle = _idle[n, dtype, device.index]
        try:
            return idle.pop()
        except IndexError:
            return cls(torch.empty(n, dtype=dtype, device="cpu", pin_memory=True), torch.cuda.Event(), idle)

    def give_back(self) -> None:
        """Let others use the memory: the host has waited for `written` and read the numbers."""
        self.idle.append(self)

    def abandon(self) -> None:
        """Keep the memory, which is not read any more, until the device has written it; does not wait."""
        _abandoned[id(self)] = self
        for key, pinned in list(_abandoned.items()):
            if pinned.written.query():
                _abandoned.pop(key, None)


# Idle memory by number of values, dtype and index of the device.
_idle: defaultdict[tuple[int, torch.dtype, int], list[PinnedNumbers]] = defaultdict(list)
# Memory that is not read any more, by its `id`, until the device has written it.
_abandoned: dict[int, PinnedNumbers] = {}


class HostCopy:
    """Copies a few numbers to the host while the device runs the work that is queued before `read`.

    On CUDA a kernel writes the numbers into pinned host memory, because an ordinary copy delays the stream by
    15 us (it waits for the copy engine).
    """

    def __init__(self, values: Tensor) -> None:
        """Start to copy `values`, int64 [n], to the host."""
        self._pinned: PinnedNumbers | None = None
        self._host = values
        if values.is_cuda:
            pinned = PinnedNumbers.take(values.shape[0], values.dtype, values.device)
            torch.ops.blitzgs.copy_to_host_(pinned.memory, values)
            pinned.written.record(current_stream(values.device))
            self._pinned = pinned

    def read(self) -> Tensor:
        """Wait for the copy and return the numbers as a CPU tensor."""
        if self._pinned is not None:
            pinned = self._pinned
            pinned.written.synchronize()
            self._host, self._pinned = pinned.memory.clone(), None
            pinned.give_back()
        return self._host

    def __del__(self) -> None:
        # The memory must exist until the kernel has written it. The host does not wait for that, because the
        # numbers may depend on a rank that has failed, and then never come.
        if self._pinned is not None:
            self._pinned.abandon()


def current_stream(device: torch.device) -> torch.cuda.Stream:
    """Return the current stream of a CUDA device.

    A step asks several times, and torch's own function makes a new object each time.
    """
    number = -1 if device.index is None else device.index  # -1: the current device
    return _stream(*current_stream_numbers(number))


@lru_cache(maxsize=64)
def _stream(stream_id: int, device_index: int, device_type: int) -> torch.cuda.Stream:
    """Return the object of a stream. It does not own the stream, so it can be stored."""
    return torch.cuda.Stream(stream_id=stream_id, device_index=device_index, device_type=device_type)


def to_device(values: Tensor, device: torch.device) -> Tensor:
    """Return a copy of a small CPU tensor on a device, without waiting for the device's earlier work."""
    return values.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else values.to(device)


def to_host(tensor: Tensor) -> Tensor:
    """Return a small tensor's values on the CPU; waits for the device that holds it."""
    if not tensor.is_cuda:
        return tensor.cpu()
    # Pinned: a copy to pageable memory passes through the driver's own buffer first.
    values = torch.empty(tensor.shape, dtype=tensor.dtype, device="cpu", pin_memory=True)
    values.copy_(tensor, non_blocking=True)
    current_stream(tensor.device).synchronize()
    return values
