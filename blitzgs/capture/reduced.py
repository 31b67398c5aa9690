# SPDX-License-Identifier: Apache-2.0
"""Averages images over squares of pixels, for a training that begins with a lower resolution."""

from __future__ import annotations

import cv2
import numpy as np

from blitzgs.capture.image_files import UInt8


def reduced(pixels: UInt8, mask: UInt8 | None, factor: int) -> UInt8:
    """Return the mean colours of squares of `factor` x `factor` pixels, rounded.

    The rest of a width or height that does not divide is cut off on the right and below, so that the pinhole
    of the result has the same intrinsics divided by `factor`.

    Args:
        pixels: [H, W, 3], or [H, W].
        mask: [H, W], 0 = excluded; None: all pixels count. A mean is that of the pixels that count, or 0
            where none does.
        factor: at most 16.
    """
    width, height = pixels.shape[1] // factor, pixels.shape[0] // factor
    pixels = pixels[: height * factor, : width * factor]
    if mask is None:
        return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    # In float32, these sums are exact.
    counted = (mask[: height * factor, : width * factor] != 0).astype(np.float32)
    share = cv2.resize(counted, (width, height), interpolation=cv2.INTER_AREA)
    sums = cv2.resize(pixels * counted[..., None], (width, height), interpolation=cv2.INTER_AREA)
    return np.rint(sums / np.maximum(share, factor**-2)[..., None]).astype(np.uint8)


def reduced_mask(mask: UInt8, factor: int) -> UInt8:
    """Return which squares of `factor` x `factor` pixels count, 0 or 1: at least half of their pixels do."""
    height, width = mask.shape[0] // factor, mask.shape[1] // factor
    squares = (mask[: height * factor, : width * factor] != 0).reshape(height, factor, width, factor)
    return (2 * squares.sum((1, 3)) >= factor**2).astype(np.uint8)
