# SPDX-License-Identifier: Apache-2.0
"""The formula by which copies of a Gaussian share its opacity and size (3DGS-MCMC)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Largest number of copies of one Gaussian in one event, itself included; 3DGS-MCMC's code has the same limit.
MAX_COPIES = 51


def overlap(opacities: Tensor, copies: Tensor) -> Tensor:
    """Return the integral of what N equal Gaussians at one position composite, over that of one of opacity 1.

    sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k + 1), along a line through the centre
    (Kheradmand et al. 2024, eq. 9). The sum over i of C(i-1, k) is C(N, k+1), which leaves one sum.

    Args:
        opacities: o, float64 [M]; the sum alternates, and its terms exceed it by up to 10^5.
        copies: N, int64 [M], 1 to `MAX_COPIES`.
    """
    n = copies.double()
    term, total = torch.full_like(n, -1.0), torch.zeros_like(n)
    # Terms with k > N are zero. Few rows have many copies, so reading the largest N saves most of the terms.
    most = int(copies.max()) if copies.shape[0] > 0 else 0
    for k in range(1, most + 1):
        term = term * (n - (k - 1)) / k * -opacities
        total += term / math.sqrt(k)
    return total
