# SPDX-License-Identifier: Apache-2.0
"""Optional arguments of calls: signals that are composited beside the colours, and pixels to render."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

NORMAL_CHANNELS = 3
_MAX_DEGREE = 3


class Signals(NamedTuple):
    """The extra signals of a call."""

    values: Tensor  # of all scenes: [..., N, E], per view [..., C, N, E], or SH coefficients [..., N, K, E]
    sh_degree: int | None  # degree of the SH that are evaluated; None: the values are composited
    per_view: bool  # whether every view has its own values

    @property
    def channels(self) -> int:
        """Number of channels E."""
        return self.values.shape[-1]


def checked_signals(values: Tensor, sh_degree: int | None, batch: tuple[int, ...], C: int, N: int) -> Signals:
    """Check the shape of extra signals.

    `values`: `extra_signals` of `blitzgs.rasterization`. `sh_degree`: its `extra_signals_sh_degree`.
    ValueError: a shape or the degree does not fit.
    """
    shape, per_view = tuple(values.shape), False
    if sh_degree is None:
        per_view = shape[:-1] == (*batch, C, N)
        wanted, fits = "[..., N, E] or [..., C, N, E]", per_view or shape[:-1] == (*batch, N)
    else:
        if isinstance(sh_degree, bool) or sh_degree not in range(_MAX_DEGREE + 1):
            raise ValueError(f"extra_signals_sh_degree must be None or 0 to {_MAX_DEGREE}, got {sh_degree!r}")
        least = (sh_degree + 1) ** 2
        wanted = f"SH coefficients [N, K, E] or [..., N, K, E] with K of at least {least}"
        if batch and len(shape) == 3 and shape[0] == N:  # all scenes share them, as in gsplat
            values = values.expand(*batch, *shape)
        fits = values.shape[:-2] == (*batch, N) and values.shape[-2] >= least
    if not fits or shape[-1] == 0:
        raise ValueError(
            f"extra_signals must be {wanted}, here with {[*batch]} before N = {N}, C = {C}, got {[*shape]}"
        )
    return Signals(values, sh_degree, per_view)


class Pixels(NamedTuple):
    """The pixels of a call."""

    numbers: Tensor  # int64 [M], (image H + row) W + column
    images: Tensor  # int64 [M], the image of each
    rows: Tensor  # int64 [M]
    columns: Tensor  # int64 [M]


def checked_pixels(
    pixels: Tensor | None, image_ids: Tensor | None, images: int, width: int, height: int
) -> Pixels | None:
    """Check a list of pixels; None: there is none.

    `pixels`: integers [M, 2], (row, column). `image_ids`: integers [M], the image of each pixel, counted
    through all batch dimensions; None: 0. TypeError: they are not tensors of integers. ValueError: a shape
    does not fit, a pixel is outside the images, or there are several images and no `image_ids`.
    """
    if pixels is None:
        if image_ids is not None:
            raise ValueError("image_ids need pixels; give both")
        return None
    if image_ids is None:
        if images != 1:
            raise ValueError(f"pixels of {images} images need image_ids, the image of each pixel")
        image_ids = torch.zeros_like(pixels[:, 0])
    for name, values in (("pixels", pixels), ("image_ids", image_ids)):
        if not isinstance(values, Tensor) or values.is_floating_point() or values.dtype == torch.bool:
            raise TypeError(f"{name} must be a tensor of integers")
    if pixels.dim() != 2 or pixels.shape[1] != 2 or image_ids.shape != pixels.shape[:1]:
        raise ValueError(
            f"pixels must be [M, 2] (row, column) and image_ids [M], got {[*pixels.shape]} and "
            f"{[*image_ids.shape]}"
        )
    places = torch.stack([image_ids.long(), *pixels.long().unbind(1)], dim=1)
    outside = ((places < 0) | (places >= places.new_tensor([images, height, width]))).any(dim=1)
    if outside.any():
        first = int(outside.nonzero()[0, 0])
        image, row, column = places[first].tolist()
        raise ValueError(
            f"pixel {first} is (row, column) = ({row}, {column}) of image {image}, outside {images} "
            f"images of {height} x {width} px"
        )
    image, row, column = places.unbind(dim=1)
    return Pixels((image * height + row) * width + column, image, row, column)
