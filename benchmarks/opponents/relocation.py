# SPDX-License-Identifier: Apache-2.0
"""Two functions of gsplat's CUDA extension that MCMCStrategy calls, so that it runs without the extension."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

# gsplat tabulates the binomial coefficients up to this number, the largest number of parts of a Gaussian.
MAX_PARTS = 51


@lru_cache(maxsize=4)
def _series(device: torch.device) -> Tensor:
    """Return (-1)^(j-1) C(n, j) / sqrt(j) at row n, column j, float64 [52, 52]; 0 for j = 0 or j > n."""
    table = torch.zeros(MAX_PARTS + 1, MAX_PARTS + 1, dtype=torch.float64)
    for n in range(1, MAX_PARTS + 1):
        for j in range(1, n + 1):
            table[n, j] = (-1) ** (j - 1) * math.comb(n, j) / math.sqrt(j)
    return table.to(device)


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return opacity and scales of each of N Gaussians that together look like one Gaussian.

    The formula is equation 9 of "3D Gaussian Splatting as Markov Chain Monte Carlo" (arXiv 2404.09591). With
    the new opacity
    a = 1 - (1 - o)^(1/N), the scales are multiplied by
    o / sum_{i=1..N} sum_{k=0..i-1} C(i-1, k) (-1)^k a^(k+1) / sqrt(k + 1).
    The sum over i of C(i-1, k) is C(N, k + 1), which leaves one sum.

    Args:
        opacities: o, [M], after the sigmoid.
        scales: [M, 3], standard deviations.
        ratios: N, int [M], taken as at most 51.
        binoms: gsplat's table of binomial coefficients; not needed here.

    Returns:
        (opacities [M], scales [M, 3]).
    """
    parts = ratios.clamp(1, MAX_PARTS).long()
    old = opacities.double()
    new = 1.0 - (1.0 - old) ** (1.0 / parts)
    powers = new[:, None] ** torch.arange(MAX_PARTS + 1, device=new.device)
    denominator = (_series(new.device)[parts] * powers).sum(dim=1)
    factor = (old / denominator).to(scales.dtype)
    return new.to(opacities.dtype), scales * factor[:, None]


def covariances(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor, None]:
    """Return R S S^T R^T of each Gaussian, [N, 3, 3]; replaces gsplat's `quat_scale_to_covar_preci`.

    The products are written out, because a batched product of such small matrices would take most of a step.

    Args:
        quats: [N, 4] (w, x, y, z), need not be normalised.
        scales: [N, 3], standard deviations.
        compute_covar: only True.
        compute_preci: only False.
        triu: only False.
    """
    if not compute_covar or compute_preci or triu:
        raise NotImplementedError("only whole covariance matrices")
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(dim=1)
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    variances = scales.square().unbind(dim=1)
    entries = [
        sum(a * b * v for a, b, v in zip(rotation[i], rotation[j], variances, strict=True))
        for i in range(3)
        for j in range(3)
    ]
    return torch.stack(entries, dim=1).view(-1, 3, 3), None


def use_in(strategy_ops: Any) -> None:
    """Replace the CUDA functions of the module `gsplat.strategy.ops` by those of this module."""
    strategy_ops.compute_relocation = compute_relocation
    strategy_ops.quat_scale_to_covar_preci = covariances
