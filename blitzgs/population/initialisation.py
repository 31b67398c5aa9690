# SPDX-License-Identifier: Apache-2.0
"""Makes the first Gaussians from voxels of the SfM cloud at several resolutions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from blitzgs.model import GaussianTable, opacity_logit
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.voxel_keys import voxel_keys
from blitzgs.view.levels import Levels

SH_C0 = 0.28209479177387814
# Smallest size of a first Gaussian, relative to the coarsest voxel: two voxel centres may coincide.
SMALLEST_SPACING = 1e-4
_CELL_BITS = 21


def octree_gaussians(
    points: Tensor,
    colors: Tensor,
    centres: Tensor,
    levels: Levels,
    *,
    visible_threshold: float,
    sh_degree: int,
    opacity: float,
) -> GaussianTable:
    """Make one Gaussian per occupied voxel of every level that enough cameras can resolve.

    Voxels of several sizes are those of Octree-GS (Ren et al. 2024); the size of a Gaussian is that of 3DGS
    (Kerbl et al. 2023).

    A Gaussian sits at its voxel's centre with the mean colour of the points inside, an identity rotation and
    the mean distance of its 3 nearest neighbours as its size on all axes. Ids count from 0.

    Args:
        points: SfM points, float64 [M, 3], on the CPU.
        colors: their colours, uint8 [M, 3].
        centres: camera centres, float64 [V, 3]; their device measures the distances.
        levels: from `measure_levels` on the same points and cameras.
        visible_threshold: a voxel is kept when its level is resolvable in more than this share of the
            cameras.
        sh_degree: highest degree of the table.
        opacity: initial opacity in (0, 1).

    Returns:
        A table on the CPU.

    Raises:
        ValueError: no voxel is left.
    """
    origin = _grid_origin(points, levels)
    parts = []
    for level in range(levels.count):
        means, mean_colors = _voxels(points, colors, origin, levels.voxel_size_of(level))
        keep = _share_of_cameras(means, centres, levels.farthest(level)) > visible_threshold
        parts.append(
            (means[keep], mean_colors[keep], torch.full((int(keep.sum()),), level, dtype=torch.uint8))
        )
    means, mean_colors, level_of = (torch.cat(column) for column in zip(*parts, strict=True))
    count = len(means)
    if count == 0:
        raise ValueError(
            f"the octree kept no voxel of {len(points)} points at lod.visible_threshold {visible_threshold}"
        )
    spacing = _spacing(means).clamp(min=SMALLEST_SPACING * levels.voxel_size)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = ((mean_colors / 255.0 - 0.5) / SH_C0).float()
    return GaussianTable.create(
        {
            "means": means.float(),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "scales": spacing.log().float()[:, None].repeat(1, 3),
            "opacities": torch.full((count,), opacity_logit(opacity)),
            "sh": sh,
            "level": level_of,
        }
    )


def _grid_origin(points: Tensor, levels: Levels) -> Tensor:
    """Return the lower corner of the grids: below all points, unless outliers overflow the finest grid."""
    reach = levels.voxel_size_of(levels.count - 1) * 2 ** (_CELL_BITS - 1)
    return torch.maximum(points.amin(dim=0), points.median(dim=0).values - reach)


def _voxels(points: Tensor, colors: Tensor, origin: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return centres and mean colours (0..255) of the occupied voxels, float64 [C, 3] each, in key order.

    Outliers beyond the grid are left out, because their clamped cells would be at another position.
    """
    inside = ((points >= origin) & (points < origin + size * 2**_CELL_BITS)).all(dim=1)
    keys, cell_of = voxel_keys(points[inside], origin.tolist(), size).unique(return_inverse=True)
    counts = torch.bincount(cell_of, minlength=len(keys)).double()
    sums = torch.zeros(len(keys), 3, dtype=torch.float64).index_add_(0, cell_of, colors[inside].double())
    mask = (1 << _CELL_BITS) - 1
    cells = torch.stack([keys >> (axis * _CELL_BITS) & mask for axis in range(3)], dim=1)
    return origin + (cells.double() + 0.5) * size, sums / counts[:, None]


def _share_of_cameras(means: Tensor, centres: Tensor, farthest: float) -> Tensor:
    """Return the share of the cameras within `farthest` of each mean, float64 [C]."""
    if math.isinf(farthest):
        return torch.ones(len(means), dtype=torch.float64)
    places = means.to(centres.device)
    near = torch.zeros(len(places), dtype=torch.int64, device=places.device)
    for centre in centres:
        near += (places - centre).norm(dim=1) <= farthest
    return near.cpu().double() / len(centres)


def _spacing(means: Tensor) -> Tensor:
    """Return the mean distance to the 3 nearest neighbours (or fewer, if there are fewer), float64 [C]."""
    neighbours = min(3, len(means) - 1)
    if neighbours == 0:
        return torch.ones(1, dtype=torch.float64)
    return knn_distances(means, neighbours).mean(dim=1)
