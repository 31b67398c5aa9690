# SPDX-License-Identifier: Apache-2.0
"""What an importance sweep keeps of a batch of views: scores, counts and the cull matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# How often a weight is divided by the root of its pixels.
DIVISIONS = {"weight": 0, "root": 1, "density": 2}


class ViewSums(NamedTuple):
    """Sums over views of N Gaussians, changed in place.

    Attributes:
        score: int64 [N].
        seen: int32 [N], views in which the Gaussian has a radius.
        counted: int32 [N], those in which it counts.
        cull: int32 [N, words], bit v % 32 of word v / 32 set where it does not count in view v.
    """

    score: Tensor
    seen: Tensor
    counted: Tensor
    cull: Tensor


@torch.no_grad()
def view_sums_(
    sums: ViewSums,
    splats: tuple[Tensor, Tensor, Tensor, Tensor],
    weights: Tensor,
    pixels: Tensor,
    counts: Tensor,
    columns: Sequence[int],
    *,
    rule: str,
    eps: float,
    unit: float,
) -> None:
    """Add the splats of at most 32 views.

    A splat adds ``round(w / (pixels + eps)^p / unit)`` to its Gaussian's score, where w is its weight in ones
    and p is 1 for "density", 1/2 for "root" and 0 for "weight" (paper §3.2).

    Args:
        sums: changed in place.
        splats: visible_ids int32 [U] and splat_offsets int32 [U + 1] (the Gaussians, each once, and the
            splats of each), camera_ids int32 [P], radii int32 [P, 2].
        weights: int64 [P], in units of 2^-32.
        pixels: int32 [P].
        counts: bool [P].
        columns: of the cull matrix, one for each view.
        rule: of the score.
        eps: added to the pixels.
        unit: of the score; a power of two leaves the quotient exact.

    Raises:
        RuntimeError: wrong shapes or dtypes, too many views, or a column outside the matrix.
    """
    torch.ops.blitzgs.view_sums_(
        list(sums), list(splats), weights, pixels, counts, list(columns), DIVISIONS[rule], eps, unit
    )


@torch.library.register_fake("blitzgs::view_sums_")
def _(*_args: Any) -> None:
    return None
