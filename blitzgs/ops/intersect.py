# SPDX-License-Identifier: Apache-2.0
"""Tile intersection: lists the projected splats that each image tile composites, front to back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.util.errors import check_tensors

# Edge of a tile, pixels; CUDA composites tiles of no other.
TILE_SIZE = 16


class TileGrid(NamedTuple):
    """The tiles of B views, as the ops take them."""

    n_cameras: int  # B
    width: int  # of every view, pixels
    height: int
    tile_size: int = TILE_SIZE  # edge of a tile, pixels
    tile_begin: int = 0  # the range of tiles to composite
    tile_end: int = -1  # -1: all tiles

    @property
    def tiles(self) -> tuple[int, int]:
        """(tiles_x, tiles_y), the tiles that cover a view."""
        return tile_counts(self.width, self.height, self.tile_size)

    def owned_pixels(self, device: torch.device) -> Tensor:
        """Mark the pixels of the tiles [tile_begin, tile_end), bool [B, H, W]."""
        tiles_x, tiles_y = self.tiles
        tiles = torch.arange(self.n_cameras * tiles_y * tiles_x, device=device)
        end = len(tiles) if self.tile_end < 0 else self.tile_end
        owned = ((tiles >= self.tile_begin) & (tiles < end)).view(self.n_cameras, tiles_y, tiles_x)
        pixels = owned.repeat_interleave(self.tile_size, 1).repeat_interleave(self.tile_size, 2)
        return pixels[:, : self.height, : self.width]


def tile_counts(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """Return (tiles_x, tiles_y), the tiles that cover an image of width x height pixels."""
    return -(-width // tile_size), -(-height // tile_size)


def intersect(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    depths: Tensor,
    camera_ids: Tensor,
    ids: Tensor | None = None,
    *,
    n_cameras: int,
    width: int,
    height: int,
    tile_size: int = TILE_SIZE,
    tile_begin: int = 0,
    tile_end: int = -1,
    n_isects: int = -1,
    n_splats: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """List, for every tile of every view, the splats that touch it, ordered by (depth, id).

    A splat touches a tile iff its alpha, ``opacity * exp(-q / 2)``, can reach 1/255 on the tile's pixels
    (conservatively: culling never changes the image). Tiles are numbered
    ``(camera * tiles_y + ty) * tiles_x + tx``. Not differentiable.

    Args:
        means2d: projected means [P, 2], pixels, float32 or float64.
        conics: inverse 2D covariances (a, b, c) [P, 3], 1/pixel^2.
        splat_opacities: [P], in [0, 1].
        depths: sort keys [P], the z of each splat in its view.
        camera_ids: int32 [P], the view of each splat.
        ids: int64 [P], persistent ids that order splats of equal depth; None: their index orders them.
        n_cameras, width, height: number of views B, and the size of each, pixels.
        tile_size: edge of a tile in pixels, 1 to 64.
        tile_begin, tile_end: the owned tiles, end -1 for all; others get empty lists.
        n_isects: an upper bound of the number of intersections if known (the sum of ``tiles_touched``),
            -1 to have them counted. On CUDA the check of this bound waits for the device.
        n_splats: int64 [1] on the device of the splats: only the first ``n_splats`` of the P are valid, the
            others are never read. With it, the host can queue the CUDA op before it knows the number. None:
            all splats; a number outside [0, P] counts as 0.

    Returns:
        ``isect_splats`` int32 [I] splat indices and ``tile_offsets`` int64 [B * T + 1]: tile t composites
        ``isect_splats[tile_offsets[t]:tile_offsets[t + 1]]``. I is ``n_isects`` when that was given; entries
        past ``tile_offsets[-1]`` are undefined.

    Raises:
        TypeError: an argument is not a tensor.
        RuntimeError: wrong shapes, dtypes or devices, a tile range outside the image, 2^31 splats or tiles or
            more, or more intersections than ``n_isects``.
    """
    check_tensors(
        means2d=means2d, conics=conics, splat_opacities=splat_opacities, depths=depths, camera_ids=camera_ids
    )
    splats = (means2d, conics, splat_opacities, depths, camera_ids, ids)
    grid = TileGrid(n_cameras, width, height, tile_size, tile_begin, tile_end)
    return torch.ops.blitzgs.intersect(*splats, *grid, n_isects, n_splats)
