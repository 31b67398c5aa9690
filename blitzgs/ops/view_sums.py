# SPDX-License-Identifier: Apache-2.0
"""Accumulates what an importance sweep needs from each batch of views: scores, counts and the cull matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# How many times a weight is divided by the square root of its number of pixels, for each score rule.
DIVISIONS = {"weight": 0, "root": 1, "density": 2}


class ViewSums(NamedTuple):
    """Sums over views of N Gaussians, changed in place.

    Attributes:
        score: int64 [N].
        seen: int32 [N], number of views in which the Gaussian is visible (radius > 0).
        counted: int32 [N], number of views in which it counts (it is in the top 99 % of the view's weight).
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
    """Add the splats of at most 32 views to the sums.

    A splat adds ``round(w / (pixels + eps)^p / unit)`` to its Gaussian's score, where w is its weight (in
    units of 1) and p is 1 for "density" (BlitzGS, section 3.2), 1/2 for "root" and 0 for "weight".

    Args:
        sums: changed in place.
        splats: visible_ids int32 [U] and splat_offsets int32 [U + 1] (the Gaussians, each once, and the
            splats of each), camera_ids int32 [P], radii int32 [P, 2].
        weights: int64 [P], in units of 2^-32.
        pixels: int32 [P].
        counts: bool [P], whether the Gaussian counts in the splat's view.
        columns: the views' columns in the cull matrix.
        rule: score rule, a key of `DIVISIONS`.
        eps: added to the number of pixels.
        unit: unit of the score; division by a power of two is exact.

    Raises:
        RuntimeError: wrong shapes or dtypes, too many views, or a column outside the matrix.
    """
    torch.ops.blitzgs.view_sums_(
        list(sums), list(splats), weights, pixels, counts, list(columns), DIVISIONS[rule], eps, unit
    )


@torch.library.register_fake("blitzgs::view_sums_")
def _(*_args: Any) -> None:
    return None
