# SPDX-License-Identifier: Apache-2.0
"""Reading small tensors on the host, where a size has to be known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@contextmanager
def tell_host(values: Tensor) -> Iterator[Callable[[], Tensor]]:
    """Give a function that waits for a few numbers and returns them on the CPU.

    What is queued before it is called runs meanwhile. On CUDA a kernel writes the numbers into the host's
    memory: a copy would make the stream wait for the copying engine, 15 us. That memory has to live until
    then, so leaving waits too.

    Args:
        values: int64 [n].
    """
    if not values.is_cuda:
        yield lambda: values
        return
    known = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    torch.ops.blitzgs.tell_host_(known, values)
    told = torch.cuda.Event()
    told.record(torch.cuda.current_stream(values.device))

    def wait() -> Tensor:
        told.synchronize()
        return known

    try:
        yield wait
    finally:
        told.synchronize()


@torch.library.register_fake("blitzgs::tell_host_")
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
