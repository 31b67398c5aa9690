# SPDX-License-Identifier: Apache-2.0
"""Saves images, and pictures that show a render beside its photograph and its error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.image_files import UInt8
from blitzgs.util.errors import check_tensors
from blitzgs.util.output import write_file

# The error that the last colour of an error map shows.
_FULL_ERROR = 0.25
_LABELS = ("render", "photograph", f"error (red: {_FULL_ERROR} or more)")
_BAR = 24
_FONT, _LETTERS, _INDENT = cv2.FONT_HERSHEY_SIMPLEX, 0.5, 6
_GAP = 4


def to_uint8(image: Tensor) -> UInt8:
    """Quantise an image to uint8 [H, W, 3]: clamp floats to [0, 1] and round them; keep uint8 as it is."""
    image = image.detach().cpu()
    if image.dtype != torch.uint8:
        image = (image.float().nan_to_num(0.0).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return np.asarray(image.numpy())


def save_image(path: Path | str, image: Tensor) -> None:
    """Write an RGB image, float [H, W, 3] in [0, 1] or uint8; the suffix (.png, .jpg) chooses the format.

    Raises:
        OSError: the file cannot be written.
        TypeError: the image is not a tensor.
        ValueError: the format is not known, or the image has another shape or values that are NaN.
    """
    check_tensors(image=image)
    if bool(image.isnan().any()):
        raise ValueError(
            f"image has NaN in {int(image.isnan().sum()):,} of {image.numel():,} values: black in a file"
        )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, encode_image(image, path.suffix), sync=False)


def encode_image(image: Tensor, suffix: str) -> bytes:
    """Return an RGB image, float [H, W, 3] in [0, 1] or uint8, as a file of the format of `suffix`.

    ValueError: the format is not known, or the image has another shape.
    """
    if image.dim() != 3 or image.shape[2] != 3:
        raise ValueError(f"an image must be [H, W, 3], got {list(image.shape)}")
    try:
        written, data = cv2.imencode(suffix, np.ascontiguousarray(to_uint8(image)[..., ::-1]))
    except cv2.error:  # its message has paths of its sources
        written = False
    if not written:
        height, width = image.shape[:2]
        raise ValueError(
            f"cannot write a picture as '{suffix}' of {width:,} x {height:,} pixels: use .png, or for "
            "smaller ones .jpg or .webp"
        )
    return bytes(data)


def error_map(render: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute error over channels as colours from dark blue (0) to red (0.25 or more).

    Images are float (the target also uint8), [H, W, 3]; pixels with 0 in the mask, uint8 [H, W], become grey.
    Returns uint8 RGB [H, W, 3] on the CPU.
    """
    truth = target.cpu().float() / 255 if target.dtype == torch.uint8 else target.cpu().float()
    error = (render.detach().cpu().float().clamp(0, 1) - truth).abs().mean(dim=-1)
    levels = to_uint8(error / _FULL_ERROR)
    colors = np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1])
    if mask is not None:
        colors[mask.cpu().numpy() == 0] = 128
    return torch.from_numpy(colors)


def strip(images: Sequence[Tensor], labels: Sequence[str]) -> Tensor:
    """Return images of one height side by side, each under its label; uint8 RGB [H + bar, W, 3]."""
    if len({image.shape[0] for image in images}) != 1 or len(images) != len(labels):
        shapes = [list(image.shape) for image in images]
        raise ValueError(f"a strip needs images of one height and a label for each, got {shapes}, {labels}")
    panels: list[UInt8] = []
    for image, label in zip(images, labels, strict=True):
        pixels = to_uint8(image)
        panel = np.full((pixels.shape[0] + _BAR, pixels.shape[1], 3), 255, dtype=np.uint8)
        panel[_BAR:] = pixels
        # Above a narrow picture the letters are smaller, so that the label is whole.
        (width, _), _ = cv2.getTextSize(label, _FONT, _LETTERS, 1)
        letters = _LETTERS * min(1.0, max(1, panel.shape[1] - 2 * _INDENT) / width)
        cv2.putText(panel, label, (_INDENT, _BAR - 7), _FONT, letters, (0, 0, 0), 1, cv2.LINE_AA)
        panels += [panel, np.full((panel.shape[0], _GAP, 3), 255, dtype=np.uint8)]
    return torch.from_numpy(np.concatenate(panels[:-1], axis=1))


def comparison(render: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return render | photograph | error of one view side by side, uint8 RGB; arguments of `error_map`."""
    return strip([render, target, error_map(render, target, mask)], _LABELS)
