# SPDX-License-Identifier: Apache-2.0
"""What each Gaussian contributes to each view, and which Gaussians each pixel shows.

The functions about pixels have gsplat's names and results.
"""

from __future__ import annotations

from numbers import Integral

import torch
from torch import Tensor

from blitzgs.call.arguments import Scene, check_tensors, checked_options, gaussians_of
from blitzgs.call.bad_values import check_intrinsics, warn_of_non_finite
from blitzgs.call.extras import checked_pixels
from blitzgs.ops.importance import UNITS, PixelSplats, pixel_splats
from blitzgs.ops.intersect import TileGrid, tile_counts
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectionInputs

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
        Ks: [C, 3, 3] intrinsics in px.
        width, height, near_plane, far_plane, eps2d, rasterize_mode: as in `blitzgs.rasterization`.

    Returns:
        weights float64 [C, N]; pixels int64 [C, N]; visible bool [C, N]: in depth range, and the box around
        its alpha >= 1/255 overlaps the image (gsplat's radii > 0). A Gaussian may be visible in this sense
        and contribute to no pixel.

    Warns, raises:
        As `blitzgs.rasterization`; all arguments are looked at for values that are not finite.
    """
    options = checked_options(
        width, height, near_plane, far_plane, radius_clip=0.0, eps2d=eps2d, sh_degree=None, tile_size=None,
        rasterize_mode=rasterize_mode,
    )  # fmt: skip
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    check_tensors({**tensors, "viewmats": viewmats, "Ks": Ks}, {})
    if means.dim() != 2:
        raise ValueError(f"means must be [N, 3], got {list(means.shape)}")
    scene = Scene(means, quats, scales, opacities, None, viewmats, Ks)
    gaussians = gaussians_of("contributions", scene, sh_degree=None, render_mode="D")
    warn_of_non_finite(gaussians)
    check_intrinsics([Ks])
    shape = (len(viewmats), len(means))
    weights = torch.zeros(shape, dtype=torch.float64, device=means.device)
    pixels = torch.zeros(shape, dtype=torch.int64, device=means.device)
    visible = torch.zeros(shape, dtype=torch.bool, device=means.device)
    for begin in range(0, len(viewmats), _VIEWS):
        cameras = viewmats[begin : begin + _VIEWS], Ks[begin : begin + _VIEWS]
        splats = project_splats(ProjectionInputs((means, quats, scales, opacities), cameras, options))
        geometry = splats.means2d, splats.conics, splats.opacities
        grid = TileGrid(len(cameras[0]), width, height, options.tile_size)
        lists = torch.ops.blitzgs.intersect(
            *geometry, splats.depths, splats.camera_ids, None, *grid, int(splats.counts[2]), unchecked=True
        )
        splat_weights, splat_pixels, _ = torch.ops.blitzgs.contributions(*geometry, *lists, *grid)
        at = splats.camera_ids.long() + begin, splats.gaussian_ids.long()
        weights[at] = splat_weights.double() / UNITS
        pixels[at] = splat_pixels.long()
        visible[at] = True
    return weights, pixels, visible


def rasterize_num_contributing_gaussians(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    *,
    pixels: Tensor | None = None,
    image_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Count the Gaussians that each pixel composites.

    The arguments are entries of the `meta` of :func:`blitzgs.rasterization`, packed or not. Alpha and T have
    the bits of the image. Not differentiable.

    Args:
        means2d: packed [nnz, 2], or [..., N, 2], float32 or (CPU) float64.
        conics: [nnz, 3] or [..., N, 3].
        opacities: [nnz] or [..., N], `meta["opacities"]`.
        tile_offsets: `meta["isect_offsets"]`, [..., tile_height, tile_width].
        flatten_ids: `meta["flatten_ids"]`, [n_isects].
        image_width, image_height, tile_size: entries of `meta`, px; tiles are of 16 px on CUDA.
        pixels: [M, 2] (row, column) of the pixels to return; None: all.
        image_ids: [M], the image of each pixel; None: there is one image.

    Returns:
        Numbers int32 and alphas, [..., image_height, image_width] each, or [M] with `pixels`.

    Raises:
        TypeError: an argument is not a tensor or has a wrong dtype.
        ValueError: a shape does not fit, or a pixel is outside the images.
        RuntimeError: the tile size is not 16 on CUDA, or on the CPU, the entries are of several calls.
    """
    entries, grid = (
        (means2d, conics, opacities, tile_offsets, flatten_ids),
        (image_width, image_height, tile_size),
    )
    found, lead = _splats_of_pixels(entries, grid, 0, pixels, image_ids)
    return found.counts.reshape(lead), (1 - found.transmittances).reshape(lead)


def rasterize_contributing_gaussian_ids(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    num_contributing_gaussians: Tensor,
    *,
    pixels: Tensor | None = None,
    image_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return all Gaussians that each pixel composites, front to back, with their weights alpha T.

    The arguments and errors are those of `rasterize_num_contributing_gaussians`, and
    `num_contributing_gaussians` is what that function returned for the same pixels. The result is as long as
    the longest list of a pixel, so choose `pixels` where the images are large.

    Returns:
        Ids int32 [..., image_height, image_width, K] with K the largest number, then -1; and weights of this
        shape, then 0; [M, K] with `pixels`. Packed, ids number the entries of `meta`, whose Gaussians
        `meta["gaussian_ids"]` has; otherwise the N Gaussians.
    """
    if not isinstance(num_contributing_gaussians, Tensor):
        raise TypeError(
            "num_contributing_gaussians must be what rasterize_num_contributing_gaussians returned"
        )
    most = int(num_contributing_gaussians.max()) if num_contributing_gaussians.numel() else 0
    return rasterize_top_contributing_gaussian_ids(
        means2d, conics, opacities, tile_offsets, flatten_ids, image_width, image_height, tile_size, most,
        pixels=pixels, image_ids=image_ids,
    )  # fmt: skip


def rasterize_top_contributing_gaussian_ids(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    num_depth_samples: int,
    *,
    pixels: Tensor | None = None,
    image_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the Gaussians of the largest weights alpha T in each pixel, front to back.

    The arguments and errors are those of `rasterize_num_contributing_gaussians`, and `num_depth_samples` is
    the number K of Gaussians of each pixel. Of equal weights, the Gaussians in front are returned.

    Returns:
        Ids and weights, as `rasterize_contributing_gaussian_ids` returns them.
    """
    entries, grid = (
        (means2d, conics, opacities, tile_offsets, flatten_ids),
        (image_width, image_height, tile_size),
    )
    found, lead = _splats_of_pixels(entries, grid, num_depth_samples, pixels, image_ids)
    ids = found.ids
    if means2d.dim() > 2:
        ids = torch.where(ids < 0, ids, ids % max(means2d.shape[-2], 1))
    return ids.reshape(*lead, num_depth_samples), found.weights.reshape(*lead, num_depth_samples)


def _splats_of_pixels(
    entries: tuple[Tensor, ...],  # means2d, conics, opacities, tile_offsets, flatten_ids
    grid: tuple[int, int, int],  # image_width, image_height, tile_size
    strongest: int,
    pixels: Tensor | None,
    image_ids: Tensor | None,
) -> tuple[PixelSplats, tuple[int, ...]]:
    """Check the arguments; return the splats of the pixels and the leading shape of the results."""
    means2d, conics, opacities, tile_offsets, flatten_ids = entries
    width, height, tile_size = grid
    check_tensors({"means2d": means2d, "conics": conics, "opacities": opacities}, {})
    for name, integers in (("tile_offsets", tile_offsets), ("flatten_ids", flatten_ids)):
        if not isinstance(integers, Tensor) or integers.is_floating_point():
            raise TypeError(f"{name} must be a tensor of integers, as meta has it")
    whole = {"image_width": (width, 1), "image_height": (height, 1), "tile_size": (tile_size, 1)}
    for name, (value, least) in {**whole, "num_depth_samples": (strongest, 0)}.items():
        if not isinstance(value, Integral) or value < least:
            raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    shape, tiles = tuple(means2d.shape[:-1]), tile_counts(width, height, tile_size)[::-1]
    for name, tensor, wanted in (
        ("means2d", means2d, (*shape, 2)),
        ("conics", conics, (*shape, 3)),
        ("opacities", opacities, shape),
        ("tile_offsets", tile_offsets, (*tile_offsets.shape[:-2], *tiles)),
    ):
        if tensor.shape != wanted or means2d.dim() < 2:
            raise ValueError(f"{name} must be {[*wanted]}, got {[*tensor.shape]}")
    lead = tuple(tile_offsets.shape[:-2])
    images = tile_offsets[..., :1, :1].numel() if tile_offsets.numel() else 0
    listed = checked_pixels(pixels, image_ids, images, width, height)
    numbers = None if listed is None else listed.numbers
    end = torch.full((1,), len(flatten_ids), dtype=torch.int64, device=tile_offsets.device)
    geometry = means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.reshape(-1)
    lists = flatten_ids.int(), torch.cat([tile_offsets.reshape(-1).long(), end])
    found = pixel_splats(
        *geometry, *lists, n_cameras=images, width=width, height=height, tile_size=tile_size,
        strongest=strongest, pixels=numbers,
    )  # fmt: skip
    return found, (*lead, height, width) if numbers is None else (len(numbers),)
