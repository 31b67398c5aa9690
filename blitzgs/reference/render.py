# SPDX-License-Identifier: Apache-2.0
"""The whole image of one view, and the importance pass (BlitzGS, section 3.2): every splat at every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from blitzgs.reference.projection import Splats, project_splats

ALPHA_CUT = 1.0 / 255.0
ALPHA_MAX = 0.99
MIN_TRANSMITTANCE = 1e-4
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


@dataclass
class Composite:
    """One image, float64."""

    values: Tensor  # [H, W, D]
    transmittances: Tensor  # [H, W]: what reaches the background
    cut: Tensor  # bool [H, W]: a comparison here is within the tolerance, so rounding may change its outcome


def composite(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    *,
    tolerance: float = 1e-4,
) -> Composite:
    """Composite M splats that are ordered front to back.

    alpha = min(0.99, o exp(-q / 2)), q the Mahalanobis distance of the pixel centre; a splat takes part where
    alpha >= 1/255; one that would take the transmittance below 1e-4 is left out and ends the pixel.

    Args:
        means2d: [M, 2] px.
        conics: [M, 3].
        opacities: [M].
        colors: [M, D].
        depths: [M], ascending.
        width: px.
        height: px.
        tolerance: relative distance within which alpha (to 1/255 or 0.99), transmittance (to 1e-4) or the
            depths of two consecutive splats of a pixel count as undecided.
    """
    unclipped, alphas, before, after, weights = _weights(means2d, conics, opacities, width, height)
    values = torch.einsum("mp,md->pd", weights, colors)
    transmittances = torch.where(weights > 0, 1 - alphas, torch.ones_like(alphas)).prod(dim=0)
    cut = _cut(unclipped.detach(), after.detach(), before.detach(), depths.detach(), tolerance)
    shape = (height, width)
    return Composite(values.reshape(*shape, -1), transmittances.reshape(shape), cut.reshape(shape))


def composited_weights(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return alpha T of M splats, ordered front to back, at every pixel [M, H, W], and the cut pixels [H, W].

    See `composite`; alpha T is zero where a splat is not composited, and positive where it is.
    """
    unclipped, _, before, after, weights = _weights(means2d, conics, opacities, width, height)
    cut = _cut(unclipped, after, before, depths, 1e-4)
    return weights.reshape(-1, height, width), cut.reshape(height, width)


