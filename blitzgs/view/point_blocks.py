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
# Largest number of pairs of a camera and a block whose distances are computed at once.
PAIRS_OF_POINTS = 1 << 13


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

    def distances_of(self, centres: Tensor, chosen: Tensor, filling: float) -> Tensor:
        """Return the distances of cameras to all points of some blocks.

        Args:
            centres: float64 [P, 3].
            chosen: int64 [P, k], the blocks of each camera.
            filling: what stands for the points that fill up the last block.

        Returns:
            float64 [P, k, `BLOCK_POINTS`].
        """
        distances = (self.points[chosen] - centres[:, None, None]).norm(dim=3)
        count = len(self.order) - (len(self) - 1) * BLOCK_POINTS
        if count < BLOCK_POINTS:
            rest = distances[..., count:]
            rest.masked_fill_((chosen == len(self) - 1)[..., None], filling)
        return distances

    def distances(
        self, centres: Tensor, which: Tensor | None = None
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Bound the distances of cameras to the points of each block, for some cameras at a time.

        Args:
            centres: float64 [V, 3], on the device of the points.
            which: int64 [B], the blocks; None: all.

        Yields:
            The next v centres, and two bounds, float64 [v, B]: no point of the block is nearer than the first
            or farther than the second.
        """
        low, high = (self.low, self.high) if which is None else (self.low[which], self.high[which])
        for some in centres.split(max(1, _PAIRS // max(1, len(low)))):
            below, above = low - some[:, None], some[:, None] - high
            nearest = torch.maximum(below, above).clamp_(min=0).norm(dim=2)
            farthest = torch.minimum(below, above).neg_().norm(dim=2)
            yield some, nearest * (1 - _MARGIN), farthest * (1 + _MARGIN)
