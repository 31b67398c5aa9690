# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.contributions`: what each Gaussian contributes to each view."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.call.arguments import check_options, check_tensors, gaussians_of
from blitzgs.call.finite import warn_of_non_finite
from blitzgs.call.groups import CUDA_TILE_SIZE
from blitzgs.call.intrinsics import check_intrinsics, warn_of_gradient
from blitzgs.ops.importance import UNITS, splat_contributions
from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs, ProjectionOptions

# Views that are projected at once.
_VIEWS = 8


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
    transmittance T are the renderer's:

        weight = sum of alpha_p T_p;    pixels = their number

    Each alpha T enters as an integer number of 2^-32, so the sums are exact: on one device the result has the
    same bits in every run. The arguments are those of `blitzgs.rasterization`. Not differentiable.

    Args:
        means: [N, 3], float32, or (CPU) float64; the other tensors share its dtype and device.
        quats: [N, 4] (w, x, y, z), of any length; zero counts as the identity.
        scales: [N, 3] standard deviations (after the exponential).
        opacities: [N] in [0, 1] (after the sigmoid).
        viewmats: [C, 4, 4] world to camera, a rotation and a translation; any number of views.
        Ks: [C, 3, 3] intrinsics in px, without skew and with a last row 0, 0, 1.
        width: of every view, px.
        height: of every view, px.
        near_plane: Gaussians have z > near_plane, world units.
        far_plane: Gaussians have z <= far_plane, world units.
        eps2d: variance added to both screen axes, px^2.
        rasterize_mode: "classic" or "antialiased".

    Returns:
        weights float64 [C, N]; pixels int64 [C, N]; visible bool [C, N]: in depth range, and the box around
        its alpha >= 1/255 overlaps the image (gsplat's radii > 0). A Gaussian may be visible in this sense
        and contribute to no pixel.

    Warns:
        RuntimeWarning: an argument has values that are NaN or infinite; the Gaussians or views that have them
            contribute nothing.

    Raises:
        TypeError: an argument is not a tensor, or not the kind of number it should be; or the tensors are
            neither float32 nor float64.
        ValueError: an argument has a wrong shape or value, or another dtype or device than the others; the
            message names it.
        RuntimeError: float64 tensors are on a GPU, or the call is inside a transform of `torch.func`.
    """
    check_options(
        width, height, near_plane, far_plane, 0.0, eps2d, None, CUDA_TILE_SIZE, "D", rasterize_mode, "pinhole"
    )
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    check_tensors({**tensors, "viewmats": viewmats, "Ks": Ks}, {})
    if Ks.requires_grad:
        warn_of_gradient("contributions")
    if means.dim() != 2:
        raise ValueError(f"means must be [N, 3], got {list(means.shape)}")
    gaussians = gaussians_of(means, quats, scales, opacities, None, viewmats, Ks, None, "D")
    warn_of_non_finite(gaussians, "contributions", stacklevel=4)  # torch.no_grad is one more call
    check_intrinsics([Ks])
    shape = (len(viewmats), len(means))
    weights = torch.zeros(shape, dtype=torch.float64, device=means.device)
    pixels = torch.zeros(shape, dtype=torch.int64, device=means.device)
    visible = torch.zeros(shape, dtype=torch.bool, device=means.device)
    for begin in range(0, len(viewmats), _VIEWS):
        views = slice(begin, begin + _VIEWS)
        n_views = len(viewmats[views])
        options = ProjectionOptions(
            width, height, CUDA_TILE_SIZE, near_plane=near_plane, far_plane=far_plane, eps2d=eps2d,
            antialiased=rasterize_mode == "antialiased", raw=False,
        )  # fmt: skip
        cameras = viewmats[views], Ks[views]
        splats = project_splats(ProjectionInputs((means, quats, scales, opacities), cameras, options))
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
    grid = TileGrid(n_views, width, height, CUDA_TILE_SIZE)
    lists = torch.ops.blitzgs.intersect(
        *geometry, splats.depths, splats.camera_ids, None, *grid, int(splats.counts[2]), None, True
    )
    return splat_contributions(*geometry, *lists, n_cameras=n_views, width=width, height=height)[:2]
