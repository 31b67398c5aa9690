# SPDX-License-Identifier: Apache-2.0
"""Finds floaters and the fringe of a model: Gaussians that hardly any photograph saw, away from the rest."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from blitzgs.ops.blocks import WORD_BITS
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.population import CELL_BITS, voxel_keys

# A Gaussian is large if so few of the well-seen ones are larger.
_LARGE = 0.99
# A Gaussian is far from the well-seen ones at this multiple of their distances to each other, of which so
# few are larger. The distance is that to three neighbours.
_FAR, _SPACING, _NEIGHBOURS = 4.0, 0.95, 3


def views_counting(cull: Tensor, n_views: int) -> Tensor:
    """Return in how many views each Gaussian counts, int32 [N], from the matrix of `Importance.cull`."""
    counted = torch.zeros(len(cull), dtype=torch.int32, device=cull.device)
    for column in range(n_views):
        counted += 1 - (cull[:, column // WORD_BITS] >> (column % WORD_BITS) & 1)
    return counted


def floaters(means: Tensor, scales: Tensor, counted: Tensor, most_views: int) -> Tensor:
    """Tell which Gaussians to remove, bool [N]: few views count them, and they are far or large.

    Small ones among Gaussians that more views count stay: they are details.

    Args:
        means: float32 [N, 3].
        scales: logarithms, float32 [N, 3], in the same unit.
        counted: number of training views that count each Gaussian, int [N].
        most_views: Gaussians that more views count stay.
    """
    weak = counted <= most_views
    sound = ~weak
    if int(sound.sum()) <= _NEIGHBOURS or not bool(weak.any()):
        return torch.zeros_like(weak)
    sizes = scales.amax(dim=1)
    remove = torch.zeros_like(weak)
    remove[weak] = sizes[weak] > _share(sizes[sound], _LARGE)
    remove[weak] |= _far(means[weak], means[sound])
    return remove


def _far(points: Tensor, others: Tensor) -> Tensor:
    """Tell which points have none of the others in their voxel or beside it, bool [P]."""
    spacing = knn_distances(others, _NEIGHBOURS).mean(dim=1)
    low, high = others.amin(dim=0), others.amax(dim=0)
    # The grid has to hold all others; points outside are clamped into its free margin.
    cell = max(_FAR * _share(spacing, _SPACING), float((high - low).max()) / (1 << (CELL_BITS - 1)), 1e-12)
    origin = (low - 3 * cell).tolist()
    taken = voxel_keys(others, origin, cell).unique()
    keys = voxel_keys(points, origin, cell)
    near = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for x, y, z in product((-1, 0, 1), repeat=3):
        near |= torch.isin(keys + x + (y << CELL_BITS) + (z << 2 * CELL_BITS), taken)
    return ~near


def _share(values: Tensor, share: float) -> float:
    """Return the value that this share of all does not exceed."""
    return float(values.kthvalue(max(1, int(share * len(values)))).values)
