# SPDX-License-Identifier: Apache-2.0
"""Octree levels: which level of detail is resolvable from which distance (BlitzGS Eq. 1)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.config.fields import FORK, Config
from blitzgs.table.blocks import morton_order

# Finest sensible voxel relative to the box of the points; it sets the coarsest level's size.
_BASE_RESOLUTION = 0.001
# Voxel keys have 21 bits per axis. With this many levels, the finest grid of `measure_levels` uses all of
# them.
MAX_LEVELS = 22
# Longest box relative to that of the middle half of the points: some of a horizon, or of wrong matches, are
# perhaps a thousand times as far as the rest, and one voxel would hold all of the scene.
_LONGEST_BOX = 50
_QUARTILE_SAMPLE = 100_000
# Levels of footprints: four to an octave of the octree, and as many as the ops take.
FOOTPRINT_LEVELS, FOOTPRINT_STEPS = 32, 4


@dataclass(frozen=True)
class Levels:
    """The octree levels of a scene: level l is meant for distances around `reference_distance` / `fork`^l."""

    count: int  # number of levels K
    fork: float  # ratio f of neighbouring levels
    reference_distance: float  # d_0, the distance that level 0 is meant for, in the scene's unit
    voxel_size: float  # edge of a level-0 voxel, in the scene's unit

    def voxel_size_of(self, level: int) -> float:
        """Return the edge of a voxel of `level`."""
        return self.voxel_size / self.fork**level

    def farthest(self, level: int) -> float:
        """Return the largest distance from which `level` is resolvable; see `farthest`."""
        return farthest(level, self.reference_distance, self.fork)


def farthest(level: int, reference_distance: float, fork: float) -> float:
    """Return the largest distance from which a level is resolvable, in the unit of `reference_distance`.

    BlitzGS Eq. 1 rounds log_f(d_0 / d), f the fork, to the nearest integer, so level l is resolvable up to d
    = d_0 f^(1/2 - l). Level 0 is resolvable from any distance.
    """
    return math.inf if level == 0 else reference_distance * fork ** (0.5 - level)


def level_fork(config: Config) -> float:
    """Return the ratio of the distances of neighbouring levels of a run's LOD gate."""
    return FORK ** (1 / FOOTPRINT_STEPS) if config.view.footprint > 0 else FORK


def footprint_sizes(scales: Tensor, opacities: Tensor) -> Tensor:
    """Return the logarithms of o sqrt(a b) of Gaussians, float64 [N], in the unit of the scales.

    a and b are the largest two scales (given as logarithms, [N, 3]) and o is the opacity (logits, [N]). This
    size times the focal length over the distance is the footprint in pixels. Where a picture sees the broad
    side and nothing in front, pi times its square is the sum of alpha^2, to which the squared error is
    proportional that leaving the Gaussian out makes.
    """
    broad = scales.double().sum(1) - scales.double().amin(1)
    return 0.5 * broad + torch.nn.functional.logsigmoid(opacities.double())


def footprint_levels(sizes: Tensor, reach: float, reference_distance: float, fork: float) -> Tensor:
    """Return the levels that follow what Gaussians are, uint8 [N], from their `footprint_sizes`.

    The level is the finest whose `farthest` distance is at least that at which the footprint becomes too
    small. So a view that leaves out levels by distance leaves out only Gaussians of smaller footprints.
    `reach`: this distance for a size of 1, the focal length in pixels over the smallest footprint.
    """
    level = ((math.log(reference_distance / reach) - sizes) / math.log(fork) + 0.5).floor()
    return level.clamp(0, FOOTPRINT_LEVELS - 1).to(torch.uint8)


