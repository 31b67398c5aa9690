# SPDX-License-Identifier: Apache-2.0
"""Adds random noise to the means of almost transparent Gaussians (3DGS-MCMC)."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs._library import below_autograd


def position_noise_(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    ids: Tensor,
    visible_ids: Tensor,
    *,
    seed: int,
    step: int,
    threshold: float,
    strength: float,
) -> None:
    """Add noise to the means of the listed Gaussians, in place; more transparent Gaussians move farther.

    ``means += strength * sigmoid(100 (threshold - opacity)) * Sigma n`` with the covariance Sigma and n
    standard normal (3DGS-MCMC, Kheradmand et al. 2024, eq. 8 and 9). The draws depend on (id, seed, step)
    alone.

    Args:
        means: [N, 3], float32 (CPU also float64).
        quats: [N, 4], (w, x, y, z), unnormalised.
        scales: [N, 3], logarithms.
        opacities: [N], logits.
        ids: int64 [N], persistent.
        visible_ids: int32 [U], the rows to move, each once.
        seed: seed of the run.
        step: optimiser step; each step draws other numbers.
        threshold: opacity at which the noise falls to a half, in [0, 1].
        strength: inverse length in the unit of the means.

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    with below_autograd():
        torch.ops.blitzgs.position_noise_(
            means, quats, scales, opacities, ids, visible_ids, seed, step, threshold, strength
        )
