# SPDX-License-Identifier: Apache-2.0
"""Writes what a step reports to the host, the loss's sums and the tiles' costs, in one kernel launch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def report_(
    parts: Tensor | None,
    tile_work: Tensor | None,
    tiles: tuple[int, int],
    rank: int,
    n_ranks: int,
    targets: Sequence[Tensor],
) -> None:
    """Write this rank's part of the report into all targets.

    A target has the loss sums of the M ranks, [M, 2, B], and then the work of the T tiles.

    Args:
        parts: float64 [B, K, 2], of `blitzgs.ops.photometric.photometric_fwd_bwd`; None: no views.
        tile_work: int32 [T], of `rasterize_fwd`; None: no tiles.
        tiles: this rank's [first, one past last).
        rank: this rank.
        n_ranks: M.
        targets: float32 [2 M B + T] each, on this device or in peer-accessible memory of other devices.

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    torch.ops.blitzgs.report_(parts, tile_work, *tiles, rank, n_ranks, targets)
