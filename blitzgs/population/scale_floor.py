# SPDX-License-Identifier: Apache-2.0
"""Limits the scales of Gaussians from below, by a share of a pixel of the finest training view.

Mip-Splatting (Yu et al. 2024, section 4.1) convolves every Gaussian with a filter of the size of its sampling
interval, the width of a pixel at its depth in the view that samples it most finely. A floor of the scales
limits the frequencies in the same way, and projection, export and viewers need not know it.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from blitzgs.frame.frame import Views
from blitzgs.table.table import GaussianTable

FLOOR = "scale_floor"
# A mean may be outside the image by this share of its size and still count as sampled.
MARGIN = 0.15
# Logarithm of a floor that has no effect. It is finite, because all columns of a checkpoint must be.
_NO_FLOOR = -80.0


@torch.no_grad()
def scale_floors(means: Tensor, views: Iterable[Views], near_plane: float, pixels: float) -> Tensor:
    """Return the logarithm of the smallest standard deviation of each Gaussian, float32 [N].

    It is `pixels` times the smallest z / focal length over the views in which the mean lies between the near
    plane and the image's borders, the latter moved outwards by `MARGIN` of its size. A Gaussian that no view
    samples has no floor.

    Args:
        means: [N, 3].
        views: the training views, in groups of one image size.
        near_plane: in the unit of the means.
        pixels: standard deviation in pixels.
    """
    # Compute in float64, axis by axis, so that the rounded result does not depend on the number of rows.
    x, y, z = means.double().unbind(1)
    interval = torch.full_like(x, torch.inf)
    for group in views:
        for pose, K in zip(group.viewmats.double().tolist(), group.Ks.double().tolist(), strict=True):  # noqa: N806
            u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in pose[:3])
            u, v = K[0][0] * u + K[0][2] * depth, K[1][1] * v + K[1][2] * depth  # times the depth
            inside = depth > near_plane
            for at, size in ((u, group.width), (v, group.height)):
                inside &= (at > -MARGIN * size * depth) & (at < (1.0 + MARGIN) * size * depth)
            finer = depth / max(K[0][0], K[1][1])
            interval = torch.where(inside, torch.minimum(interval, finer), interval)
    return torch.where(interval.isfinite(), (pixels * interval).log(), _NO_FLOOR).float()


@torch.no_grad()
def raise_scales(table: GaussianTable, ids: Tensor) -> None:
    """Raise the scales of the rows `ids` (int32 [U]) to their floor, in place."""
    rows = ids.long()
    scales = table["scales"].index_select(0, rows)
    floors = table[FLOOR].index_select(0, rows)
    table["scales"].index_copy_(0, rows, torch.maximum(scales, floors[:, None]))
