# SPDX-License-Identifier: Apache-2.0
"""Which splats a pixel shows, from the weights alpha T of all splats at all pixels."""

from __future__ import annotations

import torch
from torch import Tensor


def median_splats(weights: Tensor) -> Tensor:
    """Return the last splat composited with a transmittance above 0.5 in front of it, int64 [H, W]; -1: none.

    Args:
        weights: alpha T of M splats, front to back, [M, H, W], zero where a splat is not composited.
    """
    before = 1 - (weights.cumsum(dim=0) - weights)
    numbers = torch.arange(len(weights))[:, None, None].expand_as(weights)
    return torch.where((weights > 0) & (before > 0.5), numbers, -1).amax(dim=0)


def strongest_splats(weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the splats of the largest weights, front to back, int64 [H, W, count], and their weights.

    Of equal weights, the splats in front. Padded with -1 and 0.

    Args:
        weights: as for `median_splats`.
        count: number of splats of a pixel.
    """
    weights = torch.cat([weights, weights.new_zeros(count, *weights.shape[1:])])
    largest = weights.argsort(dim=0, descending=True, stable=True)[:count].sort(dim=0).values
    kept = weights.gather(0, largest)
    ids = torch.where(kept > 0, largest, -1)
    # Splats without weight may stand between others: move them behind.
    order = (ids < 0).long().argsort(dim=0, stable=True)
    return ids.gather(0, order).movedim(0, -1), kept.gather(0, order).movedim(0, -1)
