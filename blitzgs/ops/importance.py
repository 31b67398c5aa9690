# SPDX-License-Identifier: Apache-2.0
"""Measures what each splat contributes to its view and to each pixel, and selects by these weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.intersect import TILE_SIZE

# Units of a weight in 1, kContributionScale of csrc/importance/importance.h. Sums of such integers depend on
# no order of addition, and those of disjoint ranges of tiles add up.
UNITS = 1 << 32
# How many times a weight is divided by the square root of its number of pixels, for each score rule.
DIVISIONS = {"weight": 0, "root": 1, "density": 2}


class ViewSums(NamedTuple):
    """Sums over views of N Gaussians, changed in place."""

    score: Tensor  # int64 [N]
    seen: Tensor  # int32 [N], number of views in which the Gaussian is visible (radius > 0)
    counted: Tensor  # int32 [N], number of views in which it counts (is in the top 99 % of the weight)
    cull: Tensor  # int32 [N, words], bit v % 32 of word v / 32 set where it does not count in view v


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
    """
    torch.ops.blitzgs.view_sums_(
        list(sums), list(splats), weights, pixels, counts, list(columns), DIVISIONS[rule], eps, unit
    )


class PixelSplats(NamedTuple):
    """What R pixels composite; see `pixel_splats`."""

    transmittances: Tensor  # [R], the share of light that passes all splats
    counts: Tensor  # int32 [R], the number of composited splats
    medians: Tensor  # int32 [R], the last composited splat with T above 0.5 in front of it, -1 for none
    ids: Tensor  # int32 [R, k], the splats of the largest alpha T, front to back; then -1
    weights: Tensor  # [R, k], their alpha T; then 0


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
    tile_size: int = TILE_SIZE,
    strongest: int = 0,
    pixels: Tensor | None = None,
) -> PixelSplats:
    """Find which splats each pixel composites. Not differentiable.

    Alpha and T have the same bits as in :func:`blitzgs.ops.rasterize.rasterize`. Of equal alpha T, the splats
    in front are the strongest.

    Args: those of :func:`blitzgs.ops.rasterize.rasterize` (tiles of 16 px on CUDA), and
        strongest: number k of splats of each pixel to return.
        pixels: int64 [R], numbers (b H + y) W + x of the pixels to return, each in range; None: all, in this
            order.

    Raises:
        RuntimeError: a tile size that CUDA lacks.
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


# As in csrc/importance/mass_cut.h.
DIGITS = 1 << 12
ROUNDS = 6
TIES_STEP, CHOICE_STEP = 2 * ROUNDS, 4 * ROUNDS
STEPS = CHOICE_STEP + 1
_SEARCH_NUMBERS = 8
_MISSING_ID = 6  # index into a search's 8 numbers: how many items remain to be chosen by their ids


class MassCut(NamedTuple):
    """A search for the threshold weight of each of S segments; see `csrc/importance/mass_cut.h`.

    A search has rounds of two steps. Step 2 r of round r scans this rank's items and fills `sums`. The caller
    then adds up `sums` over the ranks. Step 2 r + 1 reads and clears them. Steps from `TIES_STEP` on do
    nothing unless `has_ties` is true. The last step fills `chosen`.
    """

    # Weights int64 [P] >= 0; segments int32 [P]; owners int32 [P], the row that each weight belongs to; and
    # the rows' ids int64 [N], in [0, 2^63). The weights of a segment must add up to less than 2^62.
    items: tuple[Tensor, Tensor, Tensor, Tensor]
    searches: Tensor  # int64 [S, 8]
    sums: Tensor  # int64 [S, DIGITS]
    listed: Tensor  # int32 [1 + P]
    chosen: Tensor  # bool [P]

    @classmethod
    def begin(cls, weights: Tensor, segments: Tensor, owners: Tensor, ids: Tensor, count: int) -> MassCut:
        """Allocate a search over `count` segments; the arguments are those of `items`."""
        return cls(
            (weights, segments, owners, ids),
            weights.new_zeros(count, _SEARCH_NUMBERS),
            weights.new_zeros(count, DIGITS),
            segments.new_empty(1 + len(weights)),
            weights.new_empty(len(weights), dtype=torch.bool),
        )

    def take_steps(self, share: tuple[int, int], first: int, last: int) -> None:
        """Run the steps `first` to `last` - 1; `share` is a numerator and a denominator of at most 10^9."""
        torch.ops.blitzgs.mass_cut_(
            *self.items, self.searches, self.sums, self.listed, self.chosen, *share, first, last
        )

    def has_ties(self) -> bool:
        """Tell, at `TIES_STEP`, whether ids must decide between equal weights; waits for the device."""
        return bool(self.searches[:, _MISSING_ID].any())
