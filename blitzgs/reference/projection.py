# SPDX-License-Identifier: Apache-2.0
"""EWA projection of activated Gaussians into one pinhole view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.reference.gaussians import covariance_factors, sh_colors


@dataclass
class Splats:
    """The M Gaussians of one view, front to back by (depth, index)."""

    ids: Tensor  # [M] index of the Gaussian
    means2d: Tensor  # [M, 2] px
    factors: Tensor  # [M, 2, 3]: the covariance before the blur is factor factor^T, px^2
    conics: Tensor  # [M, 3]: a, b, c of the inverse of the blurred covariance
    depths: Tensor  # [M]
    opacities: Tensor  # [M], compensated in antialiased mode
    colors: Tensor  # [M, D]


def project_splats(
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
    sh_degree: int | None,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    antialiased: bool,
) -> Splats:
    """Project what lies in (near, far] and is finite; `colors` are SH [N, K, 3] or values [N, D]."""
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    if sh_degree is not None:
        colors = colors[:, : (sh_degree + 1) ** 2]
    ids = _visible([means, quats, scales, opacities, colors], viewmat, near_plane, far_plane)
    means, quats, scales, opacities, colors = (t[ids] for t in (means, quats, scales, opacities, colors))
    x, y, z = (means @ rotation.T + translation).unbind(dim=1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    jacobian = _clamped_jacobian(x, y, z, K, width, height)
    factors = jacobian @ rotation @ covariance_factors(quats, scales)
    xx, xy, yy = ((factors[:, i] * factors[:, j]).sum(dim=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    # det(M M^T + eps I), without the cancellation of xx yy - xy^2
    unblurred = torch.linalg.cross(factors[:, 0], factors[:, 1])
    determinant = unblurred.square().sum(dim=1) + eps2d * (xx + yy) + eps2d**2
    conics = torch.stack([yy + eps2d, -xy, xx + eps2d], dim=1) / determinant[:, None]

    if antialiased:
        opacities = opacities * unblurred.norm(dim=1) / determinant.sqrt()
    if sh_degree is not None:
        colors = sh_colors(means, colors, -rotation.T @ translation, sh_degree)
    return Splats(ids, means2d, factors, conics, z, opacities, colors)


@torch.no_grad()
def _visible(parameters: list[Tensor], viewmat: Tensor, near: float, far: float) -> Tensor:
    depths = parameters[0] @ viewmat[2, :3] + viewmat[2, 3]
    keep = (depths > near) & (depths <= far)
    for parameter in parameters:
        keep &= parameter.reshape(len(depths), -1).isfinite().all(dim=1)
    ids = keep.nonzero()[:, 0]
    return ids[depths[ids].argsort(stable=True)]


def _clamped_jacobian(x: Tensor, y: Tensor, z: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Return d(pixel)/d(camera point) [M, 2, 3] with the slopes held within 0.15 images of the borders.

    For a centred principal point that is 1.3 tan(fov / 2).
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = torch.clamp(x / z, (-0.15 * width - cx) / fx, (1.15 * width - cx) / fx)
    v = torch.clamp(y / z, (-0.15 * height - cy) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    return torch.stack(
        [torch.stack([fx / z, zero, -fx * u / z], dim=1), torch.stack([zero, fy / z, -fy * v / z], dim=1)],
        dim=1,
    )
