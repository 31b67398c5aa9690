# SPDX-License-Identifier: Apache-2.0
"""Reading small tensors on the host, where a size has to be known."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@contextmanager
def tell_host(values: Tensor) -> Iterator[Tensor]:
    """Give a tensor on the CPU that holds a few numbers once the current stream was waited for.

    On CUDA a kernel writes them there: a copy would make the stream wait for the copying engine, 15 us. So
    the memory has to live until then: whoever uses this waits within it, and an exception does so too.

    Args:
        values: int64 [n].
    """
    if not values.is_cuda:
        yield values
        return
    known = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
    torch.ops.blitzgs.tell_host_(known, values)
    try:
        yield known
    except BaseException:
        torch.cuda.current_stream(values.device).synchronize()
        raise


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
