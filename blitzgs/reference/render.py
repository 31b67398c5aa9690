# SPDX-License-Identifier: Apache-2.0
"""The whole image of one view: front-to-back compositing of every splat at every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.reference.projection import Splats, project_splats

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


@dataclass
class ReferenceImage:
    """One view, float64."""

    image: Tensor  # [H, W, D]: colour and, by the mode, depth as the last channel
    alpha: Tensor  # [H, W]
    cut: Tensor  # bool [H, W]: pixels where rounding may decide; see composite()
    splats: Splats


def render(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    render_mode: str = "RGB",
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    antialiased: bool = False,
    tolerance: float = 1e-4,
) -> ReferenceImage:
    """Render activated Gaussians into one view, differentiably, in float64.

    Args:
        means: [N, 3].
        quats: [N, 4] (w, x, y, z).
        scales: [N, 3] standard deviations.
        opacities: [N] in [0, 1].
        colors: SH coefficients [N, K, 3] with `sh_degree`, else values [N, D].
        viewmat: [4, 4] world to camera.
        K: [3, 3].
        width: px.
        height: px.
        sh_degree: degree to evaluate, or None.
        background: [D] colour behind everything; None for black. Depth has none.
        render_mode: RGB, D (sum of weight times z), ED (that over alpha), RGB+D or RGB+ED.
        near_plane: Gaussians have z > near_plane.
        far_plane: Gaussians have z <= far_plane.
        eps2d: variance added to both screen axes, px^2.
        antialiased: compensate the opacity for that addition.
        tolerance: see `composite`.
    """
    means, quats, scales, opacities, colors, viewmat, K = (
        tensor.double() for tensor in (means, quats, scales, opacities, colors, viewmat, K)
    )
    splats = project_splats(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmat,
        K,
        width,
        height,
        sh_degree=sh_degree,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        antialiased=antialiased,
    )
    channels = torch.cat([splats.colors, splats.depths[:, None]], dim=1)
    result = composite(
        splats.means2d,
        splats.conics,
        splats.opacities,
        channels,
        splats.depths,
        width,
        height,
        tolerance=tolerance,
    )
    alpha = 1 - result.transmittances
    rgb, depth = result.values[..., :-1], result.values[..., -1:]
    if background is not None:
        rgb = rgb + result.transmittances[..., None] * background.double()
    if render_mode.endswith("ED"):
        depth = depth / alpha[..., None].clamp(min=1e-10)
    parts = {"RGB": [rgb], "D": [depth], "ED": [depth], "RGB+D": [rgb, depth], "RGB+ED": [rgb, depth]}
    return ReferenceImage(torch.cat(parts[render_mode], dim=-1), alpha, result.cut, splats)
