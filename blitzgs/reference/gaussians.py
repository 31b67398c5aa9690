# SPDX-License-Identifier: Apache-2.0
"""A Gaussian in the world: rotation, covariance, spherical-harmonics colour."""

from __future__ import annotations

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
