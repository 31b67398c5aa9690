# SPDX-License-Identifier: Apache-2.0
"""Bounds of the distances between many cameras and many points, from boxes around neighbouring points.

A city has millions of points and thousands of cameras. The bounds decide nearly every question about their
distances, so that only few of the distances themselves need to be computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.table.blocks import morton_order

BLOCK_POINTS = 256
# Bounds are widened by this share, far more than the rounding of a float64 distance.
_MARGIN = 1e-12
# Largest number of pairs of a camera and a block that are in memory at once.
_PAIRS = 1 << 20


@dataclass(frozen=True)
class PointBlocks:
    """Boxes around blocks of neighbouring points.

    Attributes:
        order: int64 [M], the given points by block: `BLOCK_POINTS` in each, and the rest in the last one.
        points: float64 [B, `BLOCK_POINTS`, 3]; the last block is filled up with its last point.
        low: float64 [B, 3], lower corners of the boxes.
        high: float64 [B, 3], upper corners.
    """

    order: Tensor
    points: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, points: Tensor) -> PointBlocks:
        """Divide points, float64 [M, 3], M >= 1, finite."""
        order = morton_order(points)
        filled = torch.cat((order, order[-1:].expand(-len(order) % BLOCK_POINTS)))
        blocks = points[filled].view(-1, BLOCK_POINTS, 3)
        return cls(order, blocks, blocks.amin(dim=1), blocks.amax(dim=1))

    def __len__(self) -> int:
        return len(self.low)

    def rows(self, values: Tensor) -> Tensor:
        """Return the value [B] of each block for each of its points, [M] in the order of `order`."""
        return values.repeat_interleave(BLOCK_POINTS)[: len(self.order)]

    def points_of(self, chosen: Tensor) -> Tensor:
        """Return the points of the chosen blocks (bool [B]), float64 [m, 3]."""
        points = self.points[chosen].flatten(0, 1)
        filling = -len(self.order) % BLOCK_POINTS
        return points[: len(points) - filling] if chosen[-1] else points

    def distances(self, centres: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Bound the distances of cameras to the points of each block, for some cameras at a time.

        Args:
            centres: float64 [V, 3], on the device of the points.

        Yields:
            The next v centres, and two bounds, float64 [v, B]: no point of the block is nearer than the first
            or farther than the second.
        """
        for some in centres.split(max(1, _PAIRS // len(self))):
            below, above = self.low - some[:, None], some[:, None] - self.high
            nearest = torch.maximum(below, above).clamp_(min=0).norm(dim=2)
            farthest = torch.minimum(below, above).neg_().norm(dim=2)
            yield some, nearest * (1 - _MARGIN), farthest * (1 + _MARGIN)
