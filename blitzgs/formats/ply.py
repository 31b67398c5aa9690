# SPDX-License-Identifier: Apache-2.0
"""PLY files: Gaussians in the INRIA layout, and coloured points.

The INRIA layout is binary little endian, every property a float32 in this order: x y z nx ny nz f_dc_0..2
f_rest_0.. opacity scale_0..2 rot_0..3. f_rest is channel-major: all coefficients of red, then green, then
blue. Values are pre-activation (log scales, logit opacities, unnormalised quaternions w x y z). A model whose
views leave out Gaussians by their octree levels has one further property, `level`, at the end. Reading a file
of this layout and writing it again gives the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.formats import native
from blitzgs.formats.gaussians import BLOCK, SH_C0, Gaussians, GaussianSource, degree_of
from blitzgs.util.errors import warn
from blitzgs.util.output import check_replaceable, new_file

LEVEL = "level"
# Positions may be rounded by this share of the median Gaussian's middle axis.
MAX_ROUNDING = 0.01
# The positions of points may be rounded by this share of the cloud's longest side.
_LARGEST_STEP = 1e-4


def _property_names(coefficients: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (coefficients - 1))]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    return [*names, "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def _read_table(
    path: Path, first: int = 0, most: int = 2**64 - 1
) -> tuple[list[str], npt.NDArray[np.void], int]:
    """Return the header lines, up to `most` rows from number `first` on, and the number of all rows."""
    comments, properties, count, rows, total = native.read_ply(os.fsencode(path), first, most)
    return comments, np.frombuffer(rows, dtype=np.dtype(properties), count=count), total


class PlySource:
    """The Gaussians of a PLY file, a `GaussianSource` that reads a block at a time."""

    def __init__(self, path: Path, checked: bool = True) -> None:
        """Read the header; without `checked`, `blocks` yields values that cannot be shown.

        ValueError: see `read_ply`.
        """
        self._path, self._checked = path, checked
        found, self._count = _read(path, 0, 0)
        self.comments, self.degree, self.has_levels = found.comments, found.degree, found.has_levels

    def __len__(self) -> int:
        return self._count

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians in order (ValueError: a value cannot be shown; names the file)."""
        for first in range(0, self._count, BLOCK):
            block, _ = _read(self._path, first, BLOCK)
            try:
                if self._checked:
                    block.check()
            except ValueError as error:
                remedy = "as flags that choose Gaussians do, such as --min-opacity 0"
                raise ValueError(f"{self._path}, from Gaussian {first:,} on: {error}, {remedy}") from error
            yield block


def read_ply(path: Path | str) -> Gaussians:
    """Read Gaussians; properties may come in any order, and normals may be missing.

    ValueError: the file is damaged or has no such Gaussians; names the file and the reason.
    """
    return _read(Path(path))[0]


