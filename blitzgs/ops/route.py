# SPDX-License-Identifier: Apache-2.0
"""Routing: which ranks a projected row has to be sent to."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def route_count(
    means2d: Tensor,
    conics: Tensor,
    row_opacities: Tensor,
    camera_ids: Tensor,
    tile_ranges: Sequence[tuple[int, int]],
    width: int,
    height: int,
    tile_size: int = 16,
) -> tuple[Tensor, Tensor]:
    """Find the ranks whose tiles each row touches, by the same tile test as `intersect`.

    Args:
        means2d: [P, 2] pixels.
        conics: [P, 3], inverse 2D covariance (a, b, c) in 1 / pixel^2.
        row_opacities: [P].
        camera_ids: int32 [P].
        tile_ranges: [begin, end) of each of the M ranks, in flattened tile indices (camera * T + ty * tiles_x
            + tx); they may overlap, and begin in ascending order.
        width: image width in pixels.
        height: image height in pixels.
        tile_size: tile edge in pixels.

    Returns:
        masks int64 [P], bit m set when the row goes to rank m, and counts int64 [M, 2]: the rows that go to
        rank m and the row-tile intersections they make there.

    Raises:
        RuntimeError: wrong shapes or dtypes, ranges out of order, or more than 63 ranks.
    """
    begins, ends = [begin for begin, _ in tile_ranges], [end for _, end in tile_ranges]
    masks, counts = torch.ops.blitzgs.route_count(
        means2d, conics, row_opacities, camera_ids, begins, ends, width, height, tile_size
    )
    return masks, counts


@torch.library.register_fake("blitzgs::route_count")
def _(
    means2d: Tensor,
    conics: Tensor,
    row_opacities: Tensor,
    camera_ids: Tensor,
    tile_begins: Sequence[int],
    tile_ends: Sequence[int],
    width: int,
    height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor]:
    masks = means2d.new_empty(means2d.shape[0], dtype=torch.int64)
    return masks, means2d.new_empty((len(tile_begins), 2), dtype=torch.int64)
