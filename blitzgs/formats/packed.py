# SPDX-License-Identifier: Apache-2.0
"""Compressed formats, through the packages gsply and gaussforge.

The packages trust what a file says about itself, so counts and sizes are compared with the file and with the
free memory before they see it. gsply writes, and gaussforge reads all but SPZ, because gaussforge 0.6 orders
the SH coefficients of compressed PLY files wrongly, and gsply reads files without looking at bounds.
"""

from __future__ import annotations

import gzip
import importlib
import json
import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import psutil
import torch

from blitzgs.formats.gaussians import BLOCK, MIP, Gaussians, GaussianSource, is_antialiased, unit_quats
from blitzgs.formats.ply import read_ply
from blitzgs.util.output import new_file

# Deflate compresses by at most this factor.
_DEFLATE = 1040
_SPZ_MAGIC = 0x5053474E
_SPZ_ANTIALIASED, _SPZ_HEADER = 1, 16
# An SPZ file may end with extensions.
_SPZ_EXTENSIONS = 1 << 20
_META_BYTES = 64 << 20
# Largest palette of SH coefficients, in pixels.
_PALETTE = 1 << 20
# Gaussians of a chunk of compressed PLY, and bytes of its bounds.
_CHUNK, _CHUNK_BYTES = 256, 72
_SH_C0 = 0.28209479177387814
_COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}
# Signs of the SH coefficients after half a turn about x, in the order of INRIA's basis.
_HALF_TURN = torch.tensor([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=torch.float32)


def _package(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f'this format needs the package {name} ({error}): pip install "blitzgs[formats]"'
        ) from error


def _check_room(path: Path, count: int, degree: int) -> None:
    """Refuse a number of Gaussians that memory cannot hold, twice, as the packages and torch do."""
    needed = 2 * 4 * count * (14 + 3 * _COEFFICIENTS[degree])
    free = psutil.virtual_memory().available
    if needed > free:
        raise ValueError(
            f"{path} says that it holds {count:,} Gaussians: reading them takes {needed / 1e9:,.1f} GB of "
            f"memory, and {free / 1e9:,.1f} GB are free"
        )


def unit_blocks(source: GaussianSource) -> Iterator[Gaussians]:
    """Yield all Gaussians, `BLOCK` at a time and the rest, with unit quaternions and without normals.

    Raises:
        ValueError: there is none, or a value cannot be shown.
    """
    if len(source) == 0:
        raise ValueError("the model has no Gaussian, and this format holds no empty model")
    waiting: list[Gaussians] = []
    for block in source.blocks():
        block.check()
        waiting.append(replace(block, quats=unit_quats(block.quats).float(), normals=None, levels=None))
        if sum(map(len, waiting)) >= BLOCK:
            model = _joined(waiting)
            yield model.rows(slice(0, BLOCK))
            waiting = [model.rows(slice(BLOCK, None))]
    if (model := _joined(waiting)) and len(model):
        yield model


def _joined(parts: list[Gaussians]) -> Gaussians:
    return replace(
        parts[0],
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
        scales=torch.cat([part.scales for part in parts]),
        opacities=torch.cat([part.opacities for part in parts]),
        sh=torch.cat([part.sh for part in parts]),
    )


# --- gaussforge ---


def _unforged(path: Path, kind: str) -> Gaussians:
    """Read a file as the PLY file that gaussforge makes of it; its own columns lack those of SH degree 0."""
    try:
        result = _package("gaussforge").GaussForge().convert(path.read_bytes(), kind, "ply")
        if "error" in result:
            raise ValueError(result["error"])
        with tempfile.NamedTemporaryFile(suffix=".ply") as file:
            file.write(result["data"])
            file.flush()
            found = read_ply(file.name)
    except (RuntimeError, ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return replace(found, normals=None, comments=[])


# --- gsply ---


def _gsdata(model: Gaussians) -> Any:
    rest = model.sh[:, 1:].contiguous().numpy()
    return _package("gsply").GSData.from_arrays(
        means=model.means.numpy(),
        scales=model.scales.numpy(),
        quats=model.quats.numpy(),
        opacities=model.opacities.numpy(),
        sh0=model.sh[:, 0].contiguous().numpy(),
        shN=rest if model.degree > 0 else None,
        format="ply",
    )


# --- compressed PLY: chunks of 256 Gaussians, as SuperSplat writes them ---


def write_compressed_ply(path: Path, source: GaussianSource) -> None:
    """Write a compressed PLY file block by block, with the header lines of the model."""
    count, rest = len(source), 3 * (_COEFFICIENTS[source.degree] - 1)
    chunks, first = -(-count // _CHUNK), 0
    with new_file(path) as partial, open(partial, "r+b") as file:
        for block in unit_blocks(source):
            content: bytes = _package("gsply").compress_to_bytes(_gsdata(block))
            header, _, body = content.partition(b"end_header\n")
            if first == 0:
                for element, of_all in (("chunk", chunks), ("vertex", count), ("sh", count)):
                    header = re.sub(
                        rf"element {element} \d+".encode(), f"element {element} {of_all}".encode(), header
                    )
                head, second, others = header.split(b"\n", 2)
                lines = [line.encode() for line in source.comments]
                begin = file.write(b"\n".join([head, second, *lines, others]) + b"end_header\n")
            own = -(-len(block) // _CHUNK)
            columns = [(first // _CHUNK, own, chunks, _CHUNK_BYTES), (first, len(block), count, 16)]
            _write_columns(file, begin, body, [*columns, (first, len(block), count, rest)])
            first += len(block)


def _write_columns(
    file: BinaryIO, begin: int, content: bytes, columns: Iterable[tuple[int, int, int, int]]
) -> None:
    """Write the rows of a block into the columns of a file, which follow each other from `begin` on.

    Args:
        file: the file.
        begin: where its first column begins.
        content: the rows of the block, column after column.
        columns: of each column the first row, the rows of the block and of the file, and the bytes of a row.
    """
    view, at = memoryview(content), 0
    for first, rows, count, width in columns:
        file.seek(begin + first * width)
        file.write(view[at : at + rows * width])
        at, begin = at + rows * width, begin + count * width


def read_compressed_ply(path: Path) -> Gaussians:
    """Read a compressed PLY file.

    Raises:
        ValueError: the file is damaged; names the file and the reason.
    """
    with open(path, "rb") as file:
        start = file.read(1 << 16)
    header, found, _ = start.partition(b"end_header\n")
    if not found:
        raise ValueError(f"{path}: the header of the PLY file does not end")
    text = header.decode("ascii", "replace")
    elements = {name: int(count) for name, count in re.findall(r"^element (\w+) (\d{1,18})\s*$", text, re.M)}
    count, chunks = elements.get("vertex", 0), elements.get("chunk", 0)
    rest = len(re.findall(r"^property uchar f_rest_\d+\s*$", text, re.M)) if "sh" in elements else 0
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(rest)
    if degree is None:
        raise ValueError(f"{path}: {rest} f_rest properties fit no SH degree (0, 9, 24 or 45 do)")
    columns = len(re.findall(r"^property float (?:min|max)_\w+\s*$", text, re.M))
    if columns not in (12, 18) or chunks != -(-count // 256) or elements.get("sh", count) != count:
        raise ValueError(
            f"{path}: {chunks:,} chunks of {columns} numbers and {elements.get('sh', count):,} rows of SH do "
            f"not fit {count:,} Gaussians"
        )
    size = len(header) + len(found) + chunks * columns * 4 + count * (16 + rest)
    if path.stat().st_size < size:
        raise ValueError(f"{path} is cut off: {path.stat().st_size:,} of {size:,} bytes")
    _check_room(path, count, degree)
    comments = [line for line in text.splitlines() if line.startswith(("comment ", "obj_info "))]
    return replace(_unforged(path, "compressed.ply"), comments=comments)


# --- .splat: 32 bytes a Gaussian, without header ---

_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, source: GaussianSource) -> None:
    """Write a .splat file block by block; it holds no SH coefficients beyond the DC."""
    with new_file(path) as partial, open(partial, "wb") as file:
        for block in unit_blocks(source):
            rows = np.zeros(len(block), dtype=_SPLAT)
            rows["mean"], rows["scale"] = block.means.numpy(), block.scales.exp().numpy()
            shade = torch.cat([0.5 + _SH_C0 * block.sh[:, 0], block.opacities.sigmoid()[:, None]], dim=1)
            rows["color"] = (shade.clamp(0, 1) * 255).round().numpy()
            rows["quat"] = (block.quats * 128 + 128).round().clamp(0, 255).numpy()
            file.write(rows.data)


def read_splat(path: Path) -> Gaussians:
    """Read a .splat file: positions, linear scales, RGB and opacity as bytes, quaternion (w first) as bytes.

    Raises:
        ValueError: the size fits no number of Gaussians, or a scale is not positive.
    """
    size = path.stat().st_size
    if size % _SPLAT.itemsize:
        raise ValueError(f"{path} is cut off: {size:,} bytes are no multiple of {_SPLAT.itemsize}")
    _check_room(path, size // _SPLAT.itemsize, 0)
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
        sh=torch.from_numpy((colors[:, None, :3] - 0.5) / _SH_C0).float(),
    )


# --- SPZ: fixed-point columns, deflated; y is up: half a turn about x from PLY files ---


def write_spz(path: Path, source: GaussianSource) -> None:
    """Write an SPZ file of version 3, which all its readers know.

    The model is read twice, block by block; a temporary file in the same folder holds the columns.
    """
    count, largest, middles = len(source), 1e-3, []
    for block in unit_blocks(source):
        largest = max(largest, float(block.means.abs().max()))
        middles.append(block.scales.median(dim=1).values)
    # Positions have 24 bits. The step shall be a 16th of the median Gaussian or less, if the range permits.
    middle = float(torch.cat(middles).median().clamp(-15, 15).exp())
    bits = int(np.clip(np.ceil(np.log2(16 / middle)), 12, 24))
    bits = max(1, min(bits, int(np.floor(np.log2((2**23 - 1) / largest)))))
    widths, first = (9, 1, 3, 3, 4, 3 * (_COEFFICIENTS[source.degree] - 1)), 0
    with new_file(path) as partial, tempfile.TemporaryFile(dir=path.parent) as file:
        for block in unit_blocks(source):
            _package("gsply").write_spz(partial, _gsdata(_half_turn(block)), fractional_bits=bits)
            content = zlib.decompress(partial.read_bytes(), wbits=31)
            if first == 0:
                flags = content[14] | (_SPZ_ANTIALIASED if is_antialiased(source) else 0)
                file.write(content[:8] + struct.pack("<I", count) + content[12:14] + bytes([flags, 0]))
            columns = ((first, len(block), count, width) for width in widths)
            _write_columns(file, _SPZ_HEADER, content[_SPZ_HEADER:], columns)
            first += len(block)
        file.seek(0)
        with open(partial, "wb") as target, gzip.GzipFile("", "wb", 6, target, mtime=0) as packed:
            shutil.copyfileobj(file, packed, 1 << 20)


def read_spz(path: Path) -> Gaussians:
    """Read an SPZ file of version 1 to 4.

    Raises:
        ValueError: the file is damaged; names the file and the reason.
    """
    with open(path, "rb") as file:
        start = file.read(32)
    deflated = not start.startswith(b"NGSP")
    if deflated:
        start = _inflated(path, 16, None)
    if len(start) < 16:
        raise ValueError(f"{path} is cut off: it has no whole header")
    magic, version, count, degree, _, flags = struct.unpack_from("<IIIBBB", start)
    if magic != _SPZ_MAGIC or version not in (1, 2, 3, 4):
        raise ValueError(f"{path} is no SPZ file of version 1 to 4")
    if degree not in _COEFFICIENTS:
        raise ValueError(f"{path}: SH degree {degree} is not supported, 0 to 3 are")
    size = 16 + count * (16 + (4 if version >= 3 else 3) + 3 * (_COEFFICIENTS[degree] - 1))
    _check_room(path, count, degree)
    if deflated:
        if size > _DEFLATE * path.stat().st_size:
            raise ValueError(f"{path}: {path.stat().st_size:,} bytes cannot hold {count:,} Gaussians")
        _inflated(path, size, _SPZ_EXTENSIONS)
    try:
        found = _package("gsply").read_spz(path)
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


def _inflated(path: Path, size: int, more: int | None) -> bytes:
    """Return the first bytes of a deflated file; with `more`, check that it has `size` and so many more."""
    inflate, start, total = zlib.decompressobj(31), b"", 0
    try:
        with open(path, "rb") as file:
            while not inflate.eof and (data := inflate.unconsumed_tail or file.read(1 << 20)):
                part = inflate.decompress(data, 1 << 20)
                start, total = start + part[: 16 - len(start)], total + len(part)
                if more is None and len(start) == 16:
                    return start
                if more is not None and total > size + more:
                    raise ValueError(
                        f"{path} is damaged: it inflates to more than the {size:,} bytes it names"
                    )
    except zlib.error as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if more is not None and (total < size or not inflate.eof):
        raise ValueError(f"{path} is cut off: {total:,} of {size:,} bytes")
    return start


def _half_turn(model: Gaussians) -> Gaussians:
    """Return Gaussians after half a turn about x: (x, y, z) -> (x, -y, -z)."""
    signs = torch.tensor([1.0, 1.0, -1.0, -1.0])
    sh = model.sh * _HALF_TURN[: model.sh.shape[1], None]
    return replace(model, means=model.means * signs[1:], quats=model.quats * signs, sh=sh)


# --- SOG: WebP pictures of quantised columns in a ZIP archive ---


def read_sog(path: Path) -> Gaussians:
    """Read an SOG file (a ZIP archive).

    Raises:
        ValueError: the file is damaged, or inflates to more than its pictures can need.
    """
    try:
        antialiased = _check_sog(path)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except (LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: meta.json lacks a field or has one of another kind") from error
    return replace(_unforged(path, "sog"), comments=[MIP] if antialiased else [])


def _check_sog(path: Path) -> bool:
    """Compare the parts of an SOG file with its count; return whether the model is antialiased."""
    with zipfile.ZipFile(path) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
        if "meta.json" not in entries:
            raise ValueError(f"{path}: the archive has no meta.json")
        if entries["meta.json"].file_size > _META_BYTES:
            raise ValueError(f"{path}: meta.json has {entries['meta.json'].file_size:,} bytes")
        try:
            meta = json.loads(archive.read("meta.json"))
        except ValueError as error:
            raise ValueError(f"{path}: meta.json is no JSON: {error}") from error
        count = meta["count"] if "version" in meta else meta["means"]["shape"][0]
        if type(count) is not int or count < 1:
            raise ValueError(f"{path}: meta.json names {count!r} Gaussians")
        _check_room(path, count, 3)
        for part in ("means", "scales", "quats", "sh0", "shN"):
            if part not in meta and part == "shN":
                continue
            for book in [meta[part]["codebook"]] if "codebook" in meta[part] else []:
                if len(book) != 256 or not np.isfinite(np.array(book, dtype=np.float64)).all():
                    raise ValueError(f"{path}: the codebook of {part} is not 256 finite numbers")
            for name in meta[part]["files"]:
                if name not in entries:
                    raise ValueError(f"{path}: the archive has no {name}")
                largest = max(2 * count, _PALETTE) + (1 << 16)
                if entries[name].file_size > 8 * largest:
                    raise ValueError(f"{path}: {name} inflates to {entries[name].file_size:,} bytes")
                width, height = _webp_size(archive.read(name), f"{path}: {name}")
                least = 1 if "centroids" in name else count
                if not least <= width * height <= largest:
                    raise ValueError(f"{path}: {name} has {width} x {height} pixels for {count:,} Gaussians")
        return bool(meta.get("antialias", False))


def _webp_size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height of a WebP picture from its first chunk."""
    head: npt.NDArray[np.uint8] = np.frombuffer(data[:30].ljust(30, b"\0"), np.uint8)
    kind = data[12:16]
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or kind not in (b"VP8L", b"VP8X"):
        raise ValueError(f"{where} is no lossless WebP picture")
    if kind == b"VP8L":
        bits = int.from_bytes(head[21:25].tobytes(), "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return tuple(int.from_bytes(head[i : i + 3].tobytes(), "little") + 1 for i in (24, 27))  # type: ignore[return-value]
