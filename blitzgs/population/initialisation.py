# SPDX-License-Identifier: Apache-2.0
"""Makes the first Gaussians from voxels of the SfM cloud at several resolutions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.formats.gaussians import SH_C0
from blitzgs.ops.counter_random import uniform
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.population import CELL_BITS, voxel_keys
from blitzgs.table.table import GaussianTable, opacity_logit
from blitzgs.view.levels import BLOCK_POINTS, PAIRS_OF_POINTS, Levels, PointBlocks

# Smallest size of a first Gaussian, relative to the coarsest voxel: two voxel centres may coincide.
SMALLEST_SPACING = 1e-4
# Opacity of the initial Gaussians.
INITIAL_OPACITY = 0.1


@dataclass(frozen=True)
class FirstGaussians:
    """What distinguishes the first Gaussians of a model from each other."""

    means: Tensor  # float32 [C, 3]
    log_scales: Tensor  # float32 [C], the same on all axes
    colors: Tensor  # float32 [C, 3], their SH coefficients of degree 0
    levels: Tensor  # uint8 [C], octree levels
    found: int  # number of Gaussians before they were thinned to a limit

    def __len__(self) -> int:
        return len(self.means)

    def table(
        self,
        sh_degree: int,
        opacity: float,
        device: torch.device | str = "cpu",
        part: slice = slice(None),  # noqa: B008  (a slice cannot be changed)
    ) -> GaussianTable:
        """Make a table of them, without rotation; ids count from 0.

        `sh_degree`: highest degree of the table. `opacity`: of all of them, in (0, 1). `part`: which of them
        the table gets.
        """
        means = self.means[part].to(device)
        sh = torch.zeros(len(means), (sh_degree + 1) ** 2, 3, device=device)
        sh[:, 0] = self.colors[part].to(device)
        rows = {
            "means": means,
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(len(means), 1),
            "scales": self.log_scales[part].to(device)[:, None].repeat(1, 3),
            "opacities": torch.full((len(means),), opacity_logit(opacity), device=device),
            "sh": sh,
        }
        level, ids = self.levels[part].to(device), torch.arange(len(self))[part].to(device)
        return GaussianTable.create({**rows, "level": level, "id": ids})


def octree_gaussians(
    points: Tensor,
    colors: Tensor,
    centres: Tensor,
    levels: Levels,
    visible_threshold: float,
    most: int = 0,
    seed: int = 0,
) -> FirstGaussians:
    """Find one Gaussian per occupied voxel of every level that enough cameras can resolve.

    Voxels of several sizes are those of Octree-GS (Ren et al. 2024); the size of a Gaussian is that of 3DGS
    (Kerbl et al. 2023).

    A Gaussian sits at its voxel's centre with the mean colour of the points inside and the mean distance of
    its 3 nearest neighbours as its size.

    Args:
        points: SfM points, float64 [M, 3], on any device.
        colors: their colours, uint8 [M, 3].
        centres: camera centres, float64 [V, 3].
        levels: from `measure_levels` on the same points and cameras.
        visible_threshold: a voxel is kept when its level is resolvable in more than this share of the
            cameras.
        most: largest number of Gaussians. Whole levels are kept, from the coarsest on, and of the first level
            that does not fit a random part. 0: no limit.

    Raises:
        ValueError: no voxel is left.
    """
    # The lower corner of the grids: below all points, unless outliers overflow the finest grid.
    reach = levels.voxel_size_of(levels.count - 1) * 2 ** (CELL_BITS - 1)
    origin = torch.maximum(points.amin(dim=0), points.median(dim=0).values - reach)
    parts = []
    for level in range(levels.count):
        means, mean_colors = _voxels(points, colors, origin, levels.voxel_size_of(level))
        keep = _seen_by_more(means, centres, levels.farthest(level), visible_threshold)
        own = means[keep]
        level_of = torch.full((len(own),), level, dtype=torch.uint8, device=own.device)
        parts.append((own, mean_colors[keep], level_of))
    means, mean_colors, level_of = (torch.cat(column) for column in zip(*parts, strict=True))
    if len(means) == 0:
        raise ValueError(
            f"the octree kept no voxel of {len(points)} points at lod.visible_threshold {visible_threshold}"
        )
    found = len(means)
    if 0 < most < found:
        rows = _thinned(level_of, most, seed)
        means, mean_colors, level_of = means[rows], mean_colors[rows], level_of[rows]
    spacing = _spacing(means).clamp(min=SMALLEST_SPACING * levels.voxel_size)
    return FirstGaussians(
        means.float(), spacing.log().float(), ((mean_colors / 255.0 - 0.5) / SH_C0).float(), level_of, found
    )


def _thinned(levels: Tensor, most: int, seed: int) -> Tensor:
    """Return `most` rows, in order: those of the coarsest levels, and a random part of the next level."""
    draws = uniform(torch.arange(len(levels), device=levels.device), seed, 0, 0)
    order = torch.argsort(draws, stable=True)
    order = order[torch.argsort(levels[order].long(), stable=True)]
    return order[:most].sort().values


def _voxels(points: Tensor, colors: Tensor, origin: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return centres and mean colours (0..255) of the occupied voxels, float64 [C, 3] each, in key order.

    Outliers beyond the grid are left out, because their clamped cells would be at another position.
    """
    inside = ((points >= origin) & (points < origin + size * 2**CELL_BITS)).all(dim=1)
    keys, cell_of = voxel_keys(points[inside], origin.tolist(), size).unique(return_inverse=True)
    counts = torch.bincount(cell_of, minlength=len(keys)).double()
    # Sums of integers are exact, so that their order does not matter.
    sums = torch.zeros(len(keys), 3, dtype=torch.float64, device=points.device)
    sums.index_add_(0, cell_of, colors[inside].double())
    mask = (1 << CELL_BITS) - 1
    cells = torch.stack([keys >> (axis * CELL_BITS) & mask for axis in range(3)], dim=1)
    return origin + (cells.double() + 0.5) * size, sums / counts[:, None]