def _read(path: Path, *rows: int) -> tuple[Gaussians, int]:
    """Return Gaussians of a file, and the number of all; `rows` as for `_read_table`."""
    comments, table, total = _read_table(path, *rows)
    names = table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    k = (degree_of(rest, path) + 1) ** 2
    missing = [n for n in _property_names(k) if n not in names and n not in ("nx", "ny", "nz")]
    if missing:
        raise ValueError(f"{path}: not a Gaussian PLY: the properties {', '.join(missing[:8])} are missing")

    def columns(*wanted: str) -> Tensor:
        out = np.zeros((len(table), len(wanted)), dtype=np.float32)
        for i, name in enumerate(wanted):
            if name in names:
                out[:, i] = table[name]
        return torch.from_numpy(out)

    sh = torch.empty(len(table), k, 3)
    sh[:, 0] = columns("f_dc_0", "f_dc_1", "f_dc_2")
    for channel in range(3):
        sh[:, 1:, channel] = columns(*(f"f_rest_{channel * (k - 1) + i}" for i in range(k - 1)))
    found = Gaussians(
        means=columns("x", "y", "z"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=columns("scale_0", "scale_1", "scale_2"),
        opacities=columns("opacity")[:, 0],
        sh=sh,
        normals=columns("nx", "ny", "nz"),
        comments=comments,
        levels=columns(LEVEL)[:, 0] if LEVEL in names else None,
    )
    return found, total


def write_ply(
    path: Path | str,
    *,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    normals: Tensor | None = None,
    offset: npt.NDArray[np.float64] | None = None,
    comments: list[str] | None = None,
    levels: Tensor | None = None,
) -> None:
    """Write Gaussians in the INRIA layout; the file appears under its name only when it is complete.

    Args:
        path: file to write, in a folder that exists. Only an empty file or a PLY is replaced.
        means: [N, 3].
        quats: [N, 4] w, x, y, z.
        scales: [N, 3] logarithms.
        opacities: [N] logits.
        sh: [N, K, 3], K = 1, 4, 9 or 16.
        normals: [N, 3]; zero when left out.
        offset: float64 [3] added to the means in float64; `Capture.offset` restores the capture's own world.
            A warning says if float32 rounds the sums by more than 1 % of the Gaussians' size.
        comments: header lines, each "comment ..." or "obj_info ...".
        levels: [N] octree levels; None: the file has none.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: shapes disagree, or a value is NaN (or a mean infinite).
        FileExistsError: there is a file of another format.
        FileNotFoundError: there is no such folder.
        OSError: the file cannot be written, or `path` is no regular file; an existing file is unchanged.
    """
    found = Gaussians(means, quats, scales, opacities, sh, normals, comments or [], levels)
    found.check()
    if offset is not None and len(found):
        farthest = np.abs(means.detach().cpu().double().numpy() + np.asarray(offset)).max()
        rounding = float(np.spacing(np.float32(farthest))) / 2
        if rounding > MAX_ROUNDING * float(scales.detach().median(dim=1).values.median().exp()):
            warn(
                f"{path}: so far from the origin, float32 rounds positions by up to {rounding:.3g}: instead "
                'of offset, pass comments=["comment offset X Y Z"], which BlitzGS reads'
            )
    save_ply(Path(path), found, offset)


def save_ply(path: Path, source: GaussianSource, offset: npt.NDArray[np.float64] | None = None) -> None:
    """Write Gaussians block by block; see `write_ply`."""
    check_replaceable(path, (b"ply",), " and is not a PLY file")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} is not a folder: make it first, or choose another one")
    names = _property_names((source.degree + 1) ** 2) + [LEVEL] * source.has_levels
    for line in source.comments:
        if not line.startswith(("comment", "obj_info")) or "\n" in line:
            raise ValueError(f"ply: '{line}' is not one comment or obj_info line")
    header = ["ply", "format binary_little_endian 1.0", *source.comments, f"element vertex {len(source)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    with new_file(path) as partial:
        try:
            with open(partial, "wb") as file:
                file.write(os.fsencode("\n".join(header)))
                for block in source.blocks():
                    block.check()
                    file.write(_rows(block, offset).data)
        except OSError as error:
            reason = error.strerror or str(error).rpartition(": ")[2]
            raise OSError(f"{path} cannot be written: {reason}") from error


def _rows(block: Gaussians, offset: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float32]:
    """Return the bytes of a block, float32 [N, properties]."""
    means, sh = block.means.detach().cpu().double().numpy(), _array(block.sh)
    normals = np.zeros_like(means) if block.normals is None else _array(block.normals)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(block), 3 * (sh.shape[1] - 1))
    columns = [means if offset is None else means + np.asarray(offset), normals, sh[:, 0], rest]
    columns += [_array(block.opacities)[:, None], _array(block.scales), _array(block.quats)]
    if block.levels is not None:
        columns.append(_array(block.levels)[:, None])
    return np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")


def _array(tensor: Tensor) -> npt.NDArray[np.float32]:
    return tensor.detach().to("cpu", torch.float32).numpy()


# The names of colours, in any case; a file of Gaussians has coefficients instead.
_COLORS = [(f"{prefix}red", f"{prefix}green", f"{prefix}blue") for prefix in ("", "diffuse_", "vertex_")]
_COLORS += [
    ("r", "g", "b"),
    ("color_r", "color_g", "color_b"),
    ("ambient_red", "ambient_green", "ambient_blue"),
]
_COEFFICIENTS = ("f_dc_0", "f_dc_1", "f_dc_2")
_GREY = 128
# Rounding and sharpening overshoot the range of a colour by this share.
_OVERSHOOT = 0.05


