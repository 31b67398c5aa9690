# SPDX-License-Identifier: Apache-2.0
"""Writes SOG files (PlayCanvas, version 2): lossless WebP pictures of quantised columns in a ZIP archive.

gaussforge writes this format too, but compares every Gaussian with every entry of its palette on one core:
for 97,000 Gaussians of SH degree 3 it had not finished after nine minutes.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.formats.gaussians import Gaussians, GaussianSource, is_antialiased
from blitzgs.formats.packed import unit_blocks
from blitzgs.util.output import new_file

Bytes = npt.NDArray[np.uint8]

_BOOK = 256
# Entries of the palette of SH coefficients: at most, and one for so many Gaussians.
# A model of fewer Gaussians than `_EXACT` has an entry for each.
_PALETTE, _SHARED, _EXACT = 65536, 16, 4096
# Rounds of clustering, on so many rows for each entry.
_ROUNDS, _SAMPLE = 3, 4
# Bytes of a Gaussian in each picture.
_CHANNELS = {"means_l": 3, "means_u": 3, "scales": 3, "quats": 4, "sh0": 4, "shN_labels": 2}
# Values of a table of distances.
_TABLE = 1 << 25


def write_sog(path: Path, source: GaussianSource) -> None:
    """Write an SOG file. The model is read twice, block by block; its codes are 20 bytes a Gaussian.

    Raises:
        ValueError: there is no Gaussian, or a value cannot be shown.
        OSError: the file cannot be written, or `path` is no regular file.
    """
    count, survey = len(source), _survey(source)
    scales_book, colors_book = _codebook(survey.scales), _codebook(survey.colors)
    palette = _palette(survey.rest, count)
    codes = {name: np.empty((count, channels), dtype=np.uint8) for name, channels in _CHANNELS.items()}
    first = 0
    for block in unit_blocks(source):
        rows, first = slice(first, first + len(block)), first + len(block)
        shares = (_logs(block) - survey.least) / (survey.most - survey.least).clamp_min(1e-12)
        places = (shares * 65535).round().int().numpy()
        codes["means_l"][rows], codes["means_u"][rows] = places & 255, places >> 8
        codes["scales"][rows] = _labels(block.scales, scales_book)
        codes["quats"][rows] = _quats(block.quats)
        codes["sh0"][rows, :3] = _labels(block.sh[:, 0], colors_book)
        codes["sh0"][rows, 3] = (block.opacities.double().sigmoid() * 255).round().numpy()
        if source.degree > 0:
            named = _nearest(block.sh[:, 1:].flatten(1), palette).numpy()
            codes["shN_labels"][rows] = np.stack([named & 255, named >> 8], axis=1)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "BlitzGS"},
        "count": count,
        "antialias": is_antialiased(source),
        "means": {"mins": survey.least.tolist(), "maxs": survey.most.tolist(), "files": []},
        "scales": {"codebook": scales_book.tolist(), "files": []},
        "quats": {"files": []},
        "sh0": {"codebook": colors_book.tolist(), "files": []},
    }
    width = -(-int(np.ceil(count**0.5)) // 4) * 4
    sizes = dict.fromkeys(codes, (-(-count // (4 * width)) * 4, width))
    if source.degree > 0:
        book, rows_of_palette = _codebook(palette), -(-len(palette) // 64)
        codes["shN_centroids"] = _labels(palette, book).reshape(-1, 3)
        sizes["shN_centroids"] = (rows_of_palette, 64 * (palette.shape[1] // 3))
        meta["shN"] = {"count": len(palette), "bands": source.degree, "codebook": book.tolist(), "files": []}
    else:
        del codes["shN_labels"]
    with new_file(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name in sorted(codes):
            meta[name.partition("_")[0]]["files"].append(f"{name}.webp")
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), _webp(codes.pop(name), *sizes[name]))
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))


class _Survey(NamedTuple):
    """What is known of a model before it is written: `_logs` at the ends, and samples of its columns."""

    least: Tensor
    most: Tensor
    scales: Tensor
    colors: Tensor
    rest: Tensor


def _survey(source: GaussianSource) -> _Survey:
    ends: list[list[Tensor]] = [[], [], []]
    samples: list[list[Tensor]] = [[], [], []]
    step = max(1, len(source) // (_SAMPLE * _PALETTE))
    for block in unit_blocks(source):
        columns = (_logs(block), block.scales, block.sh[:, 0])
        for found, column in zip(ends, columns, strict=True):
            found.append(torch.stack([column.amin(dim=0), column.amax(dim=0)]))
        for found, column in zip(samples, (*columns[1:], block.sh[:, 1:].flatten(1)), strict=True):
            found.append(column[::step].clone())
    rows = (torch.cat(found) for found in ends)
    reach, *others = (torch.stack([found.amin(dim=0), found.amax(dim=0)]) for found in rows)
    scales, colors, rest = (torch.cat(found) for found in samples)
    # The ends are in the samples, because codebooks span them.
    scales, colors = (torch.cat(pair) for pair in zip((scales, colors), others, strict=True))
    return _Survey(reach[0], reach[1], scales, colors, rest)


def _logs(block: Gaussians) -> Tensor:
    """Return the scale on which positions are stored, float64 [N, 3]."""
    means = block.means.double()
    return means.sign() * means.abs().log1p()


def _webp(columns: Bytes, height: int, width: int) -> bytes:
    """Return a lossless picture of 1 to 4 columns, [N, C]: red, green, blue, alpha."""
    pixels = np.zeros((height * width, 4), dtype=np.uint8)
    pixels[:, 3] = 255
    # OpenCV's order of the channels is BGRA.
    for channel, column in zip((2, 1, 0, 3), columns.T, strict=False):
        pixels[: len(column), channel] = column
    # A quality above 100 is lossless.
    _, data = cv2.imencode(".webp", pixels.reshape(height, width, 4), [cv2.IMWRITE_WEBP_QUALITY, 101])
    return bytes(data)


def _codebook(values: Tensor) -> Tensor:
    """Return 256 values that stand for others, float64, ascending; they are clustered by Lloyd's method."""
    some = values.flatten().double().sort().values
    # Half of them are as frequent as the values, and half are evenly spaced for the rare ones.
    ranks = torch.linspace(0, len(some) - 1, _BOOK // 2).round().long()
    even = torch.linspace(float(some[0]), float(some[-1]), _BOOK // 2, dtype=torch.float64)
    book = torch.cat([some[ranks], even]).sort().values
    for _ in range(10):
        nearest = torch.bucketize(some, (book[1:] + book[:-1]) / 2)
        counts = torch.bincount(nearest, minlength=_BOOK)
        sums = torch.zeros(_BOOK, dtype=torch.float64).index_add_(0, nearest, some)
        book = torch.where(counts > 0, sums / counts.clamp_min(1), book).sort().values
    return book


def _labels(values: Tensor, book: Tensor) -> Bytes:
    """Return for each value the nearest one of a codebook."""
    return torch.bucketize(values.double(), (book[1:] + book[:-1]) / 2).to(torch.uint8).numpy()


def _palette(sample: Tensor, count: int) -> Tensor:
    """Return a palette [P, D] for `count` rows of which there is a sample [S, D]; D may be 0."""
    size = min(_PALETTE, max(_EXACT, -(-count // (64 * _SHARED)) * 64))
    order = torch.randperm(len(sample), generator=torch.Generator().manual_seed(0))
    some = sample[order[: _SAMPLE * size]]
    palette = some[:size].clone()
    if sample.shape[1] == 0:
        return palette
    for _ in range(_ROUNDS):
        nearest = _nearest(some, palette)
        counts = torch.bincount(nearest, minlength=len(palette))[:, None]
        sums = torch.zeros_like(palette).index_add_(0, nearest, some)
        palette = torch.where(counts > 0, sums / counts.clamp_min(1), palette)
    return palette


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