def measure_levels(points: Tensor, centres: Tensor, fork: float) -> Levels:
    """Choose the levels of a scene from its SfM points and training cameras.

    d_max and d_min are the 99.9 % and 0.1 % quantiles over cameras of the same quantiles of each camera's
    point distances; d_0 = d_max and K = max(1, round(log_f(d_max / d_min)) + 1). The box is 1.1 times the
    largest extent between the 1 % and 99 % coordinate quantiles, at most 50 times that between the quartiles;
    level 0 has voxels of box / f^b with b = round(log_2(1 / _BASE_RESOLUTION)) - floor(K / 2) + 1.

    `points`: float64 [M, 3], on any device. `centres`: of the cameras, float64 [V, 3], on the same device.
    `fork`: f > 1. ValueError: the cloud or the set of cameras is empty, or all points coincide.
    """
    if len(points) == 0 or len(centres) == 0:
        raise ValueError(
            f"octree levels need points and cameras, got {len(points)} points and {len(centres)} cameras"
        )
    blocks = PointBlocks.of(points)
    d_max, d_min = (_quantile(values, q).item() for q, values in _distance_quantiles(blocks, centres).items())
    box = 1.1 * max((_quantile(axis, 0.99) - _quantile(axis, 0.01)).item() for axis in points.unbind(1))
    sample = points[:: max(1, len(points) // _QUARTILE_SAMPLE)]
    middle = (sample.quantile(0.75, dim=0) - sample.quantile(0.25, dim=0)).max().item()
    box = min(box, _LONGEST_BOX * middle) if middle > 0 else box
    if not (box > 0 and d_min > 0):
        raise ValueError(
            "octree levels need points that are spread out, and cameras at some distance from them: the box "
            f"of the points measures {box:g}, and the smallest distance is {d_min:g}. Check the points of "
            "the capture; if it has none (an empty points3D.txt), training starts from random points"
        )
    count = min(MAX_LEVELS, max(1, round(math.log(d_max / d_min, fork)) + 1))
    base = round(math.log2(1.0 / _BASE_RESOLUTION)) - count // 2 + 1
    return Levels(count=count, fork=fork, reference_distance=d_max, voxel_size=box / fork**base)


def _distance_quantiles(blocks: PointBlocks, centres: Tensor) -> dict[float, Tensor]:
    """Return the quantiles 0.999 and 0.001 of each camera's distances to the points, float64 [V] each."""
    parts: dict[float, list[Tensor]] = {0.999: [], 0.001: []}
    count = len(blocks.order)
    for some, nearest, farthest in blocks.distances(centres):
        for q, values in parts.items():
            top = q > 0.5
            inner, outer = (nearest, farthest) if top else (farthest, nearest)
            # So many blocks, in the order of their bounds, have all values that the quantile needs.
            rank = _values_needed(count, q) - 1
            enough = min(-(-rank // BLOCK_POINTS), len(blocks) - 1) + 1
            limit = inner.topk(enough, largest=top).values[:, -1:]
            most = int((outer >= limit if top else outer <= limit).sum(dim=1).amax())
            chosen = outer.topk(most, largest=top).indices
            pieces = max(1, PAIRS_OF_POINTS // most)
            for cameras, own in zip(some.split(pieces), chosen.split(pieces), strict=True):
                distances = blocks.distances_of(cameras, own, -math.inf if top else math.inf)
                values.append(_quantile(distances.flatten(1), q, count))
    return {q: torch.cat(values) for q, values in parts.items()}


def _values_needed(count: int, q: float) -> int:
    """Return how many values, counted from the nearer end, a quantile of `count` values needs."""
    return min(math.floor((1.0 - q if q > 0.5 else q) * (count - 1)) + 2, count)


def _quantile(values: Tensor, q: float, count: int | None = None) -> Tensor:
    """Return the linearly interpolated quantile of values near one of their ends, without a full sort.

    `values`: [..., M], or as many as include `_values_needed`. `count`: M; None: `values` has all.
    """
    count = count or values.shape[-1]
    position = (1.0 - q if q > 0.5 else q) * (count - 1)
    below, needed = math.floor(position), _values_needed(count, q)
    ends = values.topk(needed, largest=q > 0.5).values
    return ends[..., below] + (ends[..., needed - 1] - ends[..., below]) * (position - below)


BLOCK_POINTS = 256
# Bounds are widened by this share, far more than the rounding of a float64 distance.
_MARGIN = 1e-12
# Largest number of pairs of a camera and a block that are in memory at once.
_PAIRS = 1 << 20
# Largest number of pairs of a camera and a block whose distances are computed at once.
PAIRS_OF_POINTS = 1 << 13


@dataclass(frozen=True)
class PointBlocks:
    """Boxes around blocks of neighbouring points, which bound their distances from cameras.

    A city has millions of points and thousands of cameras. The bounds decide nearly every question about
    their distances, so that few of these need to be computed.
    """

    order: Tensor  # int64 [M], the points by block: `BLOCK_POINTS` in each, and the rest in the last one
    points: Tensor  # float64 [B, `BLOCK_POINTS`, 3]; the last block is filled up with its last point
    low: Tensor  # float64 [B, 3], lower corners of the boxes
    high: Tensor  # float64 [B, 3], upper corners

    @classmethod
    def of(cls, points: Tensor) -> PointBlocks:
        """Divide points, float64 [M, 3], M >= 1, finite."""
        order = morton_order(points)
        filled = torch.cat((order, order[-1:].expand(-len(order) % BLOCK_POINTS)))
        blocks = points[filled].view(-1, BLOCK_POINTS, 3)
        return cls(order, blocks, blocks.amin(dim=1), blocks.amax(dim=1))

    def __len__(self) -> int:
        return len(self.low)

    def distances_of(self, centres: Tensor, chosen: Tensor, filling: float) -> Tensor:
        """Return the distances of cameras to all points of some blocks.

        `centres`: float64 [P, 3]. `chosen`: int64 [P, k], the blocks of each camera. `filling`: what stands
        for the points that fill up the last block. Returns float64 [P, k, `BLOCK_POINTS`].
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

        `centres`: float64 [V, 3], on the device of the points. `which`: int64 [B], the blocks; None: all.
        Yields the next v centres, and two bounds, float64 [v, B]: no point of the block is nearer than the
        first or farther than the second.
        """
        low, high = (self.low, self.high) if which is None else (self.low[which], self.high[which])
        for some in centres.split(max(1, _PAIRS // max(1, len(low)))):
            below, above = low - some[:, None], some[:, None] - high
            nearest = torch.maximum(below, above).clamp_(min=0).norm(dim=2)
            farthest = torch.minimum(below, above).neg_().norm(dim=2)
            yield some, nearest * (1 - _MARGIN), farthest * (1 + _MARGIN)
