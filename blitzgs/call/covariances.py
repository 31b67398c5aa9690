# SPDX-License-Identifier: Apache-2.0
"""Gaussians given by covariances instead of rotations and scales.

The kernels find the visible Gaussians from rotations and scales, so each covariance is decomposed, without
gradients: the gradient of an eigenvalue decomposition is infinite if two axes are equal. The shape of each
splat on the screen, on which the image depends, is then computed from the covariance itself, with gradients.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs
from blitzgs.util.rotations import quaternions


class Decomposed(NamedTuple):
    """Covariances and their rotations and scales."""

    upper: Tensor  # [N, 6]: xx, xy, xz, yy, yz, zz; they get gradients
    quats: Tensor  # [N, 4], without gradients
    scales: Tensor  # [N, 3], without gradients; NaN if the covariance is not finite


def decompose(covars: Tensor) -> Decomposed:
    """Decompose covariances [N, 3, 3]; only their upper triangles are read, as in gsplat."""
    upper = covars[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    with torch.no_grad():
        matrices = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3).double()
        finite = matrices.isfinite().all(dim=(1, 2))
        matrices = torch.where(finite[:, None, None], matrices, torch.eye(3, device=covars.device).double())
        axes, variances = _principal_axes(matrices)
        scales = variances.clamp(min=0).sqrt().masked_fill_(~finite[:, None], torch.nan)
        return Decomposed(upper, quaternions(axes).to(covars.dtype), scales.to(covars.dtype))


def _principal_axes(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Return a rotation, axes in columns [N, 3, 3], and variances [N, 3] of symmetric matrices [N, 3, 3].

    `torch.linalg.eigh` is slow on a GPU for many small matrices. The eigenvalue that is farthest from both
    others has a closed form (Smith 1961), its axis is a cross product, and a rotation in the plane across
    this axis diagonalises the rest (Eberly 2014, "A Robust Eigensolver for 3 x 3 Symmetric Matrices").
    """
    size = matrices.abs().amax(dim=(1, 2), keepdim=True).clamp(min=torch.finfo(matrices.dtype).tiny)
    matrices = matrices / size
    unit = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    mean = matrices.diagonal(dim1=1, dim2=2).mean(dim=1)[:, None, None]
    rest = matrices - mean * unit
    spread = (rest.square().sum(dim=(1, 2)) / 6).sqrt()
    determinant = (rest[:, 0] * torch.linalg.cross(rest[:, 1], rest[:, 2])).sum(dim=1)
    cosine = (determinant / (2 * spread**3)).nan_to_num_(nan=0).clamp_(-1, 1)
    apart = (2 * spread * (cosine.abs().acos() / 3).cos()).copysign(cosine)
    # The rows of what is left span the plane across the axis.
    rows = rest - apart[:, None, None] * unit
    crosses = torch.linalg.cross(rows, rows.roll(1, dims=1))
    each = torch.arange(len(rows), device=rows.device)
    axis = crosses[each, crosses.square().sum(dim=2).argmax(dim=1)]
    length = axis.norm(dim=1, keepdim=True)
    axis = torch.where(length > 0, axis / length, unit[0])  # no length: all axes are equal
    across = torch.nn.functional.normalize(torch.linalg.cross(axis, unit[axis.abs().argmin(dim=1)]), dim=1)
    frame = torch.stack([axis, across, torch.linalg.cross(axis, across)], dim=2)
    turned = frame.mT @ matrices @ frame
    angle = torch.atan2(2 * turned[:, 1, 2], turned[:, 1, 1] - turned[:, 2, 2]) / 2
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    u, v = frame[:, :, 1], frame[:, :, 2]
    axes = torch.stack([axis, cos * u + sin * v, cos * v - sin * u], dim=2)
    return axes, (axes * (matrices @ axes)).sum(dim=1) * size[:, :, 0]


def shaped_by(splats: ProjectedSplats, inputs: ProjectionInputs, decomposed: Decomposed) -> ProjectedSplats:
    """Return splats whose conics, and compensated opacities, come from covariances (docs/image.md).

    In double, because the determinant of a covariance loses the digits of a thin splat. `splats`: of the
    decomposed covariances.
    """
    means, _, _, opacities, *_ = inputs.gaussians
    means, opacities, viewmats, Ks = (t.double() for t in (means, opacities, *inputs.cameras))
    options = inputs.options
    width, height, eps2d, antialiased = options.width, options.height, options.eps2d, options.antialiased
    views, ids = splats.camera_ids, splats.gaussian_ids
    viewmats, Ks = viewmats.index_select(0, views), Ks.index_select(0, views)
    rotations = viewmats[:, :3, :3]
    points = torch.einsum("pij,pj->pi", rotations, means.index_select(0, ids)) + viewmats[:, :3, 3]
    jacobians = _jacobians(points, Ks, width, height) @ rotations
    upper = decomposed.upper.double().index_select(0, ids)
    covars = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    on_screen = jacobians @ covars @ jacobians.mT
    xx, xy, yy = on_screen[:, 0, 0], on_screen[:, 0, 1], on_screen[:, 1, 1]
    # Rounding may leave nothing of a thin splat's determinant, or less. The blur's part has no cancellation.
    before = (xx * yy - xy * xy).clamp(min=0)
    after = before + eps2d * (xx + yy + eps2d)
    # A conic of zeros touches no pixel; an infinite one would have the gradient NaN.
    inverse = torch.where(after > 0, 1 / after.clamp(min=1e-300), 0)
    conics = torch.stack([yy + eps2d, -xy, xx + eps2d], dim=1) * inverse[:, None]
    splats = splats._replace(conics=conics.to(splats.conics.dtype))
    if not antialiased:
        return splats
    share = (before * inverse).clamp(min=1e-30).sqrt()  # the root of zero has no derivative
    compensated = (opacities.index_select(0, ids) * share).to(splats.opacities.dtype)
    # A splat without opacity is hidden: its colour is not finite.
    return splats._replace(opacities=torch.where(splats.opacities == 0, splats.opacities, compensated))


def _jacobians(points: Tensor, Ks: Tensor, width: int, height: int) -> Tensor:
    """Return d(pixel)/d(camera point) [P, 2, 3], slopes held within 0.15 images of the borders."""
    x, y, z = points.unbind(dim=1)
    fx, fy, cx, cy = Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]
    u = torch.clamp(x / z, (-0.15 * width - cx) / fx, (1.15 * width - cx) / fx)
    v = torch.clamp(y / z, (-0.15 * height - cy) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    across = torch.stack([fx / z, zero, -fx * u / z], dim=1)
    down = torch.stack([zero, fy / z, -fy * v / z], dim=1)
    return torch.stack([across, down], dim=1)
