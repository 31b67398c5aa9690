# SPDX-License-Identifier: Apache-2.0
"""Reading small tensors on the host, where a size has to be known."""

from __future__ import annotations

import torch
from torch import Tensor


def to_host(tensor: Tensor) -> Tensor:
    """Return a small tensor's values on the CPU; waits for the device that holds it.

    On CUDA through pinned memory: a copy to pageable memory passes through the driver's own buffer first.
    """
    if not tensor.is_cuda or torch.compiler.is_compiling():
        return tensor.cpu()
    values = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    values.copy_(tensor, non_blocking=True)
    torch.cuda.current_stream(tensor.device).synchronize()
    return values
