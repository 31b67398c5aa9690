# SPDX-License-Identifier: Apache-2.0
"""Computes, for each point, its cell in a regular grid as one sortable integer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

CELL_BITS = 21


def voxel_keys(points: Tensor, origin: Sequence[float], voxel_size: float) -> Tensor:
    """Return the voxel of each point: ``x | y << 21 | z << 42`` with ``floor((p - origin) / voxel_size)``.

    Cells are clamped to [0, 2^21); equal keys mean the same voxel.

    Args:
        points: positions [N, 3], any floating dtype and unit; the cells are computed in float64.
        origin: lower corner of the grid, 3 values in the same unit.
        voxel_size: edge of a voxel in the same unit, > 0.

    Returns:
        int64 [N]; -1 for a point that is not finite.
    """
    corner = torch.tensor(origin, dtype=torch.float64, device=points.device)
    cells = ((points.double() - corner) / voxel_size).floor().clamp(0, (1 << CELL_BITS) - 1)
    x, y, z = cells.long().unbind(1)
    keys = x | y << CELL_BITS | z << 2 * CELL_BITS
    return keys.where(points.isfinite().all(dim=1), -1)
