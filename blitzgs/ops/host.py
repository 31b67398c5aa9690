# SPDX-License-Identifier: Apache-2.0
"""Copies small tensors to the host, for sizes that the host must know."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


class HostCopy:
    """Copies a few numbers to the host while the device runs the work that is queued before `read`.

    On CUDA a kernel writes the numbers into pinned host memory, because an ordinary copy delays the stream by
    15 us (it waits for the copy engine). The memory must exist until the kernel has written it, so deleting a
    copy that was not read waits for the kernel too.
    """

    def __init__(self, values: Tensor) -> None:
        """Start to copy `values`, int64 [n], to the host."""
        self._written: torch.cuda.Event | None = None
        self._host = values
        if values.is_cuda:
            self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            torch.ops.blitzgs.copy_to_host_(self._host, values)
            self._written = torch.cuda.Event()
            self._written.record(current_stream(values.device))

    def read(self) -> Tensor:
        """Wait for the copy and return the numbers as a CPU tensor."""
        if self._written is not None:
            self._written.synchronize()
            self._written = None
        return self._host

    def __del__(self) -> None:
        self.read()


@torch.library.register_fake("blitzgs::copy_to_host_")
def _(*_args: object) -> None:
    return None


def current_stream(device: torch.device) -> torch.cuda.Stream:
    """Return the current stream of a CUDA device.

    By the number of the device: torch looks up other forms in Python, which takes longer than the rest of the
    call, and a step asks several times.
    """
    return torch.cuda.current_stream(device.index)


def to_host(tensor: Tensor) -> Tensor:
    """Return a small tensor's values on the CPU; waits for the device that holds it."""
    if not tensor.is_cuda:
        return tensor.cpu()
    # Pinned: a copy to pageable memory passes through the driver's own buffer first.
    values = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)
    torch.cuda.current_stream(tensor.device).synchronize()
    return values
