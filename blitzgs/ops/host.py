# SPDX-License-Identifier: Apache-2.0
"""Reading small tensors on the host, where a size has to be known."""

from __future__ import annotations

import torch
from torch import Tensor


def start_copy(tensor: Tensor) -> Tensor:
    """Return a tensor on the CPU that holds a small one's values once the current stream was waited for.

    On CUDA in pinned memory: a copy to pageable memory passes through the driver's own buffer first.
    """
    if not tensor.is_cuda:
        return tensor
    values = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    return values.copy_(tensor, non_blocking=True)


def to_host(tensor: Tensor) -> Tensor:
    """Return a small tensor's values on the CPU; waits for the device that holds it."""
    if not tensor.is_cuda:
        return tensor.cpu()
    values = start_copy(tensor)
    torch.cuda.current_stream(tensor.device).synchronize()
    return values
