# SPDX-License-Identifier: Apache-2.0
"""The splats that each tile of a call's images composites."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.call.groups import CUDA_TILE_SIZE
from blitzgs.call.queued import Rendered
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
    splats: ProjectedSplats, images: int, project: ProjectionOptions, ready: Rendered | None, count: int
) -> tuple[Lists, Lists]:
    """Return the tile lists for meta, and those to composite.

    Args:
        splats: the splats of all images.
        images: number of images I.
        project: the size of the images, and the caller's tile size.
        ready: what `render_queued` returned, which has the lists; None: they must be made.
        count: number of entries of the lists for meta; -1: unknown.
    """
    width, height, tile_size = project.width, project.height, project.tile_size
    if ready is not None:
        lists = Lists(ready.isect_splats, ready.tile_offsets, width, height, tile_size)
        return lists, lists

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
