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
    grad_sum: Tensor,  # [N], float32 (CPU also float64)
    grad_count: Tensor,  # int32 [N]
    max_radii: Tensor,  # [N], pixels, dtype of `grad_sum`
    visible_ids: Tensor,  # int32 [U], Gaussians with splats, each once
    splat_offsets: Tensor,  # int32 [U + 1]: where the splats of each of these begin
    v_means2d: Tensor,  # [P, 2], gradient of the step's loss, per pixel; rows may be strided
    conics: Tensor,  # [P, 3], inverse 2D covariances (a, b, c)
    width: int,  # image width in pixels
    height: int,  # image height in pixels
    weight: float,  # number of views B whose mean loss is the step's; else the factor to one view's loss
    phi: Tensor | None = None,  # [N], factor of each Gaussian's gradient; None = 1
) -> None:
    """Add one step's splats to the statistics of the visible Gaussians, in place.

    Per splat: ``grad_sum += phi * weight * |v_means2d * (width / 2, height / 2)|``, ``grad_count += 1`` and
    ``max_radii = max(max_radii, ceil(3 sigma))`` (Kerbl et al. 2023, section 5; its normalised units).
    """
    with below_autograd():
        statistics = grad_sum, grad_count, max_radii
        splats = visible_ids, splat_offsets, v_means2d, conics
        torch.ops.blitzgs.density_stats_(*statistics, *splats, phi, width, height, weight)


def position_noise_(
    means: Tensor,  # [N, 3], float32 (CPU also float64)
    quats: Tensor,  # [N, 4], (w, x, y, z), unnormalised
    scales: Tensor,  # [N, 3], logarithms
    opacities: Tensor,  # [N], logits
    ids: Tensor,  # int64 [N], persistent
    visible_ids: Tensor,  # int32 [U], the rows to move, each once
    *,
    seed: int,
    step: int,  # optimiser step; each step draws other numbers
    threshold: float,  # opacity at which the noise falls to a half, in [0, 1]
    strength: float,  # inverse length in the unit of the means
) -> None:
    """Add noise to the means of the listed Gaussians, in place; more transparent Gaussians move farther.

    ``means += strength * sigmoid(100 (threshold - opacity)) * Sigma n`` with the covariance Sigma and n
    standard normal (3DGS-MCMC, Kheradmand et al. 2024, eq. 8). The draws depend on (id, seed, step)
    alone.
    """
    with below_autograd():
        torch.ops.blitzgs.position_noise_(
            means, quats, scales, opacities, ids, visible_ids, seed, step, threshold, strength
        )


def limit_scales_(
    scales: Tensor,  # [N, 3], logarithms, float32 (CPU also float64)
    means: Tensor,  # [N, 3], relative to the middle of the cameras
    visible_ids: Tensor,  # int32 [U], the rows to limit, each once
    *,
    share: float,  # positive, of the distance
    extent: float,  # positive, the least distance, in the unit of the means
) -> None:
    """Limit the axes of the listed Gaussians, in place, by their distance from the middle of the cameras.

    ``scales = min(scales, log(share * max(extent, |mean|)))``
    """
    with below_autograd():
        torch.ops.blitzgs.limit_scales_(scales, means, visible_ids, share, extent)


# Largest number of copies of one Gaussian in one event, itself included; 3DGS-MCMC's code has the same limit.
MAX_COPIES = 51


def overlap(
    opacities: Tensor,  # o, float64 [M]; the sum alternates, and its terms exceed it by up to 10^5
    copies: Tensor,  # N, int64 [M], 1 to `MAX_COPIES`
) -> Tensor:
    """Return the integral of what N equal Gaussians at one position composite, over that of one of opacity 1.

    sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o^(k+1) / sqrt(k + 1), along a line through the centre
    (Kheradmand et al. 2024, eq. 9).
    """
    return torch.ops.blitzgs.overlap(opacities, copies)


def draw_weights(opacities: Tensor, causes: Tensor) -> Tensor:
    """Return opacities as weights of a draw, int64 [N], in units of 2^-31; 0 for rows with a cause of death.

    `opacities`: float32 [N], logits. `causes`: uint8 [N].
    """
    return torch.ops.blitzgs.draw_weights(opacities, causes)


def residual_draws(
    weights: Tensor,  # w, int64 [N], 0 to 2^31
    ids: Tensor,  # int64 [N], persistent
    draws: int,  # below 2^31
    total: int,  # sum of the weights of all ranks, positive
    seed: int,
    event: int,  # number that differs between draws
) -> tuple[Tensor, Tensor]:
    """Divide draws in proportion to weights: whole numbers for certain, and keys that draw the rest.

    Residual resampling (Liu and Chen 1998): row i gets floor(draws w_i / total) draws; those that are left go
    to the rows with the smallest keys, which are `sampling_keys` of what the rows are short of. Returns whole
    draws, int64 [N], and keys, float32 [N].
    """
    return torch.ops.blitzgs.residual_draws(weights, ids, draws, total, seed, event)


def share_rows_(
    opacities: Tensor,  # float32 [N], logits
    scales: Tensor,  # float32 [N, 3], logarithms
    moments: Sequence[Tensor],  # Adam's first moments of all parameters, then the second ones
    rows: Tensor,  # int64 [M], each at most once; not checked
    copies: Tensor,  # int64 [M], 1 to `MAX_COPIES`; the row itself is one
    least: float,  # sharing does not reduce a logit below this
) -> None:
    """Let rows of a table stand for several copies each, in place.

    Opacities and scales become those of `blitzgs.population.relocation.shared_among_copies`. Moments are
    scaled as the gradients are: each of N Gaussians in one place has 1/N of the gradient of the Gaussian
    before, and that of the logit of its opacity o changes by o' / o, since (1 - o')^N = 1 - o.
    """
    torch.ops.blitzgs.share_rows_(opacities, scales, list(moments), rows, copies, least)


@torch.no_grad()
def tree_sums(
    features: Tensor,  # float32 [M, F], F <= 32; NaN: unknown
    roots: Tensor,  # int32 [T], the first node of each tree
    # int32 [n, 4]: the bits of the float32 threshold below which a row goes left; twice the number of the
    # feature that is compared, plus 1 where NaN goes left; the left child, -1 for a leaf; and the right one.
    # Children and features must be in range: the kernel does not check them.
    nodes: Tensor,
    leaves: Tensor,  # int64 [n]; read at leaves
    depth: int,  # largest number of comparisons on a path from a root to a leaf
) -> Tensor:
    """Return the sum of the leaves that each row reaches in all trees, int64 [M], the same everywhere."""
    return torch.ops.blitzgs.tree_sums(features, roots, nodes, leaves, depth)


def voxel_keys(
    points: Tensor,  # positions [N, 3], any floating dtype and unit; the cells are computed in float64
    origin: Sequence[float],  # lower corner of the grid, 3 values in the same unit
    voxel_size: float,  # edge of a voxel in the same unit, > 0
) -> Tensor:
    """Return the voxel of each point: ``x | y << 21 | z << 42`` with ``floor((p - origin) / voxel_size)``.

    Cells are clamped to [0, 2^21); equal keys mean the same voxel. Returns int64 [N]; -1 for a point that is
    not finite.
    """
    corner = torch.tensor(origin, dtype=torch.float64, device=points.device)
    cells = ((points.double() - corner) / voxel_size).floor().clamp(0, (1 << CELL_BITS) - 1)
    x, y, z = cells.long().unbind(1)
    keys = x | y << CELL_BITS | z << 2 * CELL_BITS
    return keys.where(points.isfinite().all(dim=1), -1)
