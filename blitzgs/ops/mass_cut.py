# SPDX-License-Identifier: Apache-2.0
"""The fewest items of each segment that hold a share of its weight, found without sorting."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# As in csrc/mass_cut/mass_cut.h.
DIGITS = 1 << 12
ROUNDS = 6
TIES_STEP, CHOICE_STEP = 2 * ROUNDS, 4 * ROUNDS
STEPS = CHOICE_STEP + 1
_SEARCH_NUMBERS = 8
_MISSING_ID = 6  # of a search's numbers: how many items are still to be told by their ids


class MassCut(NamedTuple):
    """A search for the thresholds of S segments; see `csrc/mass_cut/mass_cut.h`.

    Step 2 r of a search scans this rank's items in round r; the `sums` are then to be added up over the
    ranks; step 2 r + 1 reads and clears them. Steps from `TIES_STEP` on do nothing unless `has_ties`. The
    last step fills `chosen`.

    Attributes:
        items: weights int64 [P] >= 0, segments int32 [P], owners int32 [P] (whose weights they are) and ids
            int64 [N] of the owners, in [0, 2^63). The sum of a segment must be below 2^62.
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
        """Prepare a search in `count` segments."""
        return cls(
            (weights, segments, owners, ids),
            weights.new_zeros(count, _SEARCH_NUMBERS),
            weights.new_zeros(count, DIGITS),
            segments.new_empty(1 + len(weights)),
            weights.new_empty(len(weights), dtype=torch.bool),
        )

    def take_steps(self, share: tuple[int, int], first: int, last: int) -> None:
        """Take the steps `first` to `last` - 1; `share` is a numerator and a denominator of at most 10^9.

        Raises:
            RuntimeError: wrong shapes, dtypes or numbers.
        """
        torch.ops.blitzgs.mass_cut_(
            *self.items, self.searches, self.sums, self.listed, self.chosen, *share, first, last
        )

    def has_ties(self) -> bool:
        """Tell, when the rounds for weights are done, whether ids have to decide; waits for the device."""
        return bool(self.searches[:, _MISSING_ID].any())


@torch.library.register_fake("blitzgs::mass_cut_")
def _(*_args: Any) -> None:
    return None