@dataclass
class PointCloud:
    """M coloured points."""

    positions: npt.NDArray[np.float64]
    """[M, 3]."""
    colors: npt.NDArray[np.uint8]
    """[M, 3]; grey if the file has none."""
    colors_from: str
    """The properties that give the colours, as text; empty: none."""
    properties: tuple[str, ...]
    """All properties of a point."""


def read_point_cloud(path: Path | str) -> PointCloud:
    """Read points; those of a file of Gaussians are their centres in the colours that all sides show.

    ValueError: the file is damaged, has no x, y, z, or has colours of another kind.
    """
    _, table, _ = _read_table(Path(path))
    stored = {name.lower(): name for name in reversed(table.dtype.names or ())}
    if not {"x", "y", "z"} <= stored.keys():
        raise ValueError(f"{path}: the points have no x, y, z")

    def columns(names: Sequence[str]) -> npt.NDArray[Any]:
        return np.stack([table[stored[name]] for name in names], axis=1)

    positions, every = columns("xyz"), table.dtype.names or ()
    _check_steps(positions, path)
    positions = positions.astype(np.float64)
    names = next((names for names in _COLORS if set(names) <= stored.keys()), None)
    if names is not None:
        return PointCloud(positions, _color_bytes(columns(names), path), ", ".join(names), every)
    if set(_COEFFICIENTS) <= stored.keys():
        fractions = 0.5 + SH_C0 * columns(_COEFFICIENTS).astype(np.float64)
        _check_colors(np.isfinite(fractions), fractions, path)
        colors = (np.clip(fractions, 0, 1) * 255 + 0.5).astype(np.uint8)
        return PointCloud(positions, colors, "f_dc_0 to f_dc_2", every)
    return PointCloud(positions, np.full((len(table), 3), _GREY, dtype=np.uint8), "", every)


def _check_steps(positions: npt.NDArray[Any], path: Path | str) -> None:
    """Warn of positions [N, 3] that are too far from the origin for the digits of their dtype."""
    finite = positions[np.isfinite(positions).all(axis=1)]
    if finite.dtype.kind != "f" or len(finite) < 2:
        return
    step, size = float(np.spacing(np.abs(finite).max())), float(np.ptp(finite, axis=0).max())
    if step > _LARGEST_STEP * size > 0:
        warn(
            f"{path}: its {finite.dtype} positions are rounded to {step:.2g}, so far from the origin are the "
            "points: export them as double, or in the local coordinates of the cameras"
        )


def _color_bytes(colors: npt.NDArray[Any], path: Path | str) -> npt.NDArray[np.uint8]:
    """Return colours as bytes; floats are fractions of white or numbers from 0 to 255."""
    if colors.dtype.kind != "f":
        # Some programs write bytes as signed ones.
        if colors.dtype.itemsize > 1:
            _check_colors((colors >= 0) & (colors <= 255), colors, path)
        return colors.astype(np.uint8)
    full = 1.0 if _are_fractions(colors) else 255.0
    low, high = -_OVERSHOOT * full, (1 + _OVERSHOOT) * full
    # A few fractions above white are what brighter points have in programs that do not clip.
    _check_colors((colors >= low) & ((colors <= high) | (full == 1.0)) & np.isfinite(colors), colors, path)
    return np.asarray(np.clip(colors * (255 / full) + 0.5, 0, 255).astype(np.uint8))


def _are_fractions(colors: npt.NDArray[Any]) -> bool:
    """Tell fractions of white from numbers up to 255; a few fractions may be above 1."""
    top = float(colors.max(initial=0))
    if top <= 1:
        return True
    between = bool(((colors > 0) & (colors < 1)).any())
    return between and (top <= 2 or float((colors <= 1).mean()) >= 0.99)


def _check_colors(usable: npt.NDArray[np.bool_], colors: npt.NDArray[Any], path: Path | str) -> None:
    if not usable.all():
        raise ValueError(
            f"{path}: a point has the colour {colors[~usable][0]}: numbers from 0 to 255 are read, or "
            "fractions of white; write the colours as uchar"
        )
