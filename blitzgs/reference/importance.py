# SPDX-License-Identifier: Apache-2.0
"""The importance pass by definition: every Gaussian at every pixel, plain sorting (BlitzGS, section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import torch
from torch import Tensor

from blitzgs.reference.projection import project_splats
from blitzgs.reference.render import ALPHA_CUT, composited_weights


@dataclass
class Contributions:
    """Of V views and N Gaussians."""

    weights: Tensor  # float64 [V, N], sum of alpha T
    pixels: Tensor  # int64 [V, N], at how many pixels a Gaussian is composited
    visible: Tensor  # bool [V, N], the box around alpha >= 1/255 overlaps the image
    undecided: Tensor  # int64 [V, N], how many of its pixels lie on a cut, where rounding decides


def contributions(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    antialiased: bool = False,
) -> Contributions:
    """Compute what activated Gaussians contribute to views; arguments as for `blitzgs.contributions`."""
    means, quats, scales, opacities, viewmats, Ks = (
        tensor.double() for tensor in (means, quats, scales, opacities, viewmats, Ks)
    )
    shape = (len(viewmats), len(means))
    result = Contributions(
        torch.zeros(shape, dtype=torch.float64),
        torch.zeros(shape, dtype=torch.int64),
        torch.zeros(shape, dtype=torch.bool),
        torch.zeros(shape, dtype=torch.int64),
    )
    for v, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        splats = project_splats(
            means,
            quats,
            scales,
            opacities,
            means,
            viewmat,
            K,
            width,
            height,
            sh_degree=None,
            near_plane=near_plane,
            far_plane=far_plane,
            eps2d=eps2d,
            antialiased=antialiased,
        )
        weights, cut = composited_weights(
            splats.means2d, splats.conics, splats.opacities, splats.depths, width, height
        )
        result.weights[v, splats.ids] = weights.sum((1, 2))
        result.pixels[v, splats.ids] = (weights > 0).sum((1, 2))
        result.undecided[v, splats.ids] = ((weights > 0) & cut).sum((1, 2))
        # The box of the ellipse q <= 2 ln(255 o); a conic's inverse has c / det and a / det on its diagonal.
        a, b, c = splats.conics.unbind(1)
        reach = 2 * (255 * splats.opacities).clamp(min=1).log()
        half = (reach[:, None] * torch.stack((c, a), 1) / (a * c - b * b)[:, None]).sqrt()
        low, high = splats.means2d - half, splats.means2d + half
        inside = (high > 0).all(1) & (low[:, 0] < width) & (low[:, 1] < height)
        result.visible[v, splats.ids] = inside & (splats.opacities >= ALPHA_CUT)
    return result


def top_mass(weights: list[int], ids: list[int], share: Fraction) -> list[bool]:
    """Mark the smallest set, by descending weight (ties by id), that holds a share of the sum."""
    order = sorted(range(len(ids)), key=lambda i: (-weights[i], ids[i]))
    total, held, marked = sum(weights), 0, [False] * len(ids)
    for i in order:
        if held >= share * total:
            break
        held += weights[i]
        marked[i] = True
    return marked


@dataclass
class Scores:
    """What a pass makes of the contributions of V views."""

    score: Tensor  # float64 [N]
    phi: Tensor  # float64 [N]
    c_vis: Tensor  # bool [V, N], whether it is within the top 99 % of the view's mass


def scores(units: Tensor, pixels: Tensor, visible: Tensor, ids: Tensor, eps: float, phi_eps: float) -> Scores:
    """Aggregate contributions over the views.

    Args:
        units: int64 [V, N], weights in units of 2^-32.
        pixels: int64 [V, N].
        visible: bool [V, N].
        ids: int64 [N], which decide between equal weights.
        eps: added to the pixels in the score.
        phi_eps: added to c_rad in phi.
    """
    c_vis = torch.tensor(
        [top_mass(view, ids.tolist(), Fraction(99, 100)) for view in units.tolist()], dtype=torch.bool
    )
    density = units.double() / 2.0**32 / (pixels.double() + eps)
    c_rad = visible.sum(0)
    score = torch.where(pixels > 0, density, torch.zeros_like(density)).sum(0)
    return Scores(score, c_vis.sum(0).double() / (c_rad.double() + phi_eps), c_vis)
