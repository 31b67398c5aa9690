# SPDX-License-Identifier: Apache-2.0
"""What changes of the population need: statistics, noise, the formula of relocation, trees, voxels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs._library import below_autograd

CELL_BITS = 21  # of a voxel, per axis


def density_stats_(
    grad_sum: Tensor,
    grad_count: Tensor,
    max_radii: Tensor,
    visible_ids: Tensor,
    splat_offsets: Tensor,
    v_means2d: Tensor,
    conics: Tensor,
    width: int,
    height: int,
    weight: float,
    phi: Tensor | None = None,
) -> None:
    """Add one step's splats to the statistics of the visible Gaussians, in place.

    Per splat: ``grad_sum += phi * weight * |v_means2d * (width / 2, height / 2)|``, ``grad_count += 1`` and
    ``max_radii = max(max_radii, ceil(3 sigma))`` (Kerbl et al. 2023, section 5; its normalised units).

    Args:
        grad_sum: [N], float32 (CPU also float64).
        grad_count: int32 [N].
        max_radii: [N], pixels, dtype of `grad_sum`.
        visible_ids: int32 [U], Gaussians with splats, each once.
        splat_offsets: int32 [U + 1]; splats splat_offsets[u] to splat_offsets[u + 1] are of visible_ids[u].
        v_means2d: [P, 2], gradient of the step's loss by the projected means, per pixel; rows may be strided.
        conics: [P, 3], inverse 2D covariances (a, b, c).
        width: image width in pixels.
        height: image height in pixels.
        weight: factor from the gradient of the step's loss to the gradient of one view's loss: B when the
            step's loss is a mean over B views.
        phi: [N], factor of each Gaussian's gradient; None = 1.
    """
    with below_autograd():
        statistics = grad_sum, grad_count, max_radii
        splats = visible_ids, splat_offsets, v_means2d, conics
        torch.ops.blitzgs.density_stats_(*statistics, *splats, phi, width, height, weight)


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
    standard normal (3DGS-MCMC, Kheradmand et al. 2024, eq. 8). The draws depend on (id, seed, step)
    alone.

    Args:
        means: [N, 3], float32 (CPU also float64).
        quats: [N, 4], (w, x, y, z), unnormalised.
        scales: [N, 3], logarithms.
        opacities: [N], logits.
        ids: int64 [N], persistent.
        visible_ids: int32 [U], the rows to move, each once.
        step: optimiser step; each step draws other numbers.
        threshold: opacity at which the noise falls to a half, in [0, 1].
        strength: inverse length in the unit of the means.
    """
    with below_autograd():
        torch.ops.blitzgs.position_noise_(
            means, quats, scales, opacities, ids, visible_ids, seed, step, threshold, strength
        )


def limit_scales_(scales: Tensor, means: Tensor, visible_ids: Tensor, *, share: float, extent: float) -> None:
    """Limit the axes of the listed Gaussians, in place, by their distance from the middle of the cameras.

    ``scales = min(scales, log(share * max(extent, |mean|)))``

    Args:
        scales: [N, 3], logarithms, float32 (CPU also float64).
        means: [N, 3], relative to the middle of the cameras.
        visible_ids: int32 [U], the rows to limit, each once.
        share: positive, of the distance.
        extent: positive, the least distance, in the unit of the means.
    """
    with below_autograd():
        torch.ops.blitzgs.limit_scales_(scales, means, visible_ids, share, extent)


# Largest number of copies of one Gaussian in one event, itself included; 3DGS-MCMC's code has the same limit.
MAX_COPIES = 51


def overlap(opacities: Tensor, copies: Tensor) -> Tensor:
    """Return the integral of what N equal Gaussians at one position composite, over that of one of opacity 1.

    sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k + 1), along a line through the centre
    (Kheradmand et al. 2024, eq. 9).

    Args:
        opacities: o, float64 [M]; the sum alternates, and its terms exceed it by up to 10^5.
        copies: N, int64 [M], 1 to `MAX_COPIES`.
    """
    return torch.ops.blitzgs.overlap(opacities, copies)


