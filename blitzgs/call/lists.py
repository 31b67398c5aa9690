# SPDX-License-Identifier: Apache-2.0
"""The splats that each tile of a call's images composites."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.call.extras import Pixels
from blitzgs.call.groups import CUDA_TILE_SIZE
from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions


@dataclass
class Lists:
    """The splats that each tile of all images composites.

    Attributes:
        splats: int32, splat indices; entries past the last offset are undefined.
        offsets: int64 [I T + 1], where each tile's list begins.
        width: image width in px.
        height: image height in px.
        tile_size: edge of a tile in px.
    """

    splats: Tensor
    offsets: Tensor
    width: int
    height: int
    tile_size: int
    _listed: Tensor | None = None

    @property
    def tiles_x(self) -> int:
        """Number of tiles in a row."""
        return -(-self.width // self.tile_size)

    @property
    def tiles_y(self) -> int:
        """Number of tiles in a column."""
        return -(-self.height // self.tile_size)

    def listed(self) -> Tensor:
        """Return `splats` without the undefined entries, which exist if splats are hidden."""
        if torch.compiler.is_compiling():  # `intersect` has counted the entries: none are undefined
            return self.splats
        if self._listed is None:  # once, because it waits for the device
            self._listed = self.splats[: int(self.offsets[-1])]
        return self._listed


def lists_of(
    splats: ProjectedSplats, images: int, projection: ProjectionOptions, count: int
) -> tuple[Lists, Lists]:
    """Return the tile lists for meta, and those to composite.

    Args:
        images: number of images I.
        projection: the size of the images, and the caller's tile size.
        count: number of entries of the lists for meta; -1: unknown.
    """
    width, height, tile_size = projection.width, projection.height, projection.tile_size

    def listed_by(size: int, n_isects: int) -> Lists:
        isect_splats, offsets = torch.ops.blitzgs.intersect(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, None,
            *TileGrid(images, width, height, size), n_isects, None, True,
        )  # fmt: skip
        return Lists(isect_splats, offsets, width, height, size)

    lists = listed_by(tile_size, count)
    if not splats.means2d.is_cuda or tile_size == CUDA_TILE_SIZE:
        return lists, lists
    return lists, listed_by(CUDA_TILE_SIZE, -1)


def lists_of_pixels(
    splats: ProjectedSplats, images: int, projection: ProjectionOptions, pixels: Pixels
) -> tuple[Lists, Lists]:
    """Return the tile lists for meta, and those to composite; they are empty but in tiles that have a pixel.

    These tiles have the same lists as in the whole image, so their pixels have the same bits.

    Args:
        images: number of images I.
        projection: the size of the images, and the caller's tile size.
    """
    lists = _lists_by(projection.tile_size, splats, images, projection, pixels)
    if not splats.means2d.is_cuda or projection.tile_size == CUDA_TILE_SIZE:
        return lists, lists
    return lists, _lists_by(CUDA_TILE_SIZE, splats, images, projection, pixels)


def _lists_by(
    edge: int, splats: ProjectedSplats, images: int, projection: ProjectionOptions, pixels: Pixels
) -> Lists:
    grid = TileGrid(images, projection.width, projection.height, edge)
    rows, columns = -(-grid.height // edge), -(-grid.width // edge)
    wanted = torch.zeros(images, rows, columns, dtype=torch.bool, device=splats.means2d.device)
    wanted[pixels.images, pixels.rows // edge, pixels.columns // edge] = True
    near = _splats_near(splats, wanted, edge)
    own = [t.detach().index_select(0, near) for t in (splats.means2d, splats.conics, splats.opacities)]
    depths, camera_ids = (t.detach().index_select(0, near) for t in (splats.depths, splats.camera_ids))
    listed, offsets = torch.ops.blitzgs.intersect(*own, depths, camera_ids, None, *grid, -1, None, True)
    lengths, count = offsets.diff(), int(offsets[-1])
    kept = wanted.view(-1).repeat_interleave(lengths, output_size=count)
    ends = (lengths * wanted.view(-1)).cumsum(0)
    return Lists(
        near.index_select(0, listed[:count][kept]).int(),
        torch.cat([ends.new_zeros(1), ends]),
        grid.width,
        grid.height,
        edge,
    )


def _splats_near(splats: ProjectedSplats, wanted: Tensor, edge: int) -> Tensor:
    """Return the splats whose box overlaps a wanted tile, int64 [Q], in their order."""
    images, rows, columns = wanted.shape
    # Sums over all tiles above and left give the number of wanted tiles in a box from its corners.
    sums = torch.zeros(images, rows + 1, columns + 1, dtype=torch.int64, device=wanted.device)
    sums[:, 1:, 1:] = wanted.long().cumsum(1).cumsum(2)
    reach = splats.radii + 1
    most = torch.tensor([columns, rows], device=wanted.device)
    means = splats.means2d.detach()
    low = ((means - reach) / edge).floor().clamp(min=0).minimum(most).long()
    high = (((means + reach) / edge).floor() + 1).clamp(min=0).minimum(most).long()
    image = splats.camera_ids.long()
    (x0, y0), (x1, y1) = low.unbind(1), high.unbind(1)
    count = sums[image, y1, x1] - sums[image, y0, x1] - sums[image, y1, x0] + sums[image, y0, x0]
    return count.nonzero()[:, 0]
