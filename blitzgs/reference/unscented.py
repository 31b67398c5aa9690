# SPDX-License-Identifier: Apache-2.0
"""Unscented projection of activated Gaussians into one view with a lens or a rolling shutter (3DGUT)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.reference.projection import covariance_factors


class View(NamedTuple):
    """A camera; `lens` [13] and `shutter` as for `blitzgs.ops.unscented.Lenses`."""

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    lens: Tensor
    fisheye: bool = False
    viewmat_rs: Tensor | None = None
    shutter: int = 4
    margin: float = 0.1


def unscented_splats(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    view: View,
    *,
    alpha: float = 0.1,
    beta: float = 2.0,
    kappa: float = 0.0,
    eps2d: float = 0.3,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return means2d [N, 2], covariances with and without eps2d [2, N, 2, 2], depths [N], validity [N, 7].

    The sums over weighted points of Wan and van der Merwe (2000); a splat needs a valid one.
    """
    spread = math.sqrt(alpha**2 * (3 + kappa))
    ends = spread * covariance_factors(quats, scales).mT
    points = means[:, None] + torch.cat([torch.zeros_like(ends[:, :1]), ends, -ends], dim=1)
    pixels, valid = _pixels(points, view)
    first, other = 1 - 3 / spread**2, 0.5 / spread**2
    weights = torch.tensor([first] + [other] * 6, dtype=means.dtype)
    means2d = (weights[:, None] * pixels).sum(dim=1)
    weights = torch.tensor([first + 1 - alpha**2 + beta] + [other] * 6, dtype=means.dtype)
    apart = pixels - means2d[:, None]
    covariances = (weights[:, None, None] * apart[..., :, None] * apart[..., None, :]).sum(dim=1)
    depths = _points_at(means, view, torch.full_like(means[:, 0], 0.5))[:, 2]
    return (
        means2d,
        torch.stack([covariances + eps2d * torch.eye(2, dtype=means.dtype), covariances]),
        depths,
        valid,
    )


def _pixels(points: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Return the pixels [..., 2] of world points [..., 3], and whether they are valid."""
    zero = torch.zeros_like(points[..., 0])
    pixels, valid = lens_pixels(_points_at(points, view, zero), view)
    if view.viewmat_rs is None:
        return pixels, valid
    last, last_valid = lens_pixels(_points_at(points, view, zero + 1), view)
    seen = valid | last_valid
    pixels = torch.where(valid[..., None], pixels, last)
    for _ in range(20):
        new, valid = lens_pixels(_points_at(points, view, _times(pixels, view)), view)
        pixels = torch.where(seen[..., None], new, last)
    return pixels, valid & seen


def lens_pixels(points: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Return the pixels [..., 2] of camera-space points [..., 3], and whether they are valid."""
    k, p, s = view.lens[:6], view.lens[6:8], view.lens[8:12]
    in_front = points[..., 2] > 0
    x, y, z = torch.where(in_front[..., None], points, torch.ones_like(points)).unbind(dim=-1)
    u, v = x / z, y / z
    r2 = u * u + v * v
    if view.fisheye:
        radius = (x * x + y * y).clamp(min=1e-30).sqrt()
        angle = torch.atan2(radius, z)
        most = view.lens[12]
        t = torch.minimum(angle, most)
        stretch = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / radius
        across, down, valid = stretch * x, stretch * y, in_front & (angle < most)
    else:
        scale = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3)
        across = u * scale + 2 * p[0] * u * v + p[1] * (r2 + 2 * u * u) + s[0] * r2 + s[1] * r2**2
        down = v * scale + p[0] * (r2 + 2 * v * v) + 2 * p[1] * u * v + s[2] * r2 + s[3] * r2**2
        valid = in_front & (scale > 0.8)
    K = view.K
    pixels = torch.stack([K[0, 0] * across + K[0, 2], K[1, 1] * down + K[1, 2]], dim=-1)
    pixels = torch.where(in_front[..., None], pixels, torch.zeros_like(pixels))
    size = torch.tensor([view.width, view.height], dtype=points.dtype)
    inside = (pixels >= -view.margin * size) & (pixels < (1 + view.margin) * size)
    return pixels, valid & inside.all(dim=-1)


def _times(pixels: Tensor, view: View) -> Tensor:
    """Return the times at which the shutter sees pixels: 0 for the first row or column, 1 for the last."""
    size, axis = (view.height, 1) if view.shutter in (0, 2) else (view.width, 0)
    time = (pixels[..., axis] - 0.5) / (size - 1)
    return time if view.shutter in (0, 1) else 1 - time


def _points_at(points: Tensor, view: View, time: Tensor) -> Tensor:
    """Return camera-space points [..., 3] at times [...]: the rotation turns at a constant rate."""
    rotation, shift = view.viewmat[:3, :3], view.viewmat[:3, 3]
    if view.viewmat_rs is None:
        return points @ rotation.T + shift
    turn = view.viewmat_rs[:3, :3] @ rotation.T
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    angle = torch.atan2(axis.norm(), (turn.trace() - 1) / 2)
    x, y, z = (axis / axis.norm().clamp(min=1e-30)).tolist()
    across = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=points.dtype)
    turned = time[..., None] * angle
    at_start = points @ rotation.T
    # Rodrigues' formula.
    rotated = (
        at_start
        + turned.sin() * (at_start @ across.T)
        + (1 - turned.cos()) * (at_start @ (across @ across).T)
    )
    return rotated + (1 - time)[..., None] * shift + time[..., None] * view.viewmat_rs[:3, 3]
