# SPDX-License-Identifier: Apache-2.0
"""The whole image of one view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.reference.compositing import composite
from blitzgs.reference.projection import Splats, project_splats


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