def _seen_by_more(means: Tensor, centres: Tensor, farthest: float, share: float) -> Tensor:
    """Tell which means have more than a share of the cameras within `farthest`, bool [C]."""
    if math.isinf(farthest) or len(means) == 0:
        return torch.full((len(means),), share < 1, device=means.device)
    blocks = PointBlocks.of(means)
    least, most = (torch.zeros(len(blocks), dtype=torch.int64, device=means.device) for _ in range(2))
    for _, nearest, greatest in blocks.distances(centres):
        least += (greatest <= farthest).sum(dim=0)
        most += (nearest <= farthest).sum(dim=0)

    def enough(count: Tensor) -> Tensor:
        return count.double() / len(centres) > share

    # Only the distances between these blocks and the cameras whose reach ends in them are needed.
    undecided = (enough(most) & ~enough(least)).nonzero().squeeze(1)
    near = least[:, None].repeat(1, BLOCK_POINTS)
    for some, nearest, greatest in blocks.distances(centres, undecided):
        pairs = ((nearest <= farthest) & (greatest > farthest)).nonzero()
        for cameras, chosen in (part.unbind(1) for part in pairs.split(PAIRS_OF_POINTS)):
            own = undecided[chosen]
            within = blocks.distances_of(some[cameras], own[:, None], math.inf)[:, 0] <= farthest
            near.index_add_(0, own, within.long())
    kept = torch.empty(len(means), dtype=torch.bool, device=means.device)
    kept[blocks.order] = enough(near).flatten()[: len(means)]
    return kept


def _spacing(means: Tensor) -> Tensor:
    """Return the mean distance to the 3 nearest neighbours (or fewer, if there are fewer), float64 [C]."""
    neighbours = min(3, len(means) - 1)
    if neighbours == 0:
        return torch.ones(1, dtype=torch.float64, device=means.device)
    # As the means are stored: the op has float64 on the CPU alone.
    return knn_distances(means.float(), neighbours).double().mean(dim=1)
