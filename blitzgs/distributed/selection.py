# SPDX-License-Identifier: Apache-2.0
"""Exact selection over all ranks: the k smallest keys, and the shortest prefix that holds a share of a mass.

Both find a threshold by refining a histogram of the float's bits. Each round sums one histogram over the
ranks, of at most 2^16 integers, so no rank needs the others' scores. All sums are
integers, so the same rows are selected at every world size. Ids decide between equal scores.
"""

from __future__ import annotations

from fractions import Fraction

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import KEY_BITS, find_digit_, key_histogram, keys_up_to
from blitzgs.ops.importance import CHOICE_STEP, STEPS, TIES_STEP, MassCut

# Digits of a threshold search, most significant first. The first digit of a score is its exponent and three
# bits of its mantissa, so all scores of a bin share one exponent and their mantissas can be summed exactly.
_KEY_DIGITS = (11, 11, 10)
_SCORE_DIGITS = (11, 10, 10)
_ID_DIGITS = (13, 13, 13, 12, 12)
_MANTISSA_BITS = 23


def decimal_share(share: float) -> Fraction:
    """Return the number that a configuration's decimal stands for: 99/100 for the float 0.99.

    Selections multiply a share by a number of rows and round. The float 0.99 is slightly less than 99/100, so
    the floor of its exact product with 100 would be 98.
    """
    return Fraction(repr(float(share)))


def smallest(keys: Tensor, ids: Tensor, k: int, ranks: Ranks) -> Tensor:
    """Mark the k rows, over all ranks, with the smallest (key, id).

    `keys`: float32 [N_rank], no NaN; infinities are allowed. `ids`: int64 [N_rank], >= 0, unique over all
    ranks. `k`: number of rows to mark; all rows if k exceeds their number. Returns bool [N_rank]; the same
    ids at every world size. ValueError: on every rank, when a key of any rank is NaN, or k < 0.
    """
    if k < 0:
        raise ValueError(f"smallest: k must not be negative, got {k}")
    invalid = torch.stack((keys.isnan().sum(), torch.full((), len(keys), device=keys.device)))
    n_invalid, total = ranks.all_reduce(invalid).tolist()
    if n_invalid:
        raise ValueError(f"smallest: {n_invalid} of {total} keys are NaN")
    if k == 0 or k >= total:
        return torch.full_like(keys, k > 0, dtype=torch.bool)
    search, shift = _search(k, keys.device), KEY_BITS
    for width in _KEY_DIGITS:
        shift -= width
        find_digit_(search, ranks.all_reduce(key_histogram(keys, search[:1], shift, width)))
    chosen = keys_up_to(keys, search[:1])
    # Usually all tied rows are selected.
    if bool(search[2] > search[1]):
        below = keys_up_to(keys, search[:1] - 1)
        tied = chosen ^ below
        _keep_smallest_ids(tied, ids, search[1], ranks)
        chosen = tied.logical_or_(below)
    return chosen


