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


class Compared(NamedTuple):
    """The composed image, uint8 [H, W, 3], and the PSNR in dB of the render over the photograph's pixels."""

    image: UInt8
    psnr: float


def fitted(camera: CameraLike, width: int, height: int) -> Matrix:
    """Return intrinsics [3, 3] of an image of a size into which a camera's photograph fits wholly."""
    scale = min(width / camera.width, height / camera.height)
    focal = float(camera.K[1, 1]) * scale
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=np.float64)


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
) -> Compared:
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
    difference = np.abs(render.astype(np.float32) - placed).mean(axis=2) * (inside > 0)
    mean = (
        float((((render.astype(np.float32) - placed) / 255) ** 2)[inside > 0].mean()) if inside.any() else 1.0
    )
    psnr = -10 * math.log10(max(mean, 1e-12))
    brightness = np.clip(difference / (255 * _BRIGHTEST), 0, 1)
    error = cv2.applyColorMap((255 * brightness).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1].astype(
        np.uint8
    )
    if kind == "side by side":
        framed = render * (inside > 0)[..., None]
        parts = [_labelled(placed, "photograph"), _labelled(framed, "render"), _labelled(error, "error")]
        return Compared(_gridded(parts, columns), psnr)
    dark = (render * 0.35).astype(np.uint8)  # outside of the photograph
    shown = np.where((inside > 0)[..., None], error if kind == "error" else render, dark)
    if kind == "wipe":
        edge = int(round(np.clip(wipe, 0, 1) * width))
        shown[:, :edge] = np.where((inside[:, :edge] > 0)[..., None], placed[:, :edge], dark[:, :edge])
        shown[:, max(0, edge - 1) : edge + 1] = 255
    return Compared(np.ascontiguousarray(shown), psnr)


def grid_columns(camera: CameraLike, width: int, height: int) -> int:
    """Return in how many columns three images of a camera are largest in an area of a size."""

    def scale(columns: int) -> float:
        return min(width / columns / camera.width, height / ROWS[columns] / camera.height)

    return max(ROWS, key=scale)


def _gridded(parts: list[UInt8], columns: int) -> UInt8:
    """Put images of one size into a grid, row by row."""
    count = columns * ROWS[columns]
    cells = parts + [np.zeros_like(parts[0])] * (count - len(parts))
    rows = [np.concatenate(cells[k : k + columns], axis=1) for k in range(0, count, columns)]
    return np.concatenate(rows, axis=0)


def _placed(photograph: UInt8, camera: CameraLike, K: Matrix, width: int, height: int) -> tuple[UInt8, UInt8]:
    """Draw a photograph where an image with the same pose and the intrinsics `K` shows its pixels.

    Returns the photograph, uint8 [H, W, 3], and where it is: uint8 [H, W], 0 outside.
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
    return placed.astype(np.uint8), inside.astype(np.uint8)


def _labelled(image: UInt8, text: str) -> UInt8:
    """Return a copy of an image with a text in its upper left corner."""
    out = np.ascontiguousarray(image)
    size = max(0.4, image.shape[1] / 900)
    for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):
        cv2.putText(
            out,
            text,
            (12, int(14 + 26 * size)),
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            colour,
            thickness,
            cv2.LINE_AA,
        )
    return out


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
