# SPDX-License-Identifier: Apache-2.0
"""Exact selection over all ranks: the k smallest keys, and the shortest prefix that holds a share of a mass.

Both find a threshold by refining a histogram of the float's bits. Each round sums one histogram over the
ranks, of at most 2^16 integers for each set of rows, so no rank needs the others' scores. All sums are
integers, so the same rows are selected at every world size. Ids decide between equal scores.
"""

from __future__ import annotations

from fractions import Fraction

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import KEY_BITS, key_histogram, key_of_bits
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

    Args:
        keys: float32 [N_rank], no NaN; infinities are allowed.
        ids: int64 [N_rank], >= 0, unique over all ranks.
        k: number of rows to mark; all rows if k exceeds their number.
        ranks: the job.

    Returns:
        bool [N_rank]; the same ids at every world size.

    Raises:
        ValueError: on every rank, when a key of any rank is NaN, or k < 0.
    """
    if k < 0:
        raise ValueError(f"smallest: k must not be negative, got {k}")
    invalid = torch.stack((keys.isnan().sum(), torch.tensor(len(keys), device=keys.device)))
    n_invalid, total = ranks.all_reduce(invalid).tolist()
    if n_invalid:
        raise ValueError(f"smallest: {n_invalid} of {total} keys are NaN")
    if k == 0 or k >= total:
        return torch.full_like(keys, k > 0, dtype=torch.bool)
    left = torch.full((1,), k, device=keys.device)
    prefix, shift = torch.zeros_like(left), KEY_BITS
    for width in _KEY_DIGITS:
        shift -= width
        counts = ranks.all_reduce(key_histogram(keys, prefix, shift, width))
        digit, left = _descend(counts[None], left)
        prefix = (prefix << width) | digit
    limit = key_of_bits(prefix)
    tied = keys == limit
    # Usually all tied rows are selected.
    if bool(counts[digit] > left):
        rows = tied.nonzero().squeeze(1)
        last, _ = _kth(ids[rows], _ID_DIGITS, left, torch.zeros_like(rows), ranks)
        tied[rows] = ids[rows] <= last
    return tied.logical_or_(keys < limit)


def mass_prefix(
    scores: Tensor,
    ids: Tensor,
    fraction: float,
    ranks: Ranks,
    segments: Tensor | None = None,
    n_segments: int = 1,
) -> Tensor:
    """Mark the fewest rows, by descending score (ties by id), that hold a share of the total score.

    Args:
        scores: float32 [N_rank], finite, >= 0.
        ids: int64 [N_rank], >= 0, unique over all ranks within a segment.
        fraction: share of the total of all ranks, in [0, 1]; its decimal value counts (0.99 is 99/100).
        ranks: the job.
        segments: int64 [N_rank] in [0, n_segments), to select in several independent sets at once (views of
            a sweep, say); None: one set.
        n_segments: number of sets.

    Returns:
        bool [N_rank]; the same ids at every world size. The sums are exact. A set whose total is zero selects
        nothing.

    Raises:
        ValueError: on every rank, when a score of any rank is negative or not finite, or for a fraction
            outside [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"mass_prefix: fraction must be in [0, 1], got {fraction}")
    share = decimal_share(fraction)
    n_invalid = ranks.all_reduce((~scores.isfinite() | (scores < 0)).sum()).item()
    if n_invalid:
        raise ValueError(f"mass_prefix: {n_invalid} scores are negative or not finite")
    if segments is None:
        segments = torch.zeros_like(ids)
    bits = scores.clamp(min=0.0).view(torch.int32).to(torch.int64)
    # An ascending order of these keys is a descending order of the scores.
    keys = (1 << 31) - 1 - bits
    mantissas = (bits & ((1 << _MANTISSA_BITS) - 1)) | ((bits >> _MANTISSA_BITS > 0).long() << _MANTISSA_BITS)
    threshold, left = _mass_threshold(keys, mantissas, share, segments, n_segments, ranks)
    return _with_ties(
        keys,
        ids,
        torch.tensor(threshold, device=keys.device),
        torch.tensor(left, device=keys.device),
        segments,
        ranks,
    )


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

    This is `mass_prefix` for integers. With one rank the host does not wait for the device. Several ranks
    wait once, and exchange one histogram of all segments per round.

    Args:
        weights: int64 [P], not negative; a segment's sum over all ranks must be below 2^62.
        segments: int32 [P] in [0, n_segments).
        owners: int32 [P], the row that each weight belongs to.
        ids: int64 [N], >= 0, ids of the rows; unique over all ranks within a segment.
        fraction: share of the total of all ranks, in [0, 1]; its decimal value counts, of at most 9 places.
        ranks: the job.
        n_segments: number of segments.

    Returns:
        bool [P]; the same ids at every world size. The sums are exact. A segment whose total is zero selects
        nothing.

    Raises:
        ValueError: for a fraction outside [0, 1] or with more places.
    """
    share = decimal_share(fraction)
    if not 0 <= share <= 1 or share.denominator > 10**9:
        raise ValueError(
            f"integer_mass_prefix: fraction must be in [0, 1] with at most 9 decimals, got {fraction}"
        )
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


def _kth(
    keys: Tensor,
    digits: tuple[int, ...],
    k: Tensor,
    segments: Tensor,
    ranks: Ranks,
) -> tuple[Tensor, Tensor]:
    """Find the k-th smallest key of each segment.

    Args:
        keys: int64 [N_rank] >= 0, below 2^sum(digits).
        digits: bits per round.
        k: int64 [S], 1-based and at most the segment's size; 0 gives the threshold -1.
        segments: int64 [N_rank].
        ranks: the job.

    Returns:
        threshold [S], and left [S]: how many of the rows equal to it are among the k.
    """
    left, prefix, shift = k.clone(), torch.zeros_like(k), sum(digits)
    for width in digits:
        shift -= width
        counts = _histogram(keys, prefix, shift, width, segments, None, ranks)
        digit, left = _descend(counts, left)
        prefix = (prefix << width) | digit
    return torch.where(k > 0, prefix, -1), torch.where(k > 0, left, 0)


def _descend(counts: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """Find the digit [S] at which counts [S, digits] reach `left` [S], and how many are left before it."""
    ends = counts.cumsum(1)
    digit = (ends < left[:, None]).sum(1).clamp(max=counts.shape[1] - 1)
    return digit, left - (ends - counts).gather(1, digit[:, None]).squeeze(1)


def _mass_threshold(
    keys: Tensor, mantissas: Tensor, share: Fraction, segments: Tensor, n_segments: int, ranks: Ranks
) -> tuple[list[int], list[int]]:
    """Find, per segment, the key at which the mass of the rows before it and of some equal to it suffices.

    Masses are integers: a score is mantissa * 2^max(exponent, 1), in units of the smallest positive float.

    Returns:
        threshold (-1: select nothing) and how many rows equal to it are needed, one of each per segment.
    """
    prefix = torch.zeros(n_segments, dtype=torch.int64, device=keys.device)
    missing: list[int] = []
    shift = sum(_SCORE_DIGITS)
    for width in _SCORE_DIGITS:
        shift -= width
        sums = _histogram(keys, prefix, shift, width, segments, mantissas, ranks).tolist()
        chosen = []
        for segment, (start, row) in enumerate(zip(prefix.tolist(), sums, strict=True)):
            masses = [
                mass << _exponent((start << width | digit) << shift) if mass else 0
                for digit, mass in enumerate(row)
            ]
            if not missing or len(missing) <= segment:
                total = sum(masses)
                missing.append(-(-total * share.numerator // share.denominator))
            digit = 0
            while digit < len(masses) - 1 and masses[digit] < missing[segment]:
                missing[segment] -= masses[digit]
                digit += 1
            chosen.append(digit)
        prefix = (prefix << width) | torch.tensor(chosen, device=keys.device)
    threshold, left = prefix.tolist(), []
    for segment, key in enumerate(threshold):
        bits = (1 << 31) - 1 - key
        score = (bits & ((1 << _MANTISSA_BITS) - 1) | (bits >> _MANTISSA_BITS > 0) << _MANTISSA_BITS) << (
            _exponent(key)
        )
        left.append(-(-missing[segment] // score) if missing[segment] > 0 else 0)
        if missing[segment] <= 0:
            threshold[segment] = -1
    return threshold, left


def _exponent(key: int) -> int:
    """Return the exponent of the score with this key, which follows from the key's first digit."""
    return max(((1 << 31) - 1 - key) >> _MANTISSA_BITS, 1)