def _weights(
    means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return alpha before clipping, alpha, T before and after it, and alpha T where composited, [M, H W]."""
    columns, rows = (torch.arange(size, device=means2d.device).to(means2d) + 0.5 for size in (width, height))
    dx, dy = columns.repeat(height) - means2d[:, :1], rows.repeat_interleave(width) - means2d[:, 1:]
    a, b, c = conics[:, :, None].unbind(dim=1)
    unclipped = opacities[:, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    touched = unclipped >= ALPHA_CUT
    alphas = torch.where(touched, unclipped.clamp(max=ALPHA_MAX), torch.zeros_like(unclipped))
    after = torch.cumprod(1 - alphas, dim=0)  # never increasing
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    composited = touched & (after >= MIN_TRANSMITTANCE)
    weights = torch.where(composited, alphas * before, torch.zeros_like(alphas))
    return unclipped, alphas, before, after, weights


def _cut(unclipped: Tensor, after: Tensor, before: Tensor, depths: Tensor, tolerance: float) -> Tensor:
    def near(value: Tensor, limit: float) -> Tensor:
        return (value - limit).abs() <= tolerance * limit

    # Splats behind the end of a pixel have no effect on it.
    reached = before >= MIN_TRANSMITTANCE * (1 - tolerance)
    undecided = near(unclipped, ALPHA_CUT) | near(unclipped, ALPHA_MAX) | near(after, MIN_TRANSMITTANCE)
    touched = unclipped >= ALPHA_CUT * (1 - tolerance)
    front = torch.where(touched, depths[:, None], -torch.inf).cummax(dim=0).values
    gap = depths[1:, None] - front[:-1]
    tie = touched.clone()
    tie[:1] = False
    # Equal depths are no cut: the index orders them.
    tie[1:] &= (gap > 0) & (gap <= tolerance * 1e-2 * depths[1:, None].abs())
    return ((undecided | tie) & reached).any(dim=0)


def median_splats(weights: Tensor) -> Tensor:
    """Return the last splat composited with a transmittance above 0.5 in front of it, int64 [H, W]; -1: none.

    Args:
        weights: alpha T of M splats, front to back, [M, H, W], zero where a splat is not composited.
    """
    before = 1 - (weights.cumsum(dim=0) - weights)
    numbers = torch.arange(len(weights))[:, None, None].expand_as(weights)
    return torch.where((weights > 0) & (before > 0.5), numbers, -1).amax(dim=0)


def strongest_splats(weights: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the splats of the largest weights, front to back, int64 [H, W, count], and their weights.

    Of equal weights, the splats in front. Padded with -1 and 0.

    Args:
        weights: as for `median_splats`.
        count: number of splats of a pixel.
    """
    weights = torch.cat([weights, weights.new_zeros(count, *weights.shape[1:])])
    largest = weights.argsort(dim=0, descending=True, stable=True)[:count].sort(dim=0).values
    kept = weights.gather(0, largest)
    ids = torch.where(kept > 0, largest, -1)
    # Splats without weight may stand between others: move them behind.
    order = (ids < 0).long().argsort(dim=0, stable=True)
    return ids.gather(0, order).movedim(0, -1), kept.gather(0, order).movedim(0, -1)


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
        width, height, near_plane, far_plane, eps2d: as for `blitzgs.rasterization`.
        sh_degree: degree to evaluate, 0 to 3, or None.
        background: [D] colour behind everything; None for black. Depth has none.
        render_mode: RGB, D (sum of weight times z), ED (that over alpha), RGB+D or RGB+ED.
        antialiased: compensate the opacity for the addition of eps2d.
        tolerance: see `composite`.

    Raises:
        ValueError: a shape does not fit, or the degree or the mode is not one of these.
    """
    named = dict(means=means, quats=quats, scales=scales, opacities=opacities, colors=colors)
    named |= dict(viewmat=viewmat, K=K)
    _check(named, sh_degree, render_mode)
    tensors: Any = (tensor.double() for tensor in named.values())
    view: dict[str, Any] = dict(width=width, height=height, near_plane=near_plane, far_plane=far_plane)
    splats = project_splats(*tensors, **view, sh_degree=sh_degree, eps2d=eps2d, antialiased=antialiased)
    geometry, depths = (splats.means2d, splats.conics, splats.opacities), splats.depths
    channels = torch.cat([splats.colors, depths[:, None]], dim=1)
    result = composite(*geometry, channels, depths, width, height, tolerance=tolerance)
    alpha = 1 - result.transmittances
    rgb, depth = result.values[..., :-1], result.values[..., -1:]
    if background is not None:
        rgb = rgb + result.transmittances[..., None] * background.double()
    if render_mode.endswith("ED"):
        depth = depth / alpha[..., None].clamp(min=1e-10)
    parts = {"RGB": [rgb], "D": [depth], "ED": [depth], "RGB+D": [rgb, depth], "RGB+ED": [rgb, depth]}
    return ReferenceImage(torch.cat(parts[render_mode], dim=-1), alpha, result.cut, splats)


def _check(named: dict[str, Tensor], sh_degree: int | None, render_mode: str) -> None:
    if sh_degree not in (None, 0, 1, 2, 3):
        raise ValueError(f"sh_degree must be 0 to 3 or None, got {sh_degree!r}")
    n, colors = named["means"].shape[:1], named["colors"].shape
    count = () if sh_degree is None else (max([(sh_degree + 1) ** 2, *colors[-2:-1]]),)
    wanted = {
        "means": (*n, 3),
        "quats": (*n, 4),
        "scales": (*n, 3),
        "opacities": n,
        "colors": (*n, *count, *colors[-1:]),
        "viewmat": (4, 4),
        "K": (3, 3),
    }
    for name, shape in wanted.items():
        if named[name].shape != shape:
            raise ValueError(f"{name} must be {[*shape]}, got {[*named[name].shape]}")
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be one of {', '.join(RENDER_MODES)}, got {render_mode!r}")


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
    antialiased: bool = False,
) -> Contributions:
    """Compute what activated Gaussians contribute to views; arguments as for `blitzgs.contributions`."""
    view: dict[str, Any] = dict(width=width, height=height, near_plane=near_plane, far_plane=far_plane)
    shape = (len(viewmats), len(means))
    dtypes = (torch.float64, torch.int64, torch.bool, torch.int64)
    result = Contributions(*(torch.zeros(shape, dtype=dtype) for dtype in dtypes))
    for v, camera in enumerate(zip(viewmats, Ks, strict=True)):
        tensors: Any = (tensor.double() for tensor in (means, quats, scales, opacities, means, *camera))
        splats = project_splats(*tensors, **view, sh_degree=None, eps2d=0.3, antialiased=antialiased)
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
