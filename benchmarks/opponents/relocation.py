# SPDX-License-Identifier: Apache-2.0
"""What gsplat's MCMCStrategy takes from its CUDA extension, so that its wheel serves without that."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

# gsplat tabulates the binomial coefficients up to here; a Gaussian is split into no more parts at once.
MOST_PARTS = 51


@lru_cache(maxsize=4)
def _series(device: torch.device) -> Tensor:
    """Return (-1)^(j-1) C(n, j) / sqrt(j) at row n, column j, float64 [52, 52]; 0 for j = 0 or j > n."""
    table = torch.zeros(MOST_PARTS + 1, MOST_PARTS + 1, dtype=torch.float64)
    for n in range(1, MOST_PARTS + 1):
        for j in range(1, n + 1):
            table[n, j] = (-1) ** (j - 1) * math.comb(n, j) / math.sqrt(j)
    return table.to(device)


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return opacity and scales of each of the N Gaussians that together look as one does.

    "3D Gaussian Splatting as Markov Chain Monte Carlo" (arXiv 2404.09591), equation 9. With the new opacity
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
    parts = ratios.clamp(1, MOST_PARTS).long()
    old = opacities.double()
    new = 1.0 - (1.0 - old) ** (1.0 / parts)
    powers = new[:, None] ** torch.arange(MOST_PARTS + 1, device=new.device)
    denominator = (_series(new.device)[parts] * powers).sum(dim=1)
    factor = (old / denominator).to(scales.dtype)
    return new.to(opacities.dtype), scales * factor[:, None]


def use_in(strategy_ops: Any, torch_reference: Any) -> None:
    """Let gsplat's strategies call plain PyTorch where they would call CUDA kernels.

    Args:
        strategy_ops: the module `gsplat.strategy.ops`.
        torch_reference: the module `gsplat.cuda._torch_impl`, gsplat's own reference of its kernels.
    """
    strategy_ops.compute_relocation = compute_relocation
    strategy_ops.quat_scale_to_covar_preci = torch_reference._quat_scale_to_covar_preci
