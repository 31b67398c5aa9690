# SPDX-License-Identifier: Apache-2.0
"""Compressed formats: compressed PLY, .splat and SPZ, some of it through the package gsply.

The package trusts what a file says about itself, so counts and sizes are compared with the file and with the
free memory before it sees it. It writes, and reads SPZ.
"""

from __future__ import annotations

import gzip
import math
import os
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import (
    BLOCK,
    MIP,
    SH_C0,
    Gaussians,
    GaussianSource,
    check_memory,
    degree_of,
    is_antialiased,
    joined,
    unit_quats,
    with_largest,
)
from blitzgs.util.errors import optional_package
from blitzgs.util.output import new_file

# Deflate compresses by at most this factor.
_DEFLATE = 1040
_SPZ_MAGIC = 0x5053474E
_SPZ_ANTIALIASED, _SPZ_HEADER = 1, 16
# An SPZ file may end with extensions.
_SPZ_EXTENSIONS = 1 << 20
# Gaussians of a chunk of compressed PLY, and bytes of its bounds.
_CHUNK, _CHUNK_BYTES = 256, 72
_BOUNDS, _WORDS = ("x y z", "scale_x scale_y scale_z", "r g b"), ("position", "rotation", "scale", "color")
# Signs of the SH coefficients after half a turn about x, in the order of INRIA's basis.
_HALF_TURN = torch.tensor([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=torch.float32)

Floats = npt.NDArray[np.float32]


class Lost(NamedTuple):
    """Numbers of Gaussians that a writer did not keep as they are."""

    cut: int = 0  # beyond the ranges of the format, and cut to them
    left_out: int = 0  # so far away that the positions of the others would be rounded


def _gsply() -> Any:
    return optional_package("gsply", "formats", "this format")


def _rest(degree: int) -> int:
    """Return the number of SH coefficients of a Gaussian beyond its DC."""
    return 3 * ((degree + 1) ** 2 - 1)


def unit_blocks(source: GaussianSource) -> Iterator[Gaussians]:
    """Yield all Gaussians, `BLOCK` at a time and the rest, with unit quaternions and without normals.

    ValueError: there is none, or a value cannot be shown.
    """
    if len(source) == 0:
        raise ValueError("the model has no Gaussian, and this format holds no empty model")
    waiting: list[Gaussians] = []
    for block in source.blocks():
        block.check()
        # A scale of 0 has no logarithm that a codebook could hold.
        quats, scales = unit_quats(block.quats).float(), block.scales.clamp(min=-30)
        waiting.append(replace(block, quats=quats, scales=scales, normals=None, levels=None))
        if sum(map(len, waiting)) >= BLOCK:
            model = joined(waiting)
            yield model.rows(slice(0, BLOCK))
            waiting = [model.rows(slice(BLOCK, None))]
    if (model := joined(waiting)) and len(model):
        yield model


# --- gsply ---


def _gsdata(model: Gaussians) -> Any:
    rest = model.sh[:, 1:].contiguous().numpy()
    return _gsply().GSData.from_arrays(
        means=model.means.numpy(),
        scales=model.scales.numpy(),
        quats=model.quats.numpy(),
        opacities=model.opacities.numpy(),
        sh0=model.sh[:, 0].contiguous().numpy(),
        shN=rest if model.degree > 0 else None,
        format="ply",
    )


# --- compressed PLY: chunks of 256 Gaussians, as SuperSplat writes them ---


def _layout(count: int, groups: int, degree: int) -> list[str]:
    """Return the lines of a header but its comments; `groups`: of bounds that a chunk has, 2 or 3."""
    bounds = [
        f"{end}_{name}" for group in _BOUNDS[:groups] for end in ("min", "max") for name in group.split()
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-count // _CHUNK)}"]
    lines += [f"property float {name}" for name in bounds]
    lines += [f"element vertex {count}", *(f"property uint packed_{name}" for name in _WORDS)]
    if degree > 0:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(_rest(degree)))]
    return lines


