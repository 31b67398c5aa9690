# SPDX-License-Identifier: Apache-2.0
"""Measures what each Gaussian contributes to each view, by a rasterisation that sums weights, not colours."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.ops.projection import ProjectedSplats, ProjectionInputs, ProjectionOptions, project_splats

# Units of a weight in 1, kContributionScale of csrc/importance/importance.h.
UNITS = 1 << 32
# Views that are projected at once.
_VIEWS = 8
_TILE_SIZE = 16


def splat_contributions(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    isect_splats: Tensor,
    tile_offsets: Tensor,
    *,
    n_cameras: int,
    width: int,
    height: int,
    tile_size: int = _TILE_SIZE,
    tile_begin: int = 0,
    tile_end: int = -1,
    n_splats: Tensor | None = None,
    squares: bool = False,
) -> tuple[Tensor, Tensor]:
    """Sum alpha T over the pixels at which each splat is composited, and count these pixels.

    Alpha and T have the same bits as in :func:`blitzgs.ops.rasterize.rasterize`. The sums are integers, so
    they do not depend on the order of addition, and the sums of disjoint tile ranges add up to the sum of all
    tiles.

    Args:
        means2d: [P, 2], pixels, float32 or (CPU) float64.
        conics: inverse 2D covariances (a, b, c) [P, 3].
        splat_opacities: [P].
        isect_splats: int32 [I], from :func:`blitzgs.ops.intersect.intersect`.
        tile_offsets: int64 [B * T + 1], likewise.
        n_cameras: number of views B.
        width: of every view, pixels.
        height: of every view, pixels.
        tile_size: edge of a tile in pixels, as given to ``intersect``; 16 on CUDA.
        tile_begin: first tile to composite.
        tile_end: end of the tiles to composite, -1 for all.
        n_splats: int64 [1] on the device of the splats: only the first `n_splats` splats are valid. None:
            all.
        squares: sum (alpha T)^2 instead.

    Returns:
        Weights int64 [P], in units of 2^-32 (each alpha T rounded to the nearest, and its square down), and
        pixels int32 [P].

    Raises:
        RuntimeError: wrong shapes or dtypes, a tile range outside the images, or a tile size that CUDA lacks.
    """
    weights, pixels = torch.ops.blitzgs.contributions(
        means2d, conics, splat_opacities, isect_splats, tile_offsets,
        [n_cameras, width, height, tile_size, tile_begin, tile_end], n_splats, squares,
    )  # fmt: skip
    return weights, pixels


@torch.no_grad()
def contributions(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the weight and the number of pixels of each Gaussian in each view (BlitzGS, section 3.2).

    Both are summed over the pixels p of a view at which the renderer composites the Gaussian; alpha and the
    transmittance T are the renderer's::

        weight = sum of alpha_p T_p;    pixels = their number

    Each alpha T enters as an integer number of 2^-32, so the sums are exact: on one device the result has the
    same bits in every run. The arguments are those of :func:`blitzgs.rasterization`. Not differentiable.

    Args:
        means: [N, 3], float32, or (CPU) float64; the other tensors share its dtype and device.
        quats: [N, 4] (w, x, y, z), need not be normalised.
        scales: [N, 3] standard deviations (after the exponential).
        opacities: [N] in [0, 1] (after the sigmoid).
        viewmats: [C, 4, 4] world to camera, a rotation and a translation; any number of views.
        Ks: [C, 3, 3] intrinsics in px.
        width: of every view, px.
        height: of every view, px.
        near_plane: Gaussians have z > near_plane, world units.
        far_plane: Gaussians have z <= far_plane, world units.
        eps2d: variance added to both screen axes, px^2.
        rasterize_mode: "classic" or "antialiased".

    Returns:
        weights float64 [C, N]; pixels int64 [C, N]; visible bool [C, N]: in depth range, and the box around
        its alpha >= 1/255 overlaps the image (gsplat's radii > 0).

    Raises:
        ValueError: an unknown `rasterize_mode`.
        RuntimeError: a wrong shape, dtype or value, by name.
    """
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be 'classic' or 'antialiased', got {rasterize_mode!r}")
    shape = (len(viewmats), len(means))
    weights = torch.zeros(shape, dtype=torch.float64, device=means.device)
    pixels = torch.zeros(shape, dtype=torch.int64, device=means.device)
    visible = torch.zeros(shape, dtype=torch.bool, device=means.device)
    for begin in range(0, len(viewmats), _VIEWS):
        views = slice(begin, begin + _VIEWS)
        n_views = len(viewmats[views])
        options = ProjectionOptions(
            width, height, _TILE_SIZE, near_plane=near_plane, far_plane=far_plane, eps2d=eps2d,
            antialiased=rasterize_mode == "antialiased", raw=False,
        )  # fmt: skip
        gaussians, cameras = (means, quats, scales, opacities), (viewmats[views], Ks[views])
        splats = project_splats(ProjectionInputs(gaussians, cameras, options))
        splat_weights, splat_pixels = _contributions_of_splats(splats, n_views, width, height)
        at = splats.camera_ids.long() + begin, splats.gaussian_ids.long()
        weights[at] = splat_weights.double() / UNITS
        pixels[at] = splat_pixels.long()
        visible[at] = True
    return weights, pixels, visible


def _contributions_of_splats(
    splats: ProjectedSplats, n_views: int, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Return the weights and pixels of all splats of a projection."""
    geometry = splats.means2d, splats.conics, splats.opacities
    grid = [n_views, width, height, _TILE_SIZE, 0, -1]
    lists = torch.ops.blitzgs.intersect(
        *geometry, splats.depths, splats.camera_ids, None, grid, int(splats.counts[2]), None, True
    )
    return splat_contributions(*geometry, *lists, n_cameras=n_views, width=width, height=height)


@torch.library.register_fake("blitzgs::contributions")
def _(means2d: Tensor, *_rest: object, **_flags: object) -> tuple[Tensor, Tensor]:
    n_splats = means2d.shape[0]
    return means2d.new_empty(n_splats, dtype=torch.int64), means2d.new_empty(n_splats, dtype=torch.int32)
