# SPDX-License-Identifier: Apache-2.0
"""Computes exact distances from each point of a cloud to its k nearest other points."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def knn_distances(points: Tensor, k: int) -> Tensor:
    """Return the distances [N, k] of points [N, 3] to their k nearest others, 1 <= k <= 32: `blitzgs.knn`."""
    return torch.ops.blitzgs.knn_distances(points.detach(), k)
