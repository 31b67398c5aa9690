# SPDX-License-Identifier: Apache-2.0
"""SOG files (PlayCanvas, version 1 and 2): lossless WebP pictures of quantised columns in a ZIP archive.

gaussforge reads and writes this format too, but damaged pictures end the process, and it compares every
Gaussian with every entry of its palette on one core: for 97,000 Gaussians of SH degree 3 it had not finished
after nine minutes.
"""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.formats.gaussians import (
    MIP,
    Gaussians,
    GaussianSource,
    check_memory,
    is_antialiased,
    triple_line,
    triple_of,
    with_largest,
    without_largest,
)
from blitzgs.formats.packed import unit_blocks
from blitzgs.formats.selection import opacity_length
from blitzgs.util.errors import located
from blitzgs.util.output import new_file

Bytes = npt.NDArray[np.uint8]

_BOOK = 256
_META_BYTES = 1 << 20
# Entries of the palette of SH coefficients: at most, and one for so many Gaussians.
# A model of fewer Gaussians than `_EXACT` has an entry for each.
_PALETTE, _SHARED, _EXACT = 65536, 16, 4096
# Rounds of clustering, on so many rows for each entry.
_ROUNDS, _SAMPLE = 8, 4
# The largest and least weight of a row of the palette's sample, from the median: logarithms.
_LOG_WEIGHT = 7.0
# Bytes of a Gaussian in each picture.
_CHANNELS = {"means_l": 3, "means_u": 3, "scales": 3, "quats": 4, "sh0": 4, "shN_labels": 2}
# Values of a table of distances.
_TABLE = 1 << 25


