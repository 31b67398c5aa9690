# SPDX-License-Identifier: Apache-2.0
"""Finds which splats each pixel composites, by a rasterisation without colours."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


class PixelSplats(NamedTuple):
    """What R pixels composite; see `pixel_splats`.

    Attributes:
        transmittances: [R], the share of light that passes all splats.
        counts: int32 [R], the number of composited splats.
        medians: int32 [R], the last composited splat with a transmittance above 0.5 in front of it, -1 for
            none.
        ids: int32 [R, k], the splats of the largest alpha T, front to back; then -1.
        weights: [R, k], their alpha T; then 0.
    """

    transmittances: Tensor
    counts: Tensor
    medians: Tensor
    ids: Tensor
    weights: Tensor


@torch.no_grad()
def pixel_splats(
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
    strongest: int = 0,
    pixels: Tensor | None = None,
) -> PixelSplats:
    """Find which splats each pixel composites. Not differentiable.

    Alpha and T have the same bits as in :func:`blitzgs.ops.rasterize.rasterize`. Of equal alpha T, the splats
    in front are the strongest.

    Args:
        means2d: [P, 2], pixels, float32 or (CPU) float64.
        conics: inverse 2D covariances (a, b, c) [P, 3].
        splat_opacities: [P].
        isect_splats: int32 [I], from :func:`blitzgs.ops.intersect.intersect`.
        tile_offsets: int64 [B * T + 1], likewise.
        n_cameras: number of views B.
        width: of every view, pixels.
        height: of every view, pixels.
        tile_size: edge of a tile in pixels, as given to ``intersect``; 16 on CUDA.
        strongest: number k of splats of each pixel to return.
        pixels: int64 [R], numbers (b H + y) W + x of the pixels to return, each in range; None: all, in this
            order.

    Raises:
        RuntimeError: wrong shapes or dtypes, or a tile size that CUDA lacks.
    """
    slots, rows, n_rows = None, None, n_cameras * height * width
    if pixels is not None:
        wanted, rows = pixels.unique(return_inverse=True)
        slots = torch.full((n_rows,), -1, dtype=torch.int32, device=pixels.device)
        slots[wanted] = torch.arange(len(wanted), dtype=torch.int32, device=pixels.device)
        slots, n_rows = slots.view(n_cameras, height, width), len(wanted)
    found = torch.ops.blitzgs.pixel_splats(
        means2d, conics, splat_opacities, isect_splats, tile_offsets, slots, n_rows,
        n_cameras, width, height, tile_size, strongest,
    )  # fmt: skip
    return PixelSplats(*(column if rows is None else column.index_select(0, rows) for column in found))
