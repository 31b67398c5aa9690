# SPDX-License-Identifier: Apache-2.0
"""Candidates of densification and their features, from which the spawn gate predicts survival (BlitzGS)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.distributed.group import Ranks
from blitzgs.table.table import GaussianTable

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
# The columns of a table that they are computed from.
_COLUMNS = ("grad_sum", "grad_count", "opacities", "scales", "birth", "level", "exp_avg_sq.sh")


@dataclass(frozen=True)
class Candidates:
    """The candidates of one density event on this rank, M of them."""

    parents: Tensor  # int64 [M], persistent ids of the Gaussians to be cloned or split
    is_split: Tensor  # bool [M], whether the candidate is split; false: cloned
    features: Tensor  # float32 [M, F], see `FEATURES`
    time: int  # time of the event, in images


# A veto returns which candidates are withheld, bool [M]; every rank calls it, also without candidates.
Veto = Callable[[Candidates, Ranks], Tensor]


def spawn_features(
    table: GaussianTable, rows: Tensor, is_split: Tensor, time: int, extent: float, level_count: int
) -> Tensor:
    """Return the features of candidates at a density event, before its statistics are reset.

    `table`: this rank's Gaussians, without pending optimiser steps. `rows`: int64 [M], the parents.
    `is_split`: bool [M], false: cloned. `time`: in images. `extent`: in the unit of the means.

    Returns float32 [M, 10]: mean gradient over the views that saw the parent (half-image units), the parent's
    opacity, the mean of its three scales relative to extent, its age in images, the number of these views,
    the child's octree level (the parent's, one more for a split), the time, and whether it is a split. These
    eight are the paper's. Then the root of Adam's mean squared gradient of the parent's colour, which grows
    with the parent's weight in the images, and the ratio of the parent's smallest to its largest scale.
    """
    columns = [table[name] for name in _COLUMNS]
    with below_autograd():
        return torch.ops.blitzgs.spawn_features(columns, rows, is_split, time, extent, level_count)
