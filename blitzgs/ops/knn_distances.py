# SPDX-License-Identifier: Apache-2.0
"""Computes exact distances from each point of a cloud to its k nearest other points."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def knn_distances(points: Tensor, k: int) -> Tensor:
    """Return the distances of every point to its k nearest others, ascending.

    Exact for any distribution of the points; duplicates are at distance 0 of each other. Not
    differentiable.

    Args:
        points: [N, 3], float32 (CPU also float64), any unit.
        k: number of neighbours, 1 <= k <= 32.

    Returns:
        [N, k], dtype and unit of `points`; infinity for a row that is not finite and where fewer than k
        other finite points exist.

    Raises:
        RuntimeError: wrong shape or dtype, or k outside its range.
    """
    return torch.ops.blitzgs.knn_distances(points.detach(), k)
