# SPDX-License-Identifier: Apache-2.0
"""Turns pictures of one number a pixel into colours, with a legend."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.view.look import Picture

UInt8 = npt.NDArray[np.uint8]


class Shaded(NamedTuple):
    """Colours to show, uint8 [H, W, 3], and the numbers that the darkest and the brightest colour stand for.

    `low` and `high` are None for pictures that are colours already.
    """

    image: UInt8
    low: float | None = None
    high: float | None = None


def shaded(picture: Picture, mode: str) -> Shaded:
    """Return the colours of a picture of a mode of `blitzgs.view.look.MODES`."""
    values = picture.values
    if values.ndim == 3:
        return Shaded(values.astype(np.uint8))
    if mode == "alpha":
        grey = np.clip(values * 255 + 0.5, 0, 255).astype(np.uint8)
        return Shaded(np.repeat(grey[..., None], 3, axis=2), 0.0, 1.0)
    known = values[values > 0]
    if len(known) == 0:
        return Shaded(np.zeros((*values.shape, 3), dtype=np.uint8), 0.0, 0.0)
    some = known[:: max(1, len(known) // 50_000)]
    low, high = (float(value) for value in np.quantile(some, (0.02, 0.98)))
    if mode == "count":
        low = 0.0
    high = max(high, low + 1e-6)
    share = np.clip((values - low) / (high - low), 0, 1)
    if mode == "depth":
        share = 1 - share  # near is bright
    table = cv2.COLORMAP_TURBO if mode == "depth" else cv2.COLORMAP_INFERNO
    colours = cv2.applyColorMap((share * 255).astype(np.uint8), table)[..., ::-1]
    colours = np.where((values > 0)[..., None], colours, 0).astype(np.uint8)
    return Shaded(np.ascontiguousarray(colours), low, high)