def _histogram(
    keys: Tensor,
    prefix: Tensor,
    shift: int,
    width: int,
    segments: Tensor,
    weights: Tensor | None,
    ranks: Ranks,
) -> Tensor:
    """Count (or add up the weights of) the keys under each segment's prefix, by their next digit.

    Returns:
        int64 [S, 2^width], summed over the ranks.
    """
    heads = keys >> shift
    under = (heads >> width == prefix[segments]).nonzero().squeeze(1)
    bins = (segments[under] << width) | (heads[under] & ((1 << width) - 1))
    counts = torch.zeros(len(prefix) << width, dtype=torch.int64, device=keys.device)
    counts.index_add_(0, bins, torch.ones_like(bins) if weights is None else weights[under])
    return ranks.all_reduce(counts).view(len(prefix), 1 << width)


def _with_ties(
    keys: Tensor, ids: Tensor, threshold: Tensor, left: Tensor, segments: Tensor, ranks: Ranks
) -> Tensor:
    """Mark the rows below their segment's threshold and, of those equal to it, the `left` smallest ids."""
    limit = threshold[segments]
    tied = (keys == limit).nonzero().squeeze(1)
    chosen = keys < limit
    counts = torch.zeros_like(left).index_add_(0, segments[tied], torch.ones_like(tied))
    if not bool((ranks.all_reduce(counts) > left).any()):
        # The usual case: all tied rows are selected.
        chosen[tied] = True
        return chosen
    last, _ = _kth(ids[tied], _ID_DIGITS, left, segments[tied], ranks)
    chosen[tied] = ids[tied] <= last[segments[tied]]
    return chosen
