# SPDX-License-Identifier: Apache-2.0
"""Measures what each splat contributes to its view, by a rasterisation that sums weights, not colours."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# Units of a weight in 1, kContributionScale of csrc/importance/importance.h.
UNITS = 1 << 32


def splat_contributions(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    isect_splats: Tensor,
    tile_offsets: Tensor,
    *,
    n_cameras: int,
    width: int,
    height: int,
    tile_size: int = 16,
    tile_begin: int = 0,
    tile_end: int = -1,
    n_splats: Tensor | None = None,
    squares: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Sum alpha T over the pixels at which each splat is composited, and count these pixels.

    Alpha and T have the same bits as in `blitzgs.ops.rasterize.rasterize`. The sums are integers, so
    they do not depend on the order of addition, and the sums of disjoint tile ranges add up to the sum of all
    tiles.

    Args:
        means2d: [P, 2], pixels, float32 or (CPU) float64.
        conics: inverse 2D covariances (a, b, c) [P, 3].
        splat_opacities: [P].
        isect_splats: int32 [I], from `blitzgs.ops.intersect.intersect`.
        tile_offsets: int64 [B * T + 1], likewise.
        n_cameras: number of views B.
        width: of every view, pixels.
        height: of every view, pixels.
        tile_size: edge of a tile in pixels, as given to ``intersect``; 16 on CUDA.
        tile_begin: first tile to composite.
        tile_end: end of the tiles to composite, -1 for all.
        n_splats: int64 [1] on the device of the splats: only the first `n_splats` splats are valid. None:
            all.
        squares: sum (alpha T)^2 too.

    Returns:
        Weights int64 [P], in units of 2^-32 (each alpha T rounded to the nearest); pixels int32 [P]; and the
        sums of the squares int64 [P], in the same units (each square rounded down), or [0] if not asked for.

    Raises:
        RuntimeError: wrong shapes or dtypes, a tile range outside the images, or a tile size that CUDA lacks.
    """
    sums: tuple[Tensor, Tensor, Tensor] = torch.ops.blitzgs.contributions(
        means2d, conics, splat_opacities, isect_splats, tile_offsets,
        n_cameras, width, height, tile_size, tile_begin, tile_end, n_splats, squares,
    )  # fmt: skip
    return sums


@torch.library.register_fake("blitzgs::contributions")
def _(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    isect_splats: Tensor,
    tile_offsets: Tensor,
    n_cameras: int,
    width: int,
    height: int,
    tile_size: int,
    tile_begin: int,
    tile_end: int,
    n_splats: Tensor | None = None,
    squares: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    count = means2d.shape[0]
    return (
        means2d.new_empty(count, dtype=torch.int64),
        means2d.new_empty(count, dtype=torch.int32),
        means2d.new_empty(count if squares else 0, dtype=torch.int64),
    )
