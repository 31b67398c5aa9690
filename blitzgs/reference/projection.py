# SPDX-License-Identifier: Apache-2.0
"""A Gaussian in the world, and its EWA projection into one pinhole view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return [N, 3, 3] from quaternions [N, 4] (w, x, y, z) of any length; zero counts as the identity."""
    largest = quats.detach().abs().amax(dim=1, keepdim=True)
    zero = largest == 0
    unit = quats / torch.where(zero, torch.ones_like(largest), largest)  # so that no square overflows
    unit = torch.where(zero, unit.new_tensor([1.0, 0.0, 0.0, 0.0]), unit)
    w, x, y, z = (unit / unit.norm(dim=1, keepdim=True)).unbind(dim=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def covariance_factors(quats: Tensor, scales: Tensor) -> Tensor:
    """Return A = R diag(s) [N, 3, 3] with Sigma = A A^T, from standard deviations [N, 3]."""
    return rotation_matrices(quats) * scales[:, None, :]


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Return the (degree + 1)^2 real basis functions [N, K] at unit directions [N, 3]."""
    x, y, z = directions.unbind(dim=1)
    basis = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=1)


def sh_values(means: Tensor, sh: Tensor, camera_centre: Tensor, degree: int) -> Tensor:
    """Return SH(direction) + 0.5 [N, D], the direction from the camera centre to each mean."""
    directions = torch.nn.functional.normalize(means - camera_centre, dim=1)
    basis = sh_basis(directions, degree)
    return torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]) + 0.5


def normals(means: Tensor, quats: Tensor, camera_centre: Tensor) -> Tensor:
    """Return the third axes of Gaussians [N, 3] in the world, turned to face the camera centre."""
    axes = rotation_matrices(quats)[:, :, 2]
    away = ((means - camera_centre) * axes).sum(dim=1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def sh_colors(means: Tensor, sh: Tensor, camera_centre: Tensor, degree: int) -> Tensor:
    """Return max(SH(direction) + 0.5, 0) [N, 3]."""
    return sh_values(means, sh, camera_centre, degree).clamp(min=0)


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
