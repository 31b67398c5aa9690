# SPDX-License-Identifier: Apache-2.0
"""Puts a photograph, the render from there and their difference into one image."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.view.views import CameraLike

UInt8 = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
KINDS = ("off", "side by side", "wipe", "error")
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
    kind: str, render: UInt8, photograph: UInt8, camera: CameraLike, K: Matrix, wipe: float = 0.5
) -> Compared:
    """Compose a render with the photograph of a camera at the same place.

    Args:
        kind: one of `KINDS`, not "off". "side by side" returns an image three times as wide as the render.
        render: the render, uint8 [H, W, 3], from the camera's pose with the intrinsics `K`.
        photograph: uint8 [h, w, 3].
        camera: the photograph's camera.
        K: intrinsics of the render, [3, 3].
        wipe: share of the width that shows the photograph.
    """
    height, width = render.shape[:2]
    # From pixels of the photograph to pixels of the render: both have the same pose.
    ratio = np.array([camera.width / photograph.shape[1], camera.height / photograph.shape[0]])
    scale = np.array([K[0, 0] / camera.K[0, 0], K[1, 1] / camera.K[1, 1]])
    shift = K[:2, 2] - scale * camera.K[:2, 2]
    step = scale * ratio
    affine = np.array(
        [[step[0], 0, shift[0] + step[0] / 2 - 0.5], [0, step[1], shift[1] + step[1] / 2 - 0.5]]
    )
    placed = cv2.warpAffine(photograph, affine, (width, height), flags=cv2.INTER_AREA).astype(np.uint8)
    inside = cv2.warpAffine(
        np.full(photograph.shape[:2], 255, np.uint8), affine, (width, height), flags=cv2.INTER_NEAREST
    )
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
        parts = [_labelled(placed, "photograph"), _labelled(render, "render"), _labelled(error, "error")]
        return Compared(np.concatenate(parts, axis=1), psnr)
    dark = (render * 0.35).astype(np.uint8)  # outside of the photograph
    shown = np.where((inside > 0)[..., None], error if kind == "error" else render, dark)
    if kind == "wipe":
        edge = int(round(np.clip(wipe, 0, 1) * width))
        shown[:, :edge] = np.where((inside[:, :edge] > 0)[..., None], placed[:, :edge], dark[:, :edge])
        shown[:, max(0, edge - 1) : edge + 1] = 255
    return Compared(np.ascontiguousarray(shown), psnr)


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
