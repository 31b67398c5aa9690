# SPDX-License-Identifier: Apache-2.0
"""The statistics that density control reads: screen-space gradients, visibility counts and radii."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs._library import below_autograd


def density_stats_(
    grad_sum: Tensor,
    grad_count: Tensor,
    max_radii: Tensor,
    visible_ids: Tensor,
    splat_offsets: Tensor,
    v_means2d: Tensor,
    conics: Tensor,
    width: int,
    height: int,
    weight: float,
    phi: Tensor | None = None,
) -> None:
    """Add one step's splats to the statistics of the visible Gaussians, in place.

    Per splat: ``grad_sum += phi * weight * |v_means2d * (width / 2, height / 2)|``, ``grad_count += 1`` and
    ``max_radii = max(max_radii, ceil(3 sigma))`` (Kerbl et al. 2023, section 5; its normalised units).

    Args:
        grad_sum: [N], float32 (CPU also float64).
        grad_count: int32 [N].
        max_radii: [N], pixels, dtype of `grad_sum`.
        visible_ids: int32 [U], Gaussians with splats, each once.
        splat_offsets: int32 [U + 1]; splats splat_offsets[u] to splat_offsets[u + 1] are of visible_ids[u].
        v_means2d: [P, 2], gradient of the step's loss by the projected means, per pixel; rows may be strided.
        conics: [P, 3], inverse 2D covariances (a, b, c).
        width: image width in pixels.
        height: image height in pixels.
        weight: factor from the gradient of the step's loss to the gradient of one view's loss: B when the
            step's loss is a mean over B views.
        phi: [N], factor of each Gaussian's gradient; None = 1.

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    with below_autograd():
        torch.ops.blitzgs.density_stats_(
            grad_sum,
            grad_count,
            max_radii,
            visible_ids,
            splat_offsets,
            v_means2d,
            conics,
            phi,
            width,
            height,
            weight,
        )
