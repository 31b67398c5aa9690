# SPDX-License-Identifier: Apache-2.0
"""Candidates of densification and their features, from which the spawn gate predicts survival (BlitzGS)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable

# In the order of the columns of `spawn_features`. The first eight are the paper's.
FEATURES = (
    "gradient",
    "parent_opacity",
    "parent_scale",
    "parent_age",
    "views",
    "level",
    "time",
    "is_split",
    "parent_color_gradient",
    "parent_flatness",
)


@dataclass(frozen=True)
class Candidates:
    """The candidates of one density event on this rank, M of them.

    Attributes:
        parents: int64 [M], persistent ids of the Gaussians to be cloned or split.
        is_split: bool [M], whether the candidate is split; false: cloned.
        features: float32 [M, F], see `FEATURES`.
        time: time of the event, in images.
    """

    parents: Tensor
    is_split: Tensor
    features: Tensor
    time: int


# A veto returns which candidates are withheld, bool [M]; every rank calls it, also without candidates.
Veto = Callable[[Candidates, Ranks], Tensor]


@torch.no_grad()
def spawn_features(
    table: GaussianTable,
    rows: Tensor,
    is_split: Tensor,
    time: int,
    extent: float,
    level_count: int,
) -> Tensor:
    """Return the features of candidates at a density event, before its statistics are reset.

    Args:
        table: this rank's Gaussians, without pending optimiser steps.
        rows: int64 [M], rows of the candidates' parents.
        is_split: bool [M], whether the candidate is split; false: cloned.
        time: time of the event, in images.
        extent: extent of the scene, in the unit of the means.
        level_count: number of octree levels.

    Returns:
        float32 [M, 10]: mean gradient over the views that saw the parent (half-image units), the parent's
        opacity, the mean of its three scales relative to extent, its age in images, the number of these
        views, the child's octree level (the parent's, one more for a split), the time, and whether it is a
        split. These eight are the paper's. Then the root of Adam's mean squared gradient of the parent's
        colour, which grows with the parent's weight in the images, and the ratio of the parent's smallest to
        its largest scale.
    """
    views = table["grad_count"][rows]
    level = table["level"][rows].int()
    scales = table["scales"][rows].double()
    # In float64, so that the rounded result does not depend on how the maths library vectorises.
    columns = (
        table["grad_sum"][rows] / views.clamp(min=1),
        table["opacities"][rows].double().sigmoid(),
        scales.exp().mean(1) / extent,
        time - table["birth"][rows],
        views,
        torch.where(is_split, (level + 1).clamp(max=level_count - 1), level),
        torch.full_like(views, time),
        is_split,
        table["exp_avg_sq.sh"][rows, 0].double().mean(1).sqrt(),
        (scales.amin(1) - scales.amax(1)).exp(),
    )
    return torch.stack([column.float() for column in columns], 1)
