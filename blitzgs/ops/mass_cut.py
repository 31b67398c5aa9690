# SPDX-License-Identifier: Apache-2.0
"""Selects, without sorting, the fewest items of each segment that hold a given share of its total weight."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

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

    Attributes:
        items: weights int64 [P] >= 0; segments int32 [P]; owners int32 [P], the row that each weight belongs
            to; and the rows' ids int64 [N], in [0, 2^63). The weights of a segment must add up to less than
            2^62.
        searches: int64 [S, 8].
        sums: int64 [S, DIGITS].
        listed: int32 [1 + P].
        chosen: bool [P].
    """

    items: tuple[Tensor, Tensor, Tensor, Tensor]
    searches: Tensor
    sums: Tensor
    listed: Tensor
    chosen: Tensor

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
        """Run the steps `first` to `last` - 1; `share` is a numerator and a denominator of at most 10^9.

        Raises:
            RuntimeError: wrong shapes, dtypes or numbers.
        """
        torch.ops.blitzgs.mass_cut_(
            *self.items, self.searches, self.sums, self.listed, self.chosen, *share, first, last
        )

    def has_ties(self) -> bool:
        """Tell, at `TIES_STEP`, whether ids must decide between equal weights; waits for the device."""
        return bool(self.searches[:, _MISSING_ID].any())
