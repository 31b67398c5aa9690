# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics of any number of channels, up to degree 4; the projection has its own up to 3."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from blitzgs.util.errors import check_tensors

MAX_SH_DEGREE = 4


def spherical_harmonics(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Return ``sum_k Y_k(dirs) coeffs_k`` of real spherical harmonics, as gsplat 1.5's function of this name.

    The basis and its order are those of 3DGS: Y_k with k = l (l + 1) + m, without the 0.5 and the clipping of
    its colours. Differentiable, any number of times, in `dirs` and `coeffs`.

    Args:
        degree: degree to evaluate, 0 to 4.
        dirs: [..., 3], floating point, of any length; the result of a zero vector is finite.
        coeffs: [..., K, D], K >= (degree + 1)^2; leading dimensions broadcast with those of `dirs`.
        masks: bool [...]: where False, the result is 0, without a gradient; None: all True.

    Returns:
        [..., D], of the wider dtype of the two.

    Raises:
        TypeError: an argument is not a tensor, or the masks are not bool.
        ValueError: the degree is not 0 to 4, or a shape does not fit.
    """
    check_tensors(dirs=dirs, coeffs=coeffs)
    if masks is not None:
        check_tensors(masks=masks)
        if masks.dtype != torch.bool:
            raise TypeError(f"masks must be bool, got {masks.dtype}; pass masks != 0")
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"degree must be 0 to {MAX_SH_DEGREE}, got {degree}")
    count = (degree + 1) ** 2
    if dirs.dim() < 1 or dirs.shape[-1] != 3:
        raise ValueError(f"dirs must be [..., 3], got {list(dirs.shape)}")
    if coeffs.dim() < 2 or coeffs.shape[-2] < count:
        raise ValueError(f"coeffs must be [..., K, D] with K >= {count}, got {list(coeffs.shape)}")
    try:
        torch.broadcast_shapes(dirs.shape[:-1], coeffs.shape[:-2], () if masks is None else masks.shape)
    except RuntimeError:
        raise ValueError(
            f"leading dimensions must broadcast: dirs {list(dirs.shape)}, coeffs {list(coeffs.shape)}, masks "
            f"{None if masks is None else list(masks.shape)}"
        ) from None
    if masks is not None:  # a direction that is not finite would spoil the gradients of its coefficients
        dirs = torch.where(masks.unsqueeze(-1), dirs, torch.zeros_like(dirs))
    dtype = torch.promote_types(dirs.dtype, coeffs.dtype)
    values = (_basis(dirs, degree).unsqueeze(-2).to(dtype) @ coeffs[..., :count, :].to(dtype)).squeeze(-2)
    return values if masks is None else torch.where(masks.unsqueeze(-1), values, torch.zeros_like(values))


def colors_of_views(degree: int, means: Tensor, viewmats: Tensor, coeffs: Tensor, per_view: bool) -> Tensor:
    """Return ``max(SH(direction) + 0.5, 0)`` of every Gaussian in every view (docs/image.md, section 4).

    `coeffs`: [..., N, K, D], or [..., C, N, K, D] if `per_view`, with enough coefficients for the degree.
    Returns [..., C, N, D]; of a mean or a view that is not finite, any finite value.
    """
    rotations, translations = viewmats[..., :3, :3], viewmats[..., :3, 3:]
    centres = -(rotations.mT @ translations).mT
    dirs = means.unsqueeze(-3) - centres
    # What is not finite hides its own Gaussian or view by its geometry, and must not become a colour.
    dirs = torch.where(dirs.isfinite().all(dim=-1, keepdim=True), dirs, torch.zeros_like(dirs))
    if per_view:
        values = spherical_harmonics(degree, dirs, coeffs)
    else:  # one product for each Gaussian, so that its coefficients are not copied for each view
        basis = _basis(dirs.transpose(-3, -2), degree)
        values = (basis @ coeffs[..., : basis.shape[-1], :]).transpose(-3, -2)
    return (values + 0.5).clamp(min=0)


def _basis(dirs: Tensor, degree: int) -> Tensor:
    """Return Y_k(dirs), [..., K].

    Y_l^(+-m) = (-1)^m sqrt((2 l + 1) / (4 pi) (l - m)! / (l + m)! (2 - [m = 0])) p_l^m(z) [C_m, S_m], with
    C_m + i S_m = (x + i y)^m, and p_l^m the associated Legendre functions over (1 - z^2)^(m / 2) by their
    recurrences (Abramowitz and Stegun 1964, 8.5.3), which need no square root.
    """
    lengths = dirs.norm(dim=-1, keepdim=True)
    x, y, z = (dirs / torch.where(lengths > 0, lengths, torch.ones_like(lengths))).unbind(dim=-1)
    basis: list[Tensor] = [z] * (degree + 1) ** 2
    cosine, sine, first = torch.ones_like(z), torch.zeros_like(z), torch.ones_like(z)
    for m in range(degree + 1):
        before, own = torch.zeros_like(z), first
        for l in range(m, degree + 1):  # noqa: E741  (the field's name)
            if l > m:
                before, own = own, ((2 * l - 1) * z * own - (l + m - 1) * before) / (l - m)
            share = math.factorial(l - m) / math.factorial(l + m) * (2 if m else 1)
            scaled = (-1) ** m * math.sqrt((2 * l + 1) / (4 * math.pi) * share) * own
            basis[l * (l + 1) + m] = scaled * cosine
            if m:
                basis[l * (l + 1) - m] = scaled * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        first = (2 * m + 1) * first
    return torch.stack(basis, dim=-1)