def write_sog(path: Path, source: GaussianSource) -> None:
    """Write an SOG file. The model is read twice, block by block; its codes are 20 bytes a Gaussian.

    ValueError: there is no Gaussian, or a value cannot be shown. OSError: the file cannot be written, or
    `path` is no regular file.
    """
    count, (least, most, scales, colors, rest, shown) = len(source), _survey(source)
    scales_book, colors_book = _codebook(scales), _codebook(colors)
    palette = _palette(rest, shown, count) if source.degree > 0 else None
    codes = {name: np.empty((count, channels), dtype=np.uint8) for name, channels in _CHANNELS.items()}
    first = 0
    for block in unit_blocks(source):
        rows, first = slice(first, first + len(block)), first + len(block)
        shares = (_logs(block) - least) / (most - least).clamp_min(1e-12)
        places = (shares * 65535).round().int().numpy()
        codes["means_l"][rows], codes["means_u"][rows] = places & 255, places >> 8
        codes["scales"][rows] = _labels(block.scales, scales_book)
        others, largest = without_largest(block.quats, 8)
        codes["quats"][rows] = torch.cat([others, 252 + largest[:, None]], dim=1).numpy()
        codes["sh0"][rows, :3] = _labels(block.sh[:, 0], colors_book)
        codes["sh0"][rows, 3] = (block.opacities.double().sigmoid() * 255).round().numpy()
        if palette is not None:
            named = palette.nearest(block.sh[:, 1:].flatten(1)).numpy()
            codes["shN_labels"][rows] = np.stack([named & 255, named >> 8], axis=1)
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "BlitzGS", "comments": _view_lines(source.comments)},
        "count": count,
        "antialias": is_antialiased(source),
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": []},
        "scales": {"codebook": scales_book.tolist(), "files": []},
        "quats": {"files": []},
        "sh0": {"codebook": colors_book.tolist(), "files": []},
    }
    width = -(-int(np.ceil(count**0.5)) // 4) * 4
    sizes = dict.fromkeys(codes, (-(-count // (4 * width)) * 4, width))
    if palette is not None:
        entries = torch.cat(palette.entries)
        book, rows_of_palette = _codebook(entries), -(-len(entries) // 64)
        codes["shN_centroids"] = _labels(entries, book).reshape(-1, 3)
        sizes["shN_centroids"] = (rows_of_palette, 64 * (entries.shape[1] // 3))
        meta["shN"] = {"count": len(entries), "bands": source.degree, "codebook": book.tolist(), "files": []}
    else:
        del codes["shN_labels"]
    with new_file(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name in sorted(codes):
            meta[name.partition("_")[0]]["files"].append(f"{name}.webp")
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), _webp(codes.pop(name), *sizes[name]))
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))


def _survey(source: GaussianSource) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the least and the largest `_logs`, and samples: scales, colours, other SH, opacity lengths."""
    reach, samples = [], []
    step = max(1, len(source) // (_SAMPLE * _PALETTE))
    for block in unit_blocks(source):
        columns = torch.cat([_logs(block), block.scales.double(), block.sh[:, 0].double()], dim=1)
        reach.append(torch.stack(columns.aminmax(dim=0)))
        some = block.rows(slice(None, None, step))
        shown = opacity_length(some.opacities, some.scales)
        samples.append(torch.cat([some.scales, some.sh.flatten(1), shown[:, None]], dim=1))
    ends, rows = torch.stack(torch.cat(reach).aminmax(dim=0)), torch.cat(samples)
    # The ends are in the samples, because codebooks span them.
    scales, colors = torch.cat([rows[:, :3], ends[:, 3:6]]), torch.cat([rows[:, 3:6], ends[:, 6:]])
    return ends[0, :3], ends[1, :3], scales, colors, rows[:, 6:-1], rows[:, -1]


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
    return torch.bucketize(values.double(), (book[1:] + book[:-1]) / 2).to(torch.uint8).numpy()


class _Palette(NamedTuple):
    """Rows that stand for others: those of each cell, [P, D], and the cells' centres, [C, D]."""

    centres: Tensor
    entries: list[Tensor]

    def nearest(self, rows: Tensor) -> Tensor:
        """Return for each row, [N, D], which of all entries is the nearest one of its cell."""
        cells, order = _nearest(rows, self.centres).sort()
        counts = torch.bincount(cells, minlength=len(self.centres)).tolist()
        found, first = torch.empty_like(order), 0
        for part, entries in zip(order.split(counts), self.entries, strict=True):
            found[part] = first + _nearest(rows[part], entries)
            first += len(entries)
        return found


def _palette(sample: Tensor, shown: Tensor, count: int) -> _Palette:
    """Return a palette for `count` rows of which there is a sample [S, D]; `shown` weighs its rows.

    With cells, a row is compared with 2 sqrt(P) others instead of P, which is a hundredth.
    """
    size = min(_PALETTE, max(_EXACT, -(-count // (64 * _SHARED)) * 64), len(sample))
    weights = (shown - shown.median()).clamp(-_LOG_WEIGHT, _LOG_WEIGHT).exp()
    # Random, without repetition, in proportion to the weights (Efraimidis and Spirakis 2006).
    draws = torch.rand(len(sample), generator=torch.Generator().manual_seed(0)).log() / weights
    order = draws.argsort(descending=True, stable=True)[: _SAMPLE * size]
    some, weights = sample[order], weights[order]
    centres = _clustered(some, weights, math.isqrt(size))
    cells, order = _nearest(some, centres).sort(stable=True)
    # Each cell has entries in proportion to its rows; one without any is left out.
    chosen = torch.linspace(0, len(some) - 1, size, dtype=torch.float64).round().long()
    used, shares = cells[chosen].unique_consecutive(return_counts=True)
    counts = torch.bincount(cells).tolist()
    parts, weights_of = some[order].split(counts), weights[order].split(counts)
    entries = [
        _clustered(parts[cell], weights_of[cell], share)
        for cell, share in zip(used.tolist(), shares.tolist(), strict=True)
    ]
    return _Palette(centres[used], entries)


def _clustered(rows: Tensor, weights: Tensor, size: int) -> Tensor:
    """Return so many weighted centres of rows in random order, by Lloyd's method from the first of them."""
    centres, weighted = rows[:size], rows * weights[:, None]
    for _ in range(_ROUNDS):
        nearest = _nearest(rows, centres)
        totals = torch.zeros(size).index_add_(0, nearest, weights)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, nearest, weighted)
        centres = torch.where(totals > 0, sums / totals, centres)
    return centres


def _nearest(rows: Tensor, centres: Tensor) -> Tensor:
    lengths = (centres**2).sum(dim=1) / 2
    parts = rows.split(max(1, _TABLE // len(centres)))
    return torch.cat([torch.addmm(lengths, part, centres.T, alpha=-1).argmin(dim=1) for part in parts])


def read_sog(path: Path) -> Gaussians:
    """Read an SOG file (a ZIP archive).

    ValueError: the file is damaged, or inflates to more than its pictures can need.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            meta, count = _checked_meta(path, archive)
            return _decoded(path, archive, meta, count)
    except _DAMAGED as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: meta.json lacks a field or has one of another kind") from error


# Numbers of the least and the largest values of a part.
_WIDTHS = {"means": 3, "scales": 3, "quats": 3, "sh0": 4, "shN": 1}
# What zipfile and OpenCV raise; OSError: of a place before the file's begin.
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, RuntimeError, cv2.error)


def _checked_meta(path: Path, archive: zipfile.ZipFile) -> tuple[dict[str, Any], int]:
    """Return meta.json and the number of Gaussians, which fits the other parts of the archive."""
    entries = {entry.filename: entry for entry in archive.infolist()}
    if "meta.json" not in entries:
        raise ValueError(f"{path}: the archive has no meta.json")
    if entries["meta.json"].file_size > _META_BYTES:
        raise ValueError(f"{path}: meta.json has {entries['meta.json'].file_size:,} bytes")
    with located(f"{path}: meta.json is no JSON"):
        meta = json.loads(archive.read("meta.json"))
    count = meta["count"] if "version" in meta else meta["means"]["shape"][0]
    if type(count) is not int or count < 1:
        raise ValueError(f"{path}: meta.json names {count!r} Gaussians")
    check_memory(f"{path} says that it holds", count, 3)
    for part in ("means", "scales", "quats", "sh0", *(["shN"] if "shN" in meta else [])):
        for name in ("codebook", "mins", "maxs"):
            if name not in meta[part]:
                continue
            numbers, size = _numbers(meta[part][name]), _BOOK if name == "codebook" else _WIDTHS[part]
            if len(numbers) != size or not np.isfinite(numbers).all():
                raise ValueError(f"{path}: the {name} of {part} is not {size} finite numbers")
        for name in meta[part]["files"]:
            if name not in entries:
                raise ValueError(f"{path}: the archive has no {name}")
            largest = max(2 * count, 16 * _PALETTE) + (1 << 16)
            if entries[name].file_size > 8 * largest:
                raise ValueError(f"{path}: {name} inflates to {entries[name].file_size:,} bytes")
            width, height = _webp_size(archive.read(name), f"{path}: {name}")
            least = 1 if "centroids" in name else count
            if not least <= width * height <= largest:
                raise ValueError(f"{path}: {name} has {width} x {height} pixels for {count:,} Gaussians")
    return meta, count


def _numbers(values: Any) -> npt.NDArray[np.float32]:
    """Return numbers of meta.json; a value that is none is not a number."""
    flat = values if isinstance(values, list) else [values]
    with np.errstate(over="ignore"):
        return np.array([v if isinstance(v, (int, float)) else np.nan for v in flat], dtype=np.float32)


def _decoded(path: Path, archive: zipfile.ZipFile, meta: dict[str, Any], count: int) -> Gaussians:
    """Return the Gaussians of an archive whose parts have been checked."""

    def picture(part: str, index: int = 0) -> Bytes:
        """Return a picture, [H, W, 4], red first."""
        name = meta[part]["files"][index]
        found = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
        if found is None or found.ndim != 3 or found.shape[2] < 3 or found.dtype != np.uint8:
            raise ValueError(f"{path}: {name} is no WebP picture of colours")
        alpha = found[..., 3] if found.shape[2] == 4 else np.full(found.shape[:2], 255, np.uint8)
        return np.dstack([found[..., 2::-1], alpha])

    def codes(part: str, index: int = 0) -> Bytes:
        """Return the bytes of each Gaussian, [N, 4]."""
        found = picture(part, index).reshape(-1, 4)[:count]
        if len(found) < count:
            raise ValueError(f"{path}: a picture of {part} has {len(found):,} pixels for {count:,} Gaussians")
        return found

    def values(part: str, of: Bytes) -> npt.NDArray[np.float32]:
        """Return the numbers that bytes stand for; version 1 has no codebooks."""
        if "codebook" in meta[part]:
            return _numbers(meta[part]["codebook"])[of]
        least, most = (_numbers(meta[part][end])[: of.shape[1]] for end in ("mins", "maxs"))
        return least + of.astype(np.float32) / 255 * (most - least)

    places = codes("means")[:, :3] + codes("means", 1)[:, :3].astype(np.uint16) * 256
    least, most = (_numbers(meta["means"][end]).astype(np.float64) for end in ("mins", "maxs"))
    logs = least + places / 65535 * (most - least)
    with np.errstate(over="ignore"):
        means = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
    turns, shades = codes("quats"), codes("sh0")
    if turns[:, 3].min() < 252:
        raise ValueError(f"{path}: a pixel of quats names no largest component")
    if "codebook" in meta["sh0"]:
        opacities = torch.from_numpy((shades[:, 3] / np.float32(255)).clip(1e-6, 1 - 1e-6)).logit()
    else:
        opacities = torch.from_numpy(values("sh0", shades)[:, 3])
    sh = values("sh0", shades[:, :3])[:, None]
    if "shN" in meta:
        entries, labels = picture("shN"), codes("shN", 1)
        named = labels[:, 0] + labels[:, 1].astype(np.int64) * 256
        size, k = 64 * len(entries), entries.shape[1] // 64
        if entries.shape[1] not in (64 * 3, 64 * 8, 64 * 15) or named.max() >= size:
            raise ValueError(f"{path}: the palette of shN has {entries.shape[1]} x {len(entries)} pixels")
        palette = values("shN", entries[..., :3].reshape(-1, 3)).reshape(size, k, 3)
        sh = np.concatenate([sh, palette[named]], axis=1)
    comments = [line for line in meta.get("asset", {}).get("comments", []) if isinstance(line, str)]
    return Gaussians(
        means=torch.from_numpy(means),
        quats=with_largest(turns[:, :3] / np.float32(255), turns[:, 3] - 252),
        scales=torch.from_numpy(values("scales", codes("scales")[:, :3])),
        opacities=opacities,
        sh=torch.from_numpy(sh),
        comments=[*([MIP] if meta.get("antialias", False) else []), *_view_lines(comments)],
    )


def _view_lines(comments: list[str]) -> list[str]:
    """Return the header lines with background and upward direction, for which the format has no field."""
    stated = {name: triple_of(comments, name) for name in ("background", "up")}
    return [triple_line(name, found) for name, found in stated.items() if found is not None]


def _webp_size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height of a WebP picture from its first chunk."""
    kind = data[12:16]
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or kind not in (b"VP8L", b"VP8X"):
        raise ValueError(f"{where} is no lossless WebP picture")
    if kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
