# SPDX-License-Identifier: Apache-2.0
"""Makes pictures of others: a render beside its photograph, and numbers as colours with a legend."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.view.look import Picture
from blitzgs.view.views import CameraLike

UInt8 = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
KINDS = ("off", "side by side", "wipe", "error")
# Rows of a grid for three images, by its columns.
ROWS = {3: 1, 2: 2, 1: 3}
# The difference that has the brightest colour, as a share of white.
_BRIGHTEST = 0.25


class Shaded(NamedTuple):
    """Colours to show, uint8 [H, W, 3], and what is known of them."""

    image: UInt8
    low: float | None = None  # the number that the darkest colour stands for; None: it stands for none
    high: float | None = None  # that of the brightest
    psnr: float | None = None  # in dB, of a render over the pixels of its photograph; None: not compared


def fitting_fov(camera: CameraLike, aspect: float) -> float:
    """Return the vertical field of view in radians at which an image of an aspect holds the photograph."""
    height = max(float(camera.height), camera.width / aspect)
    return 2 * math.atan(height / (2 * float(camera.K[1, 1])))


def compare(
    kind: str,
    render: UInt8,
    photograph: UInt8,
    camera: CameraLike,
    K: Matrix,
    wipe: float = 0.5,
    columns: int = 3,
) -> Shaded:
    """Compose a render with the photograph of a camera at the same place.

    Args:
        kind: one of `KINDS`, not "off". "side by side" returns a grid of images of the render's size.
        render: the render, uint8 [H, W, 3], from the camera's pose with the intrinsics `K`.
        photograph: uint8 [h, w, 3].
        camera: the photograph's camera.
        K: intrinsics of the render, [3, 3].
        wipe: share of the width that shows the photograph.
        columns: of the grid of "side by side".
    """
    height, width = render.shape[:2]
    placed, inside = _placed(photograph, camera, K, width, height)
    seen = inside[..., None]
    difference = np.where(seen, render.astype(np.float32) - placed, 0)
    mean = float(np.square(difference[inside] / 255).mean()) if inside.any() else 1.0
    psnr = -10 * math.log10(max(mean, 1e-12))
    brightness = np.clip(np.abs(difference).mean(axis=2) / (255 * _BRIGHTEST), 0, 1)
    error = _coloured(brightness, cv2.COLORMAP_INFERNO)
    if kind == "side by side":
        pictures = {"photograph": placed, "render": render * seen, "error": error}
        parts = [_labelled(picture, name) for name, picture in pictures.items()]
        parts += [np.zeros_like(error)] * (columns * ROWS[columns] - len(parts))
        rows = [np.concatenate(parts[k : k + columns], axis=1) for k in range(0, len(parts), columns)]
        return Shaded(np.concatenate(rows), psnr=psnr)
    dark = (render * 0.35).astype(np.uint8)  # outside of the photograph
    shown = np.where(seen, error if kind == "error" else render, dark)
    if kind == "wipe":
        edge = int(round(np.clip(wipe, 0, 1) * width))
        shown[:, :edge] = np.where(seen, placed, dark)[:, :edge]
        shown[:, max(0, edge - 1) : edge + 1] = 255
    return Shaded(np.ascontiguousarray(shown), psnr=psnr)


def _coloured(shares: npt.NDArray[np.floating], table: int) -> UInt8:
    """Return the colours of numbers from 0 to 1, uint8 [H, W, 3], by a table of OpenCV."""
    return cv2.applyColorMap((255 * shares).astype(np.uint8), table)[..., ::-1].astype(np.uint8)


def grid_columns(camera: CameraLike, width: int, height: int) -> int:
    """Return in how many columns three images of a camera are largest in an area of a size."""

    def scale(columns: int) -> float:
        return min(width / columns / camera.width, height / ROWS[columns] / camera.height)

    return max(ROWS, key=scale)


def _placed(
    photograph: UInt8, camera: CameraLike, K: Matrix, width: int, height: int
) -> tuple[UInt8, npt.NDArray[np.bool_]]:
    """Draw a photograph where an image with the same pose and the intrinsics `K` shows its pixels.

    Returns the photograph, uint8 [H, W, 3], and where it is, bool [H, W].
    """
    focal = np.array([K[0, 0] / camera.K[0, 0], K[1, 1] / camera.K[1, 1]])
    shrink = np.minimum(
        1.0, focal * [camera.width / photograph.shape[1], camera.height / photograph.shape[0]]
    )
    if shrink.min() < 0.9:  # averaged, because the next step only interpolates
        size = np.maximum(1, np.round(shrink * photograph.shape[1::-1])).astype(int)
        photograph = cv2.resize(photograph, size.tolist(), interpolation=cv2.INTER_AREA).astype(np.uint8)
    scale = focal * [camera.width / photograph.shape[1], camera.height / photograph.shape[0]]
    shift = K[:2, 2] - focal * camera.K[:2, 2] + scale / 2 - 0.5
    affine = np.array([[scale[0], 0, shift[0]], [0, scale[1], shift[1]]])
    white = np.full(photograph.shape[:2], 255, np.uint8)
    placed = cv2.warpAffine(photograph, affine, (width, height), flags=cv2.INTER_LINEAR)
    inside = cv2.warpAffine(white, affine, (width, height), flags=cv2.INTER_NEAREST)
    return placed.astype(np.uint8), inside > 0


def _labelled(image: UInt8, text: str) -> UInt8:
    """Return an image with a text in its upper left corner."""
    out = np.ascontiguousarray(image)
    size = max(0.4, image.shape[1] / 900)
    place, font = (12, int(14 + 26 * size)), cv2.FONT_HERSHEY_SIMPLEX
    for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):
        cv2.putText(out, text, place, font, size, colour, thickness, cv2.LINE_AA)
    return out


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
    return Shaded(np.where((values > 0)[..., None], _coloured(share, table), np.uint8(0)), low, high)