def mass_prefix(scores: Tensor, ids: Tensor, fraction: float, ranks: Ranks) -> Tensor:
    """Mark the fewest rows, by descending score (ties by id), that hold a share of the total score.

    `scores`: float32 [N_rank], finite, >= 0. `ids`: int64 [N_rank], >= 0, unique over all ranks. `fraction`:
    share of the total of all ranks, in [0, 1]; its decimal value counts (0.99 is 99/100). Returns bool
    [N_rank]; the same ids at every world size. The sums are exact. If the total is zero, nothing is marked.
    ValueError: on every rank, when a score of any rank is negative or not finite, or for a fraction outside
    [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"mass_prefix: fraction must be in [0, 1], got {fraction}")
    n_invalid = ranks.all_reduce((~scores.isfinite() | (scores < 0)).sum()).item()
    if n_invalid:
        raise ValueError(f"mass_prefix: {n_invalid} scores are negative or not finite")
    bits = scores.clamp(min=0.0).view(torch.int32).to(torch.int64)
    # An ascending order of these keys is a descending order of the scores.
    keys = (1 << 31) - 1 - bits
    mantissas = (bits & ((1 << _MANTISSA_BITS) - 1)) | ((bits >> _MANTISSA_BITS > 0).long() << _MANTISSA_BITS)
    threshold, left = _mass_threshold(keys, mantissas, decimal_share(fraction), ranks)
    tied = keys == threshold
    if ranks.all_reduce(tied.sum()).item() > left:
        _keep_smallest_ids(tied, ids, left, ranks)
    return tied.logical_or_(keys < threshold)


def integer_mass_prefix(
    weights: Tensor,
    segments: Tensor,
    owners: Tensor,
    ids: Tensor,
    fraction: float,
    ranks: Ranks,
    n_segments: int,
) -> Tensor:
    """Mark the fewest items of each segment, by descending weight, that hold a share of its total.

    This is `mass_prefix` for integers, in several independent sets. With one rank the host does not wait for
    the device. Several ranks wait once, and exchange one histogram of all segments per round.

    `weights`: int64 [P], not negative; a segment's sum over all ranks must be below 2^62. `segments`: int32
    [P] in [0, n_segments). `owners`: int32 [P], the row that each weight belongs to. `ids`: int64 [N], of the
    rows. The fraction has at most 9 decimal places. Returns bool [P], under the conditions of `mass_prefix`;
    ids are unique within a segment.
    """
    share = decimal_share(fraction)
    if not 0 <= share <= 1 or share.denominator > 10**9:
        allowed = "in [0, 1] with at most 9 decimals"
        raise ValueError(f"integer_mass_prefix: fraction must be {allowed}, got {fraction}")
    cut = MassCut.begin(weights, segments, owners, ids, n_segments)
    ratio = share.numerator, share.denominator
    if ranks.world_size == 1:
        cut.take_steps(ratio, 0, STEPS)
        return cut.chosen
    for step in range(0, CHOICE_STEP, 2):
        if step == TIES_STEP and not cut.has_ties():
            break
        cut.take_steps(ratio, step, step + 1)
        ranks.all_reduce(cut.sums)
        cut.take_steps(ratio, step + 1, step + 2)
    cut.take_steps(ratio, CHOICE_STEP, STEPS)
    return cut.chosen


def _search(k: int | Tensor, device: torch.device) -> Tensor:
    """Begin a search for the k-th smallest number (see `find_digit_`)."""
    search = torch.zeros(3, dtype=torch.int64, device=device)
    search[1] = k
    return search


def _keep_smallest_ids(tied: Tensor, ids: Tensor, k: int | Tensor, ranks: Ranks) -> None:
    """Unmark, of the marked rows of all ranks, all but the k with the smallest ids; k > 0."""
    rows = tied.nonzero().squeeze(1)
    search, shift = _search(k, ids.device), sum(_ID_DIGITS)
    for width in _ID_DIGITS:
        shift -= width
        find_digit_(search, _histogram(ids[rows], search[0], shift, width, None, ranks))
    tied[rows] = ids[rows] <= search[0]


def _mass_threshold(keys: Tensor, mantissas: Tensor, share: Fraction, ranks: Ranks) -> tuple[int, int]:
    """Find the key at which the mass of the rows before it and of some equal to it suffices.

    Masses are integers: a score is mantissa * 2^max(exponent, 1), in units of the smallest positive float.

    Returns the threshold (-1: select nothing), and how many rows equal to it are needed.
    """
    prefix, shift = 0, sum(_SCORE_DIGITS)
    missing: int | None = None
    for width in _SCORE_DIGITS:
        shift -= width
        sums = _histogram(keys, prefix, shift, width, mantissas, ranks).tolist()
        masses = [
            mass << _exponent((prefix << width | digit) << shift) if mass else 0
            for digit, mass in enumerate(sums)
        ]
        if missing is None:
            missing = -(-sum(masses) * share.numerator // share.denominator)
        digit = 0
        while digit < len(masses) - 1 and masses[digit] < missing:
            missing -= masses[digit]
            digit += 1
        prefix = prefix << width | digit
    if not missing:
        return -1, 0
    bits = (1 << 31) - 1 - prefix
    mantissa = bits & ((1 << _MANTISSA_BITS) - 1) | (bits >> _MANTISSA_BITS > 0) << _MANTISSA_BITS
    return prefix, -(-missing // (mantissa << _exponent(prefix)))


def _exponent(key: int) -> int:
    """Return the exponent of the score with this key, which follows from the key's first digit."""
    return max(((1 << 31) - 1 - key) >> _MANTISSA_BITS, 1)


def _histogram(
    keys: Tensor, prefix: Tensor | int, shift: int, width: int, weights: Tensor | None, ranks: Ranks
) -> Tensor:
    """Count (or add up the weights of) the keys under a prefix, by their next digit.

    Returns int64 [2^width], summed over the ranks.
    """
    heads = keys >> shift
    under = (heads >> width == prefix).nonzero().squeeze(1)
    bins = heads[under] & ((1 << width) - 1)
    counts = torch.zeros(1 << width, dtype=torch.int64, device=keys.device)
    counts.index_add_(0, bins, torch.ones_like(bins) if weights is None else weights[under])
    return ranks.all_reduce(counts)
