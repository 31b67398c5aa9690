# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians each pixel shows: their number, all, or the strongest; gsplat's names and results."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs.call.arguments import check_tensors
from blitzgs.call.pixels import checked_pixels
from blitzgs.ops.importance import PixelSplats, pixel_splats


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
        image_width: px.
        image_height: px.
        tile_size: `meta["tile_size"]`, px; 16 on CUDA.
        pixels: [M, 2] (row, column) of the pixels to return; None: all.
        image_ids: [M], the image of each pixel; None: there is one image.

    Returns:
        Numbers int32 and alphas, [..., image_height, image_width] each, or [M] with `pixels`.

    Raises:
        TypeError: an argument is not a tensor or has a wrong dtype.
        ValueError: a shape does not fit, or a pixel is outside the images.
        RuntimeError: the tile size is not 16 on CUDA.
    """
    found, lead = _splats_of_pixels(
        means2d, conics, opacities, tile_offsets, flatten_ids, image_width, image_height, tile_size, 0,
        pixels, image_ids,
    )  # fmt: skip
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

    The result is as long as the longest list of a pixel, so choose `pixels` where the images are large.

    Args:
        means2d: as for `rasterize_num_contributing_gaussians`.
        conics: likewise.
        opacities: likewise.
        tile_offsets: likewise.
        flatten_ids: likewise.
        image_width: px.
        image_height: px.
        tile_size: px.
        num_contributing_gaussians: what `rasterize_num_contributing_gaussians` returned for the same pixels.
        pixels: as for `rasterize_num_contributing_gaussians`.
        image_ids: likewise.

    Returns:
        Ids int32 [..., image_height, image_width, K] with K the largest number, then -1; and weights of this
        shape, then 0; [M, K] with `pixels`. Packed, ids number the entries of `meta`, whose Gaussians
        `meta["gaussian_ids"]` has; otherwise the N Gaussians.

    Raises:
        TypeError: as `rasterize_num_contributing_gaussians`.
        ValueError: likewise.
        RuntimeError: likewise.
    """
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

    Of equal weights, the Gaussians in front are returned.

    Args:
        means2d: as for `rasterize_num_contributing_gaussians`.
        conics: likewise.
        opacities: likewise.
        tile_offsets: likewise.
        flatten_ids: likewise.
        image_width: px.
        image_height: px.
        tile_size: px.
        num_depth_samples: number K of Gaussians of each pixel.
        pixels: as for `rasterize_num_contributing_gaussians`.
        image_ids: likewise.

    Returns:
        Ids and weights, as `rasterize_contributing_gaussian_ids` returns them.

    Raises:
        TypeError: as `rasterize_num_contributing_gaussians`.
        ValueError: likewise.
        RuntimeError: likewise.
    """
    found, lead = _splats_of_pixels(
        means2d, conics, opacities, tile_offsets, flatten_ids, image_width, image_height, tile_size,
        num_depth_samples, pixels, image_ids,
    )  # fmt: skip
    ids = found.ids
    if means2d.dim() > 2:
        ids = torch.where(ids < 0, ids, ids % max(means2d.shape[-2], 1))
    return ids.reshape(*lead, num_depth_samples), found.weights.reshape(*lead, num_depth_samples)


def _splats_of_pixels(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    width: int,
    height: int,
    tile_size: int,
    strongest: int,
    pixels: Tensor | None,
    image_ids: Tensor | None,
) -> tuple[PixelSplats, tuple[int, ...]]:
    """Check the arguments; return the splats of the pixels and the leading shape of the results."""
    check_tensors({"means2d": means2d, "conics": conics, "opacities": opacities}, {})
    for name, integers in (("tile_offsets", tile_offsets), ("flatten_ids", flatten_ids)):
        if not isinstance(integers, Tensor) or integers.is_floating_point():
            raise TypeError(f"{name} must be a tensor of integers, as meta has it")
    shape, tiles = tuple(means2d.shape[:-1]), (-(-height // tile_size), -(-width // tile_size))
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
    numbers = None
    if pixels is not None:
        numbers = checked_pixels(pixels, image_ids, images, width, height).numbers
    elif image_ids is not None:
        raise ValueError("image_ids need pixels; give both")
    end = torch.full((1,), len(flatten_ids), dtype=torch.int64, device=tile_offsets.device)
    found = pixel_splats(
        means2d.reshape(-1, 2),
        conics.reshape(-1, 3),
        opacities.reshape(-1),
        flatten_ids.int(),
        torch.cat([tile_offsets.reshape(-1).long(), end]),
        n_cameras=images,
        width=width,
        height=height,
        tile_size=tile_size,
        strongest=strongest,
        pixels=numbers,
    )
    return found, (*lead, height, width) if numbers is None else (len(numbers),)