def draw_weights(opacities: Tensor, causes: Tensor) -> Tensor:
    """Return opacities as weights of a draw, int64 [N], in units of 2^-31; 0 for rows with a cause of death.

    `opacities`: float32 [N], logits. `causes`: uint8 [N].
    """
    return torch.ops.blitzgs.draw_weights(opacities, causes)


def residual_draws(
    weights: Tensor, ids: Tensor, draws: int, total: int, seed: int, event: int
) -> tuple[Tensor, Tensor]:
    """Divide draws in proportion to weights: whole numbers for certain, and keys that draw the rest.

    Residual resampling (Liu and Chen 1998): row i gets floor(draws w_i / total) draws; those that are left go
    to the rows with the smallest keys, which are `sampling_keys` of what the rows are short of.

    Args:
        weights: w, int64 [N], 0 to 2^31.
        ids: int64 [N], persistent.
        draws: below 2^31.
        total: sum of the weights of all ranks, positive.
        event: number that differs between draws.

    Returns:
        Whole draws, int64 [N], and keys, float32 [N].
    """
    return torch.ops.blitzgs.residual_draws(weights, ids, draws, total, seed, event)


def share_rows_(
    opacities: Tensor, scales: Tensor, moments: Sequence[Tensor], rows: Tensor, copies: Tensor, least: float
) -> None:
    """Let rows of a table stand for several copies each, in place.

    Opacities and scales become those of `blitzgs.population.relocation.shared_among_copies`. Moments are
    scaled as the gradients are: each of N Gaussians in one place has 1/N of the gradient of the Gaussian
    before, and that of the logit of its opacity o changes by o' / o, since (1 - o')^N = 1 - o.

    Args:
        opacities: float32 [N], logits.
        scales: float32 [N, 3], logarithms.
        moments: Adam's first moments of the five parameters, then the second ones, float32 [N, ...].
        rows: int64 [M], each at most once; not checked.
        copies: int64 [M], 1 to `MAX_COPIES`; the row itself is one.
        least: sharing does not reduce a logit below this.
    """
    torch.ops.blitzgs.share_rows_(opacities, scales, list(moments), rows, copies, least)


@torch.no_grad()
def tree_sums(features: Tensor, roots: Tensor, nodes: Tensor, leaves: Tensor, depth: int) -> Tensor:
    """Return, for each row of features, the sum of the leaf values that it reaches in all trees.

    Args:
        features: float32 [M, F], F <= 32; NaN: unknown.
        roots: int32 [T], the first node of each tree.
        nodes: int32 [n, 4]: the bits of the float32 threshold below which a row goes left; twice the number
            of the feature that is compared, plus 1 where NaN goes left; the left child, -1 for a leaf; and
            the right one. Children and features must be in range: the kernel does not check them.
        leaves: int64 [n]; read at leaves.
        depth: largest number of comparisons on a path from a root to a leaf.

    Returns:
        int64 [M], the same bits on every device.
    """
    return torch.ops.blitzgs.tree_sums(features, roots, nodes, leaves, depth)


def voxel_keys(points: Tensor, origin: Sequence[float], voxel_size: float) -> Tensor:
    """Return the voxel of each point: ``x | y << 21 | z << 42`` with ``floor((p - origin) / voxel_size)``.

    Cells are clamped to [0, 2^21); equal keys mean the same voxel.

    Args:
        points: positions [N, 3], any floating dtype and unit; the cells are computed in float64.
        origin: lower corner of the grid, 3 values in the same unit.
        voxel_size: edge of a voxel in the same unit, > 0.

    Returns:
        int64 [N]; -1 for a point that is not finite.
    """
    corner = torch.tensor(origin, dtype=torch.float64, device=points.device)
    cells = ((points.double() - corner) / voxel_size).floor().clamp(0, (1 << CELL_BITS) - 1)
    x, y, z = cells.long().unbind(1)
    keys = x | y << CELL_BITS | z << 2 * CELL_BITS
    return keys.where(points.isfinite().all(dim=1), -1)
