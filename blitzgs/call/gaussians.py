# SPDX-License-Identifier: Apache-2.0
"""Parts of a trainer: covariances, relocation, noise and neighbours of Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.population import MAX_COPIES, overlap, position_noise_
from blitzgs.util.errors import check_tensors
from blitzgs.util.rotations import quaternion_matrices

_TRIANGLE = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances R diag(s^2) R^T and their inverses, as gsplat's function of this name.

    R is the rotation of a quaternion (3DGS, Kerbl et al. 2023, eq. 6). Differentiable, any number of times.

    Args:
        quats: [..., 4] (w, x, y, z), floating point, of any length but zero.
        scales: [..., 3] standard deviations, in world units.
        compute_covar, compute_preci: whether covariances and inverses (infinite for scales of 0) are wanted.
        triu: whether to return (xx, xy, xz, yy, yz, zz), [..., 6].

    Returns:
        Two of [..., 3, 3], or None for what is not wanted.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape does not fit.
    """
    check_tensors(quats=quats, scales=scales)
    if quats.shape[-1:] != (4,) or scales.shape != (*quats.shape[:-1], 3):
        raise ValueError(
            f"quats must be [..., 4] and scales [..., 3], got {list(quats.shape)} and {list(scales.shape)}"
        )
    rotations = quaternion_matrices(quats / quats.norm(dim=-1, keepdim=True))

    def product(lengths: Tensor) -> Tensor:
        axes = rotations * lengths.unsqueeze(-2)
        matrices = axes @ axes.mT
        return matrices[..., _TRIANGLE[0], _TRIANGLE[1]] if triu else matrices

    return product(scales) if compute_covar else None, product(1 / scales) if compute_preci else None


@torch.no_grad()
def relocate(
    opacities: Tensor, scales: Tensor, ratios: Tensor, min_opacity: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Return opacity and scales for each of n Gaussians at one position that together look like one.

    ``o' = max(1 - (1 - o)^(1/n), min_opacity)`` and ``s' = s o / overlap(o', n)``, computed in float64
    (3DGS-MCMC, Kheradmand et al. 2024, eq. 9; `blitzgs.ops.population.overlap`): gsplat's
    `compute_relocation`, whose table of binomials is not needed. Not differentiable.

    Args:
        opacities: o, [N] in (0, 1].
        scales: s, [N, 3] standard deviations.
        ratios: n, whole numbers [N], limited to 1 to 51.
        min_opacity: lower limit of o'. 0 for gsplat 1.5, which has none.

    Returns:
        o' [N] and s' [N, 3], dtype of the arguments.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a tensor, or `min_opacity` is a table.
    """
    check_tensors(opacities=opacities, scales=scales, ratios=ratios)
    if opacities.dim() != 1 or scales.shape != (len(opacities), 3) or ratios.shape != opacities.shape:
        raise ValueError(
            f"opacities and ratios must be [N] and scales [N, 3], got {list(opacities.shape)}, "
            f"{list(ratios.shape)} and {list(scales.shape)}"
        )
    if isinstance(min_opacity, Tensor) and min_opacity.dim() > 0:  # gsplat's fourth argument
        raise TypeError(f"min_opacity must be a number, got {list(min_opacity.shape)}; leave out binoms")
    copies = ratios.long().clamp(1, MAX_COPIES)
    before = opacities.double()
    shared = (-torch.expm1(torch.log1p(-before) / copies)).clamp(min=min_opacity)
    factor = before / overlap(shared, copies)
    return shared.to(opacities.dtype), (scales.double() * factor[:, None]).to(scales.dtype)


@torch.no_grad()
def position_noise(
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    scaler: float,
    *,
    seed: int,
    step: int,
    threshold: float = 0.005,
) -> Tensor:
    """Return noise to add to means: the more transparent a Gaussian, the farther it moves.

    ``scaler sigmoid(100 (threshold - o)) Sigma n`` with the covariance Sigma and n standard normal
    (3DGS-MCMC, Kheradmand et al. 2024, eq. 8): what gsplat's `inject_noise_to_position` adds, without a
    tensor of matrices. The numbers depend on (row, seed, step) alone, not on torch's generator.

    Args:
        quats: [N, 4] (w, x, y, z), of any length, float32 (CPU also float64).
        scales: [N, 3], logarithms.
        opacities: [N] or [N, 1], logits.
        scaler: inverse length; gsplat's MCMCStrategy passes the learning rate of the means times 5e5.
        seed, step: of the run, 0 to 2^63 - 1; each step draws other numbers.
        threshold: opacity at which the noise falls to a half.

    Returns:
        [N, 3] in the unit of the means, dtype of `quats`.

    Raises:
        TypeError: an argument is not a tensor.
        RuntimeError, ValueError: wrong shapes or dtypes.
    """
    check_tensors(quats=quats, scales=scales, opacities=opacities)
    if opacities.numel() != len(quats):
        raise ValueError(
            f"opacities must be [N] or [N, 1] with N = {len(quats)}, got {list(opacities.shape)}"
        )
    rows = torch.arange(len(quats), device=quats.device)
    noise = quats.new_zeros(len(quats), 3)
    position_noise_(
        noise, quats, scales, opacities.reshape(len(quats)), rows, rows.int(), seed=seed, step=step,
        threshold=threshold, strength=scaler,
    )  # fmt: skip
    return noise


def knn(points: Tensor, k: int) -> Tensor:
    """Return the distances of every point to its k nearest other points, ascending.

    The point itself is not among them: of the `knn(x, K=4)` in gsplat's examples, they are columns 1 to 3
    with k = 3. Exact; duplicates are at distance 0 of each other. Not differentiable.

    Args:
        points: [N, 3], float32 (CPU also float64), any unit.
        k: number of neighbours, 1 to 32.

    Returns:
        [N, k], dtype and unit of `points`; infinity for a row that is not finite and where fewer than k
        other finite points exist.

    Raises:
        TypeError: `points` is not a tensor.
        RuntimeError: wrong shape or dtype, or k outside its range.
    """
    check_tensors(points=points)
    return knn_distances(points, k)
