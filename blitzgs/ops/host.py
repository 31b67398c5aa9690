# SPDX-License-Identifier: Apache-2.0
"""Reading small tensors on the host, where a size has to be known."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


class HostCopy:
    """A few numbers on their way to the host. What is queued before `read` runs meanwhile.

    On CUDA a kernel writes the numbers into the host's memory: a copy would make the stream wait for the
    copying engine, 15 us. That memory has to live until then, so whoever drops a copy unread waits too.
    """

    def __init__(self, values: Tensor) -> None:
        """Start to bring `values`, int64 [n], to the host."""
        self._written: torch.cuda.Event | None = None
        self._host = values
        if values.is_cuda:
            self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            torch.ops.blitzgs.copy_to_host_(self._host, values)
            self._written = torch.cuda.Event()
            self._written.record(torch.cuda.current_stream(values.device))

    def read(self) -> Tensor:
        """Wait for the numbers and return them, on the CPU."""
        if self._written is not None:
            self._written.synchronize()
            self._written = None
        return self._host

    def __del__(self) -> None:
        self.read()


@torch.library.register_fake("blitzgs::copy_to_host_")
def _(*_args: object) -> None:
    return None


def to_host(tensor: Tensor) -> Tensor:
    """Return a small tensor's values on the CPU; waits for the device that holds it."""
    if not tensor.is_cuda:
        return tensor.cpu()
    # Pinned: a copy to pageable memory passes through the driver's own buffer first.
    values = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)
    torch.cuda.current_stream(tensor.device).synchronize()
    return values
