# SPDX-License-Identifier: Apache-2.0
"""The pixels that a call renders, if not all."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Pixels(NamedTuple):
    """The pixels of a call.

    Attributes:
        numbers: int64 [M], (image H + row) W + column.
        images: int64 [M], the image of each.
        rows: int64 [M].
        columns: int64 [M].
    """

    numbers: Tensor
    images: Tensor
    rows: Tensor
    columns: Tensor


def checked_pixels(pixels: Tensor, image_ids: Tensor | None, images: int, width: int, height: int) -> Pixels:
    """Check a list of pixels.

    Args:
        pixels: integers [M, 2], (row, column).
        image_ids: integers [M], the image of each pixel, counted through all batch dimensions; None: 0.
        images: number of images.
        width: px.
        height: px.

    Raises:
        TypeError: they are not tensors of integers.
        ValueError: a shape does not fit, a pixel is outside the images, or there are several images and no
            `image_ids`.
    """
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
