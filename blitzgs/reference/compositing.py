# SPDX-License-Identifier: Apache-2.0
"""Front-to-back alpha compositing of every splat at every pixel, and which pixels lie on a cut."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

ALPHA_CUT = 1.0 / 255.0
ALPHA_MAX = 0.99
MIN_TRANSMITTANCE = 1e-4


@dataclass
class Composite:
    """One image, float64."""

    values: Tensor  # [H, W, D]
    transmittances: Tensor  # [H, W]: what reaches the background
    cut: Tensor  # bool [H, W]: a comparison here is within the tolerance, so rounding may change its outcome


def composite(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    *,
    tolerance: float = 1e-4,
) -> Composite:
    """Composite M splats that are ordered front to back.

    alpha = min(0.99, o exp(-q / 2)), q the Mahalanobis distance of the pixel centre; a splat takes part where
    alpha >= 1/255; one that would take the transmittance below 1e-4 is left out and ends the pixel.

    Args:
        means2d: [M, 2] px.
        conics: [M, 3].
        opacities: [M].
        colors: [M, D].
        depths: [M], ascending.
        width: px.
        height: px.
        tolerance: relative distance within which alpha (to 1/255 or 0.99), transmittance (to 1e-4) or the
            depths of two consecutive splats of a pixel count as undecided.
    """
    unclipped, alphas, before, after, weights = _weights(means2d, conics, opacities, width, height)
    values = torch.einsum("mp,md->pd", weights, colors)
    transmittances = torch.where(weights > 0, 1 - alphas, torch.ones_like(alphas)).prod(dim=0)
    cut = _cut(unclipped.detach(), after.detach(), before.detach(), depths.detach(), tolerance)
    shape = (height, width)
    return Composite(values.reshape(*shape, -1), transmittances.reshape(shape), cut.reshape(shape))


def composited_weights(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return alpha T of M splats, ordered front to back, at every pixel [M, H, W], and the cut pixels [H, W].

    See `composite`; alpha T is zero where a splat is not composited, and positive where it is.
    """
    unclipped, _, before, after, weights = _weights(means2d, conics, opacities, width, height)
    cut = _cut(unclipped, after, before, depths, 1e-4)
    return weights.reshape(-1, height, width), cut.reshape(height, width)


def _weights(
    means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return alpha before clipping, alpha, T before and after it, and alpha T where composited, [M, H W]."""
    alphas, unclipped = _alphas(means2d, conics, opacities, width, height)
    touched = alphas >= ALPHA_CUT
    alphas = torch.where(touched, alphas, torch.zeros_like(alphas))
    after = torch.cumprod(1 - alphas, dim=0)  # never increasing
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    composited = touched & (after >= MIN_TRANSMITTANCE)
    weights = torch.where(composited, alphas * before, torch.zeros_like(alphas))
    return unclipped, alphas, before, after, weights


def _alphas(
    means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return alpha [M, H W] clipped at 0.99 and before clipping."""
    columns = torch.arange(width, dtype=means2d.dtype, device=means2d.device) + 0.5
    rows = torch.arange(height, dtype=means2d.dtype, device=means2d.device) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    dx = x.reshape(1, -1) - means2d[:, :1]
    dy = y.reshape(1, -1) - means2d[:, 1:]
    a, b, c = conics[:, :, None].unbind(dim=1)
    unclipped = opacities[:, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    return unclipped.clamp(max=ALPHA_MAX), unclipped


def _cut(unclipped: Tensor, after: Tensor, before: Tensor, depths: Tensor, tolerance: float) -> Tensor:
    def near(value: Tensor, limit: float) -> Tensor:
        return (value - limit).abs() <= tolerance * limit

    # Splats behind the end of a pixel have no effect on it.
    reached = before >= MIN_TRANSMITTANCE * (1 - tolerance)
    undecided = near(unclipped, ALPHA_CUT) | near(unclipped, ALPHA_MAX) | near(after, MIN_TRANSMITTANCE)
    touched = unclipped >= ALPHA_CUT * (1 - tolerance)
    front = torch.where(touched, depths[:, None], -torch.inf).cummax(dim=0).values
    gap = depths[1:, None] - front[:-1]
    tie = touched.clone()
    tie[:1] = False
    # Equal depths are no cut: the index orders them.
    tie[1:] &= (gap > 0) & (gap <= tolerance * 1e-2 * depths[1:, None].abs())
    return ((undecided | tie) & reached).any(dim=0)


def median_splats(weights: Tensor) -> Tensor:
    """Return the last splat composited with a transmittance above 0.5 in front of it, int64 [H, W]; -1: none.

    Args:
        weights: alpha T of M splats, front to back, [M, H, W], zero where a splat is not composited.
    """
    before = 1 - (weights.cumsum(dim=0) - weights)
    numbers = torch.arange(len(weights))[:, None, None].expand_as(weights)
    return torch.where((weights > 0) & (before > 0.5), numbers, -1).amax(dim=0)


def strongest_splats(weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the splats of the largest weights, front to back, int64 [H, W, count], and their weights.

    Of equal weights, the splats in front. Padded with -1 and 0.

    Args:
        weights: as for `median_splats`.
        count: number of splats of a pixel.
    """
    weights = torch.cat([weights, weights.new_zeros(count, *weights.shape[1:])])
    largest = weights.argsort(dim=0, descending=True, stable=True)[:count].sort(dim=0).values
    kept = weights.gather(0, largest)
    ids = torch.where(kept > 0, largest, -1)
    # Splats without weight may stand between others: move them behind.
    order = (ids < 0).long().argsort(dim=0, stable=True)
    return ids.gather(0, order).movedim(0, -1), kept.gather(0, order).movedim(0, -1)
