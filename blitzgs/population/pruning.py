# SPDX-License-Identifier: Apache-2.0
"""The two pruning passes (BlitzGS, section 3.2), with the same result at every world size."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import decimal_share, mass_prefix, smallest
from blitzgs.ops.counter_random import sampling_keys


def sample_by_score(score: Tensor, ids: Tensor, keep: float, seed: int, event: int, ranks: Ranks) -> Tensor:
    """Draw the Gaussians that pass 1 keeps: without replacement, with probability proportional to score.

    The Gaussians with the floor(keep N) smallest values of -log(u) / score are kept (exponential races,
    Efraimidis and Spirakis 2006), where u depends only on (seed, event, id). A Gaussian with score zero is
    kept only if all with positive scores are.

    Args:
        score: float32 [N_rank], >= 0.
        ids: int64 [N_rank], persistent.
        keep: share of all ranks' N Gaussians, in [0, 1]; its decimal value counts.
        event: number that differs between draws, such as the time of the pass.
        ranks: the job; every rank calls this.

    Returns:
        bool [N_rank], the same ids at every world size.
    """
    return smallest(sampling_keys(score, ids, seed, event), ids, _share_of_all(keep, score, ranks), ranks)


def top_by_score(score: Tensor, ids: Tensor, mass: float, keep: float, ranks: Ranks) -> Tensor:
    """Choose the Gaussians that pass 2 keeps: a prefix of the order by descending score.

    Args:
        score: float32 [N_rank], finite, >= 0.
        ids: int64 [N_rank], persistent; they decide between equal scores.
        mass: the prefix is the shortest that holds this share of the total score of all ranks, in [0, 1].
        keep: the prefix has at most floor(keep N) of all ranks' N Gaussians; in [0, 1], its decimal value
            counts.
        ranks: the job; every rank calls this.

    Returns:
        bool [N_rank], the same ids at every world size.
    """
    kept = mass_prefix(score, ids, mass, ranks)
    if keep < 1:
        kept &= smallest(-score, ids, _share_of_all(keep, score, ranks), ranks)
    return kept


def _share_of_all(share: float, rows: Tensor, ranks: Ranks) -> int:
    """Return the floor of a share, by its decimal value, of the rows of all ranks."""
    total = ranks.all_reduce(torch.tensor(len(rows), device=rows.device))
    return math.floor(decimal_share(share) * int(total))
