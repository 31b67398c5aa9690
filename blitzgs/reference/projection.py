# SPDX-License-Identifier: Apache-2.0
"""A Gaussian in the world, its EWA projection into a pinhole view, and the unscented one of 3DGUT."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

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
        keep &= parameter[:, None].flatten(1).isfinite().all(dim=1)
    ids = keep.nonzero()[:, 0]
    return ids[depths[ids].argsort(stable=True)]


def _clamped_jacobian(x: Tensor, y: Tensor, z: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Return d(pixel)/d(camera point) [M, 2, 3], slopes held within 0.15 images of the borders."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u = torch.clamp(x / z, (-0.15 * width - cx) / fx, (1.15 * width - cx) / fx)
    v = torch.clamp(y / z, (-0.15 * height - cy) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    return torch.stack(
        [torch.stack([fx / z, zero, -fx * u / z], dim=1), torch.stack([zero, fy / z, -fy * v / z], dim=1)],
        dim=1,
    )


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
    alpha: float = 0.1,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return means2d [N, 2], covariances with and without 0.3 I [2, N, 2, 2], depths [N], validity [N, 7].

    The sums over weighted points of Wan and van der Merwe (2000), beta = 2 and kappa = 0; a splat needs a
    valid one.
    """
    spread = math.sqrt(alpha**2 * 3)
    ends = spread * covariance_factors(quats, scales).mT
    points = means[:, None] + torch.cat([torch.zeros_like(ends[:, :1]), ends, -ends], dim=1)
    pixels, valid = _pixels(points, view)
    first, other = 1 - 3 / spread**2, 0.5 / spread**2
    weights = torch.tensor([first] + [other] * 6, dtype=means.dtype)
    means2d = (weights[:, None] * pixels).sum(dim=1)
    weights = torch.tensor([first + 1 - alpha**2 + 2] + [other] * 6, dtype=means.dtype)
    apart = pixels - means2d[:, None]
    covariances = (weights[:, None, None] * apart[..., :, None] * apart[..., None, :]).sum(dim=1)
    depths = _points_at(means, view, torch.full_like(means[:, 0], 0.5))[:, 2]
    both = torch.stack([covariances + 0.3 * torch.eye(2, dtype=means.dtype), covariances])
    return means2d, both, depths, valid


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