def write_compressed_ply(path: Path, source: GaussianSource) -> None:
    """Write a compressed PLY file block by block, with the header lines of the model."""
    count, rest, first = len(source), _rest(source.degree), 0
    chunks, lines = -(-count // _CHUNK), _layout(count, len(_BOUNDS), source.degree)
    with new_file(path) as partial, open(partial, "r+b") as file:
        begin = file.write(os.fsencode("\n".join([*lines[:2], *source.comments, *lines[2:], "end_header\n"])))
        for block in unit_blocks(source):
            content: bytes = _gsply().compress_to_bytes(_gsdata(block))
            own = (first // _CHUNK, -(-len(block) // _CHUNK), chunks, _CHUNK_BYTES)
            columns = [own, (first, len(block), count, 16), (first, len(block), count, rest)]
            _write_columns(file, begin, content.partition(b"end_header\n")[2], columns)
            first += len(block)


def _write_columns(
    file: BinaryIO, begin: int, content: bytes, columns: Iterable[tuple[int, int, int, int]]
) -> None:
    """Write the rows of a block into the columns of a file, which follow each other from `begin` on.

    `begin`: where its first column begins. `content`: the rows of the block, column after column. `columns`:
    of each column the first row, the rows of the block and of the file, and the bytes of a row.
    """
    view, at = memoryview(content), 0
    for first, rows, count, width in columns:
        file.seek(begin + first * width)
        file.write(view[at : at + rows * width])
        at, begin = at + rows * width, begin + count * width


def read_compressed_ply(path: Path) -> Gaussians:
    """Read a compressed PLY file in the layout of SuperSplat.

    ValueError: the file is damaged; names the file and the reason.
    """
    with open(path, "rb") as file:
        start = file.read(1 << 16)
    header, found, _ = start.partition(b"end_header\n")
    if not found:
        raise ValueError(f"{path}: the header of the PLY file does not end")
    lines = os.fsdecode(header.replace(b"\r", b"")).split("\n")[:-1]
    comments = [line for line in lines if line.startswith(("comment ", "obj_info "))]
    layout = [line.strip() for line in lines if line not in comments]
    elements = {
        name: int(count) for name, count in re.findall(r"^element (\w+) (\d{1,18})$", "\n".join(layout), re.M)
    }
    count, chunks = elements.get("vertex", 0), elements.get("chunk", 0)
    rest = sum(line.startswith("property uchar f_rest_") for line in layout)
    degree = degree_of(rest, path)
    columns = sum(line.startswith(("property float min_", "property float max_")) for line in layout)
    if columns not in (12, 18) or chunks != -(-count // _CHUNK) or elements.get("sh", count) != count:
        raise ValueError(
            f"{path}: {chunks:,} chunks of {columns} numbers and {elements.get('sh', count):,} rows of SH do "
            f"not fit {count:,} Gaussians"
        )
    if layout != _layout(count, columns // 6, degree):
        raise ValueError(f"{path}: the header is not that of a compressed PLY file, whose order is fixed")
    begin = len(header) + len(found)
    size = begin + chunks * columns * 4 + count * (16 + rest)
    if path.stat().st_size < size:
        raise ValueError(f"{path} is cut off: {path.stat().st_size:,} of {size:,} bytes")
    check_memory(f"{path} says that it holds", count, degree)
    bounds = np.fromfile(path, "<f4", chunks * columns, offset=begin).reshape(chunks, -1, 2, 3)
    words = np.fromfile(path, "<u4", 4 * count, offset=begin + bounds.nbytes).reshape(count, 4)
    codes = np.fromfile(path, "u1", rest * count, offset=begin + bounds.nbytes + words.nbytes)
    model = Gaussians(
        means=torch.empty(count, 3),
        quats=torch.empty(count, 4),
        scales=torch.empty(count, 3),
        opacities=torch.empty(count),
        sh=torch.empty(count, (degree + 1) ** 2, 3),
        comments=comments,
    )
    for first in range(0, count, BLOCK):
        rows = slice(first, min(first + BLOCK, count))
        _unpack(model.rows(rows), bounds[first // _CHUNK :], words[rows], codes.reshape(count, -1)[rows])
    return model


@np.errstate(invalid="ignore", over="ignore")  # `Gaussians.check` refuses what cannot be shown
def _unpack(
    to: Gaussians, bounds: Floats, words: npt.NDArray[np.uint32], codes: npt.NDArray[np.uint8]
) -> None:
    """Write the values of a block of a compressed PLY file into views of its N Gaussians.

    `bounds`: least and largest x y z, scales and perhaps colours of its chunks, [C, 2 or 3, 2, 3]. `words`:
    packed position, rotation, scale and colour, [N, 4]. `codes`: f_rest, [N, 3 (K - 1)].
    """
    chunks = np.arange(len(words)) // _CHUNK

    def shares(column: int, *bits: int) -> Floats:
        """Split a word into numbers of so many bits, the highest first, as shares of their largest values."""
        shifts = np.cumsum((0, *bits[:0:-1]), dtype=np.uint32)[::-1]
        most = np.array([(1 << n) - 1 for n in bits], np.uint32)
        return np.asarray((words[:, column, None] >> shifts & most) / most, np.float32)

    def between(group: int, found: Floats) -> Floats:
        least, most = bounds[chunks, group].transpose(1, 0, 2)
        return least + found * (most - least)

    colors = shares(3, 8, 8, 8, 8)
    tints = between(2, colors[:, :3]) if bounds.shape[1] > 2 else colors[:, :3]
    to.means[:] = torch.from_numpy(between(0, shares(0, 11, 10, 11)))
    to.scales[:] = torch.from_numpy(between(1, shares(2, 11, 10, 11)))
    to.opacities[:] = torch.from_numpy(colors[:, 3].clip(1e-6, 1 - 1e-6)).logit()
    to.sh[:, 0] = torch.from_numpy((tints - 0.5) / SH_C0)
    steps = (codes + np.float32(0.5)) / 256
    steps[codes == 0], steps[codes == 255] = 0, 1
    to.sh[:, 1:] = torch.from_numpy(steps * 8 - 4).reshape(len(words), 3, -1).transpose(1, 2)
    to.quats[:] = with_largest(shares(1, 2, 10, 10, 10)[:, 1:], words[:, 1] >> 30)


# --- .splat: 32 bytes a Gaussian, without header ---

_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, source: GaussianSource) -> Lost:
    """Write a .splat file block by block; it holds no SH coefficients beyond the DC."""
    cut = 0
    with new_file(path) as partial, open(partial, "wb") as file:
        for block in unit_blocks(source):
            rows = np.zeros(len(block), dtype=_SPLAT)
            rows["mean"], rows["scale"] = block.means.numpy(), block.scales.exp().numpy()
            shade = torch.cat([0.5 + SH_C0 * block.sh[:, 0], block.opacities.sigmoid()[:, None]], dim=1)
            # Viewers show a negative colour as black, but one above white brightens what lies before it.
            cut += int((shade > 1 + 0.5 / 255).any(dim=1).sum())
            rows["color"] = (shade.clamp(0, 1) * 255).round().numpy()
            rows["quat"] = (block.quats * 128 + 128).round().clamp(0, 255).numpy()
            file.write(rows.data)
    return Lost(cut)


def read_splat(path: Path) -> Gaussians:
    """Read a .splat file: positions, linear scales, RGB and opacity as bytes, quaternion (w first) as bytes.

    ValueError: the size fits no number of Gaussians, or a scale is not positive.
    """
    size = path.stat().st_size
    if size % _SPLAT.itemsize:
        raise ValueError(f"{path} is cut off: {size:,} bytes are no multiple of {_SPLAT.itemsize}")
    check_memory(f"{path} says that it holds", size // _SPLAT.itemsize, 0)
    rows = np.fromfile(path, dtype=_SPLAT)
    if not (rows["scale"] >= 0).all():
        first = int(np.argmin((rows["scale"] >= 0).all(axis=1)))
        raise ValueError(f"{path}: Gaussian {first} has the scale {rows['scale'][first]}")
    colors = rows["color"].astype(np.float64) / 255
    with np.errstate(divide="ignore"):
        scales = np.log(rows["scale"])
    # The opacities 0 and 1 have no logit.
    opacities = np.clip(colors[:, 3], 1e-4, 1 - 1e-4)
    return Gaussians(
        means=torch.from_numpy(rows["mean"].copy()),
        quats=torch.from_numpy((rows["quat"].astype(np.float32) - 128) / 128),
        scales=torch.from_numpy(np.maximum(scales, -30)),
        opacities=torch.from_numpy(np.log(opacities / (1 - opacities))).float(),
        sh=torch.from_numpy((colors[:, None, :3] - 0.5) / SH_C0).float(),
    )


# --- SPZ: fixed-point columns, deflated; y is up: half a turn about x from PLY files ---


class SpzGrid(NamedTuple):
    """The positions that an SPZ file can say: 24 bits and a sign, of which some are a fraction."""

    bits: int  # of the fraction
    held: int  # number of Gaussians whose positions have room

    @classmethod
    def of(cls, source: GaussianSource) -> SpzGrid:
        """Choose the fraction for a model (ValueError: as `unit_blocks`, or no position has room)."""
        middles, exponents = [], torch.zeros(_EXPONENTS, dtype=torch.int64)
        for block in unit_blocks(source):
            exponents += torch.bincount(_exponents(block), minlength=_EXPONENTS)
            middles.append(block.scales.median(dim=1).values)
        count, counts = len(source), exponents.cumsum(dim=0)
        if not counts[22]:
            raise ValueError(f"SPZ holds coordinates up to {1 << 22:,}, and those of the model are larger")
        holds_all = 23 - int((counts < count).sum())
        # A range of eight times where 99 % are, or all but one.
        holds_most = 20 - int((counts < max(0.9 * count, min(0.99 * count, count - 1))).sum())
        # The step shall be a 16th of the median Gaussian, if the range permits; far Gaussians may not make it
        # larger than a quarter, from where on the picture shows it.
        middle = float(torch.cat(middles).median().clamp(-15, 15).exp())
        fine, coarse = (math.ceil(math.log2(parts / middle)) for parts in (16, 4))
        bits = max(1, min(max(fine, 12), holds_all), min(coarse, holds_most))
        return cls(bits, int(counts[23 - bits]))

    def holds(self, model: Gaussians) -> torch.Tensor:
        """Tell which positions have room, bool [N]."""
        return _exponents(model) <= 23 - self.bits


# Coordinates below 1 count as 1, and float32 ends at 2^128.
_EXPONENTS = 129


def _exponents(model: Gaussians) -> torch.Tensor:
    """Return the least e for which all coordinates are below 2^e, int64 [N]."""
    return torch.frexp(model.means.abs().amax(dim=1)).exponent.clamp(min=0).long()


def write_spz(path: Path, source: GaussianSource, grid: SpzGrid | None = None) -> Lost:
    """Write an SPZ file of version 3; readers from before the end of 2025 may know 2 alone.

    The model is read twice, block by block, once if the grid is given; a temporary file in the same folder
    holds the columns. Gaussians too far away for the grid are left out.
    """
    if grid is None:
        grid = SpzGrid.of(source)
        if grid.held < 0.9 * len(source):
            raise ValueError(f"SPZ holds coordinates up to {1 << 22:,}, and many of the model are larger")
    count, widths, first, cut = grid.held, (9, 1, 3, 3, 4, _rest(source.degree)), 0, 0
    with new_file(path) as partial, tempfile.TemporaryFile(dir=path.parent) as file:
        for every in unit_blocks(source):
            block = every.rows(grid.holds(every))
            cut += int(_cut_by_spz(block).sum())
            _gsply().write_spz(partial, _gsdata(_half_turn(block)), fractional_bits=grid.bits)
            content = gzip.decompress(partial.read_bytes())
            if first == 0:
                flags = content[14] | (_SPZ_ANTIALIASED if is_antialiased(source) else 0)
                file.write(content[:8] + struct.pack("<I", count) + content[12:14] + bytes([flags, 0]))
            columns = ((first, len(block), count, width) for width in widths)
            _write_columns(file, _SPZ_HEADER, content[_SPZ_HEADER:], columns)
            first += len(block)
        file.seek(0)
        with open(partial, "wb") as target, gzip.GzipFile("", "wb", 6, target, mtime=0) as packed:
            shutil.copyfileobj(file, packed, 1 << 20)
    return Lost(cut, len(source) - count)


def _cut_by_spz(model: Gaussians) -> torch.Tensor:
    """Tell which Gaussians have scales, colours or SH coefficients that SPZ's bytes cannot say, bool [N]."""
    longest, bright = model.scales.amax(dim=1), (model.sh[:, 0] > 0.5 / 0.15).any(dim=1)
    shiny = (model.sh[:, 1:].abs() > 1).flatten(1).any(dim=1)
    return (longest > 255.5 / 16 - 10) | (longest < -0.5 / 16 - 10) | bright | shiny


def read_spz(path: Path) -> Gaussians:
    """Read an SPZ file of version 1 to 4 (ValueError: the file is damaged; names the file and the reason)."""
    with open(path, "rb") as file:
        start = file.read(32)
    deflated = not start.startswith(b"NGSP")
    if deflated:
        start, _ = _inflated(path, 0)
    if len(start) < 16:
        raise ValueError(f"{path} is cut off: it has no whole header")
    magic, version, count, degree, _, flags = struct.unpack_from("<IIIBBB", start)
    if magic != _SPZ_MAGIC or version not in (1, 2, 3, 4):
        raise ValueError(f"{path} is no SPZ file of version 1 to 4")
    if degree > 3:
        raise ValueError(f"{path}: SH degree {degree} is not supported, 0 to 3 are")
    size = 16 + count * (16 + (4 if version >= 3 else 3) + _rest(degree))
    check_memory(f"{path} says that it holds", count, degree)
    if deflated:
        if size > _DEFLATE * path.stat().st_size:
            raise ValueError(f"{path}: {path.stat().st_size:,} bytes cannot hold {count:,} Gaussians")
        _, total = _inflated(path, size + _SPZ_EXTENSIONS)
        if total > size + _SPZ_EXTENSIONS:
            raise ValueError(f"{path} is damaged: it inflates to more than the {size:,} bytes it names")
        if total < size:
            raise ValueError(f"{path} is cut off: {total:,} of {size:,} bytes")
    try:
        found = _gsply().read_spz(path)
    except Exception as error:  # the package raises what its parts raise
        if isinstance(error, (ImportError, MemoryError)):
            raise
        raise ValueError(f"{path} is damaged: {error}") from error
    sh = torch.from_numpy(found.sh0)[:, None]
    if degree > 0:
        sh = torch.cat([sh, torch.from_numpy(found.shN)], dim=1)
    return _half_turn(
        Gaussians(
            means=torch.from_numpy(found.means),
            quats=torch.from_numpy(found.quats),
            scales=torch.from_numpy(found.scales),
            opacities=torch.from_numpy(found.opacities).reshape(-1),
            sh=sh,
            comments=[MIP] if flags & _SPZ_ANTIALIASED else [],
        )
    )


def _inflated(path: Path, most: int) -> tuple[bytes, int]:
    """Return the first 16 bytes of a deflated file, and its length, counted until it is above `most`."""
    start, total = b"", 0
    try:
        with gzip.open(path) as file:
            while total <= most and (part := file.read(1 << 20)):
                start, total = start or part[:16], total + len(part)
    except EOFError as error:
        raise ValueError(f"{path} is cut off: {error}") from error
    except (gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return start, total


def _half_turn(model: Gaussians) -> Gaussians:
    """Return Gaussians after half a turn about x: (x, y, z) -> (x, -y, -z)."""
    signs = torch.tensor([1.0, 1.0, -1.0, -1.0])
    sh = model.sh * _HALF_TURN[: model.sh.shape[1], None]
    return replace(model, means=model.means * signs[1:], quats=model.quats * signs, sh=sh)
