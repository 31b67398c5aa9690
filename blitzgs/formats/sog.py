# SPDX-License-Identifier: Apache-2.0
"""Writes SOG files (PlayCanvas, version 2): lossless WebP pictures of quantised columns in a ZIP archive.

gaussforge writes this format too, but compares every Gaussian with every entry of its palette on one core:
for 97,000 Gaussians of SH degree 3 it had not finished after nine minutes.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.formats.gaussians import GaussianSource, is_antialiased
from blitzgs.formats.packed import collected
from blitzgs.util.output import write_file

Bytes = npt.NDArray[np.uint8]

_BOOK = 256
# Entries of the palette of SH coefficients: at most, and one for so many Gaussians.
# A model of fewer Gaussians than `_EXACT` has an entry for each.
_PALETTE, _SHARED, _EXACT = 65536, 16, 4096
# Rounds of clustering, on so many rows for each entry.
_ROUNDS, _SAMPLE = 3, 4
# Values of a table of distances.
_TABLE = 1 << 25


def write_sog(path: Path, source: GaussianSource) -> None:
    """Write an SOG file.

    Raises:
        ValueError: there is no Gaussian, or a value cannot be shown.
        OSError: the file cannot be written, or `path` is no regular file.
    """
    model = collected(source)
    count = len(model)
    width = -(-int(np.ceil(count**0.5)) // 4) * 4
    height = -(-count // (4 * width)) * 4
    parts: dict[str, bytes] = {}

    def picture(name: str, columns: list[Bytes], size: tuple[int, int] = (height, width)) -> str:
        pixels = np.full((size[0] * size[1], 4), 255, dtype=np.uint8)
        for channel, column in enumerate(columns):
            pixels[:, channel] = 0
            pixels[: len(column), channel] = column
        # A quality above 100 is lossless. OpenCV's order of the channels is BGRA.
        shaped = np.ascontiguousarray(pixels.reshape(*size, 4)[..., [2, 1, 0, 3]])
        _, data = cv2.imencode(".webp", shaped, [cv2.IMWRITE_WEBP_QUALITY, 101])
        parts[f"{name}.webp"] = bytes(data)
        return f"{name}.webp"

    means = model.means.double()
    logs = means.sign() * means.abs().log1p()
    least, most = logs.amin(dim=0), logs.amax(dim=0)
    codes = ((logs - least) / (most - least).clamp_min(1e-12) * 65535).round().int().numpy()
    low, high = (list((codes >> shift & 255).astype(np.uint8).T) for shift in (0, 8))
    scales_book, scales = _by_codebook(model.scales)
    colors_book, colors = _by_codebook(model.sh[:, 0])
    opacities = (model.opacities.double().sigmoid() * 255).round().to(torch.uint8).numpy()
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "BlitzGS"},
        "count": count,
        "antialias": is_antialiased(model),
        "means": {
            "mins": least.tolist(),
            "maxs": most.tolist(),
            "files": [picture("means_l", low), picture("means_u", high)],
        },
        "scales": {"codebook": scales_book, "files": [picture("scales", list(scales.T))]},
        "quats": {"files": [picture("quats", list(_quats(model.quats).T))]},
        "sh0": {"codebook": colors_book, "files": [picture("sh0", [*colors.T, opacities])]},
    }
    if model.degree > 0:
        rest = model.sh[:, 1:]
        palette, labels = _palette(rest.flatten(1))
        book, entries = _by_codebook(palette)
        rows, k = -(-len(palette) // 64), rest.shape[1]
        pixels = entries.reshape(-1, 3)
        named = labels.numpy()
        meta["shN"] = {
            "count": len(palette),
            "bands": model.degree,
            "codebook": book,
            "files": [
                picture("shN_centroids", list(pixels.T), (rows, 64 * k)),
                picture("shN_labels", [(named & 255).astype(np.uint8), (named >> 8).astype(np.uint8)]),
            ],
        }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, part in {**parts, "meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(zipfile.ZipInfo(name), part)
    write_file(path, content.getvalue())


def _by_codebook(values: Tensor) -> tuple[list[float], Bytes]:
    """Return 256 values and for each of `values` the nearest one; they are clustered by Lloyd's method."""
    flat = values.flatten().double()
    some = flat[:: max(1, len(flat) // 1_000_000)].sort().values
    # Half of them are as frequent as the values, and half are evenly spaced for the rare ones.
    ranks = torch.linspace(0, len(some) - 1, _BOOK // 2).round().long()
    even = torch.linspace(float(flat.min()), float(flat.max()), _BOOK // 2, dtype=torch.float64)
    book = torch.cat([some[ranks], even]).sort().values
    for _ in range(10):
        nearest = torch.bucketize(some, (book[1:] + book[:-1]) / 2)
        counts = torch.bincount(nearest, minlength=_BOOK)
        sums = torch.zeros(_BOOK, dtype=torch.float64).index_add_(0, nearest, some)
        book = torch.where(counts > 0, sums / counts.clamp_min(1), book).sort().values
    labels = torch.bucketize(flat, (book[1:] + book[:-1]) / 2)
    return book.tolist(), labels.to(torch.uint8).reshape(values.shape).numpy()


def _palette(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return a palette [P, D] for rows [N, D], and for each row the nearest entry, int64 [N]."""
    generator = torch.Generator().manual_seed(0)
    size = min(_PALETTE, max(_EXACT, -(-len(rows) // (64 * _SHARED)) * 64))
    some = rows[torch.randperm(len(rows), generator=generator)[: _SAMPLE * size]]
    palette = some[:size].clone()
    for _ in range(_ROUNDS):
        nearest = _nearest(some, palette)
        counts = torch.bincount(nearest, minlength=len(palette))[:, None]
        sums = torch.zeros_like(palette).index_add_(0, nearest, some)
        palette = torch.where(counts > 0, sums / counts.clamp_min(1), palette)
    return palette, _nearest(rows, palette)


def _nearest(rows: Tensor, palette: Tensor) -> Tensor:
    lengths = (palette**2).sum(dim=1) / 2
    parts = rows.split(max(1, _TABLE // len(palette)))
    return torch.cat([torch.addmm(lengths, part, palette.T, alpha=-1).argmin(dim=1) for part in parts])


def _quats(quats: Tensor) -> Bytes:
    """Return unit quaternions as three bytes of the smaller components and one of the omitted one, [N, 4]."""
    largest = quats.abs().argmax(dim=1, keepdim=True)
    turned = quats * quats.gather(1, largest).sign()
    others = turned[torch.arange(4)[None] != largest].reshape(-1, 3)
    codes = ((others * 2**0.5 + 1) / 2 * 255).round().clamp(0, 255)
    return torch.cat([codes, 252.0 + largest], dim=1).to(torch.uint8).numpy()
