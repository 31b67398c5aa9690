# SPDX-License-Identifier: Apache-2.0
"""Computes, for each point, its cell in a regular grid as one sortable integer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def voxel_keys(points: Tensor, origin: Sequence[float], voxel_size: float) -> Tensor:
    """Return the voxel of each point: ``x | y << 21 | z << 42`` with ``floor((p - origin) / voxel_size)``.

    Cells are clamped to [0, 2^21); equal keys mean the same voxel.

    Args:
        points: positions [N, 3], float32 or float64, any unit.
        origin: lower corner of the grid, 3 values in the same unit.
        voxel_size: edge of a voxel in the same unit, > 0.

    Returns:
        int64 [N]; -1 for a point that is not finite.

    Raises:
        RuntimeError: wrong shape or dtype, or a voxel size that is not positive.
    """
    return torch.ops.blitzgs.voxel_keys(points, list(origin), voxel_size)
