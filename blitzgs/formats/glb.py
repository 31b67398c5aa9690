# SPDX-License-Identifier: Apache-2.0
"""Binary glTF 2.0 with the ratified extension KHR_gaussian_splatting.

One primitive of points: POSITION, KHR_gaussian_splatting:ROTATION (unit quaternion x, y, z, w), SCALE
(linear), OPACITY (after the sigmoid), SH_DEGREE_d_COEF_n (RGB), and COLOR_0 for viewers that know only
points. Colours are display-referred sRGB. glTF's +Y is up, so the node has the rotation that turns the
model's up there; the coordinates themselves stay unchanged. What the format has no field for is in
`asset.extras`: the header lines of the PLY file of the same model (antialiasing, background, offset,
levels). Octree levels are the attribute _LEVEL.

The columns follow each other, so that each is contiguous; a block of Gaussians is written into all of them.
With KHR_gaussian_splatting_compression_spz_2, an SPZ file stands for the columns.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import SH_C0, Gaussians, GaussianSource, unit_quats, up_of
from blitzgs.formats.packed import Lost, SpzGrid, write_spz
from blitzgs.formats.partition import around
from blitzgs.util.output import check_replaceable, new_file
from blitzgs.util.rotations import quaternions

EXTENSION, SPZ_EXTENSION = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"
_PREFIX = f"{EXTENSION}:"
_FLOAT, _BYTE = 5126, 5121
# A chunk's length has 32 bits.
_LARGEST = (1 << 32) - 1
# Up in the PLY files of most trainers, whose world is that of the first camera.
COLMAP_UP = (0.0, -1.0, 0.0)

Array = npt.NDArray[np.generic]


@dataclass(frozen=True)
class _Column:
    name: str
    type: str  # of the accessor
    component: int
    offset: int  # in the binary chunk
    width: int  # bytes of a Gaussian


def write_glb(path: Path, source: GaussianSource, up: tuple[float, float, float] | None = None) -> None:
    """Write Gaussians as a GLB file; it appears under its name only when it is complete.

    Args:
        path: file to write, in a folder that exists. Only an empty file or a GLB is replaced.
        source: at least one Gaussian; read once, block by block.
        up: upward direction in the coordinates of the Gaussians; None: the header's, else COLMAP's.

    Raises:
        ValueError: there is no Gaussian, a value is not finite, or the file would exceed 4 GiB.
        FileExistsError: there is a file of another format.
        OSError: the file cannot be written, or `path` is no regular file; an existing file is unchanged.
    """
    check_replaceable(path, (b"glTF",), " and is not a GLB file")
    up = up or up_of(source.comments) or COLMAP_UP
    count, columns = len(source), _columns(len(source), source.degree, source.has_levels)
    size = columns[-1].offset + columns[-1].width * count
    if count == 0:
        raise ValueError(f"{path}: the model has no Gaussian, and glTF has no empty primitives")
    if size > _LARGEST - (1 << 20):
        raise ValueError(
            f"{path}: {count:,} Gaussians of SH degree {source.degree} take {size / 2**30:.1f} GiB, and a "
            "GLB file holds 4: choose a lower --sh-degree, --most, or tiles"
        )
    box = np.array([[-3.4e38] * 3, [3.4e38] * 3])
    # Numbers of a box have at most so many more characters than the two above.
    room = len(_json(source, columns, size, box, up)) + 200
    room += -room % 4
    box = np.array([[np.inf] * 3, [-np.inf] * 3])
    with new_file(path) as partial, open(partial, "r+b") as file:
        start, body = 0, 28 + room
        for block in source.blocks():
            block.check()
            box = around([box, torch.stack(block.means.aminmax(dim=0)).double().numpy()])
            for column, values in zip(columns, _values(block).values(), strict=True):
                file.seek(body + column.offset + column.width * start)
                file.write(np.ascontiguousarray(values).data)
            start += len(block)
        if start != count:
            raise ValueError(f"{path}: {count:,} Gaussians were announced, {start:,} came")
        file.seek(0)
        file.write(_head(_json(source, columns, size, box, up).ljust(room), size))


def write_spz_glb(path: Path, model: Gaussians, grid: SpzGrid) -> Lost:
    """Write Gaussians whose up is +Z as a GLB with an SPZ file inside, as CesiumJS 1.144 reads it.

    It reads no rotation of the node, only a matrix, and stops at accessors of opacities and of SH degree 0,
    which SPZ's decoder gives as COLOR_0. `grid` has room for all positions. ImportError: gsply is missing.
    ValueError, OSError: as `write_glb`.
    """
    model.check()
    lost = write_spz(packed := path.with_suffix(".spz"), model, grid)
    data = packed.read_bytes()
    packed.unlink()
    means = model.means.double().numpy() * [1.0, -1.0, -1.0]
    box = np.stack([means.min(axis=0), means.max(axis=0)])
    implied = (f"{_PREFIX}OPACITY", f"{_PREFIX}SH_DEGREE_0_COEF_0")
    columns = [column for column in _columns(len(model), model.degree, False) if column.name not in implied]
    text = _json(model, columns, len(data), box, None)
    text, data = text.ljust(-(-len(text) // 4) * 4), data.ljust(-(-len(data) // 4) * 4, b"\0")
    with new_file(path) as partial:
        partial.write_bytes(_head(text, len(data)) + data)
    return lost


def _head(text: bytes, size: int) -> bytes:
    """Return what a GLB file has before its binary chunk of so many bytes; `text` is the JSON."""
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + size, len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", size, 0x004E4942)


def _columns(count: int, degree: int, has_levels: bool) -> list[_Column]:
    none, k = torch.empty(0), (degree + 1) ** 2
    empty = Gaussians(
        none.view(0, 3), none.view(0, 4), none.view(0, 3), none, torch.empty(0, k, 3),
        levels=none if has_levels else None,
    )  # fmt: skip
    columns, offset = [], 0
    for name, values in _values(empty).items():
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        component = _BYTE if values.dtype == np.uint8 else _FLOAT
        columns.append(_Column(name, kind, component, offset, values.itemsize * values.shape[1]))
        offset += columns[-1].width * count
    return columns


def _values(block: Gaussians) -> dict[str, Array]:
    """Return the columns of a block in the order of the file, float32 or uint8 [N, C]."""
    opacities = block.opacities[:, None].double().sigmoid().numpy()
    colors = np.concatenate([0.5 + SH_C0 * block.sh[:, 0].numpy(), opacities], axis=1)
    columns: dict[str, Array] = {
        "POSITION": block.means.numpy(),
        f"{_PREFIX}ROTATION": unit_quats(block.quats)[:, [1, 2, 3, 0]].float().numpy(),
        f"{_PREFIX}SCALE": block.scales.exp().numpy(),
        f"{_PREFIX}OPACITY": opacities.astype(np.float32),
        "COLOR_0": np.rint(colors.clip(0, 1) * 255).astype(np.uint8),
    }
    for d in range(block.degree + 1):
        for n in range(2 * d + 1):
            columns[f"{_PREFIX}SH_DEGREE_{d}_COEF_{n}"] = block.sh[:, d * d + n].numpy()
    if block.levels is not None:
        columns["_LEVEL"] = block.levels[:, None].float().numpy()
    return columns


def _json(
    source: GaussianSource,
    columns: list[_Column],
    size: int,
    box: npt.NDArray[np.float64],
    up: tuple[float, float, float] | None,
) -> bytes:
    """Return the JSON of a GLB; without `up`, of one whose only buffer view, of `size` bytes, is SPZ."""
    count = len(source)
    accessors: list[dict[str, Any]] = [
        {"componentType": column.component, "count": count, "type": column.type} for column in columns
    ]
    accessors[0] |= {"min": box[0].tolist(), "max": box[1].tolist()}
    for column, accessor in zip(columns, accessors, strict=True):
        if column.component == _BYTE:
            accessor["normalized"] = True
    extension: dict[str, Any] = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": 0,
        "attributes": {column.name: i for i, column in enumerate(columns)},
        "extensions": {EXTENSION: extension},
    }
    comments = [line.encode("utf-8", "replace").decode() for line in source.comments]  # JSON is UTF-8
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "BlitzGS", "extras": {"comments": comments}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "buffers": [{"byteLength": -(-size // 4) * 4}],
    }
    if up is None:
        extension["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
        content["extensionsUsed"] = content["extensionsRequired"] = [EXTENSION, SPZ_EXTENSION]
        content["bufferViews"] = [{"buffer": 0, "byteOffset": 0, "byteLength": size}]
        # SPZ's half turn back, then +Z to +Y; column by column.
        matrix = [1.0, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1]
        content["nodes"] = [{"mesh": 0, "matrix": matrix}]
    else:
        for view, accessor in enumerate(accessors):
            accessor["bufferView"] = view
        content["bufferViews"] = [
            {"buffer": 0, "byteOffset": c.offset, "byteLength": c.width * count, "target": 34962}
            for c in columns
        ]
        w, x, y, z = quaternions(torch.from_numpy(shortest_turn(up, 1))[None])[0].tolist()
        content["nodes"] = [{"mesh": 0, "rotation": [x, y, z, w]}]
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def shortest_turn(direction: tuple[float, float, float], axis: int) -> npt.NDArray[np.float64]:
    """Return the shortest rotation [3, 3] from a direction to an axis of the coordinates, +X, +Y or +Z."""
    unit, target = np.array(direction, np.float64) / np.linalg.norm(direction), np.eye(3)[axis]
    if unit[axis] < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.outer(target, unit) - np.outer(unit, target)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + unit[axis]))
