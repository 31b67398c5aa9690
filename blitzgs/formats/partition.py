# SPDX-License-Identifier: Apache-2.0
"""Sorts Gaussians by region, more of them than memory holds.

The first pass over the blocks of a model writes the positions into a temporary file and counts them in the
cells of a grid. From the counts a caller chooses parts, each a set of cells. The second pass writes the rows
of each part next to each other into another temporary file, in the order of the model. Memory holds one block
and the counts of the occupied cells.
"""

from __future__ import annotations

import errno
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import Gaussians, GaussianSource, is_antialiased, unit_quats
from blitzgs.util.errors import amount
from blitzgs.util.rotations import quaternion_matrices

# Cells of the grid along an axis, as a power of two. A cell's key has the digits of an octree, 3 bits each.
BITS = 8
# A splat touches no pixel farther away than so many standard deviations (docs/image.md: alpha >= 1/255).
REACH = math.sqrt(2 * math.log(255))
_CHUNK, _SAMPLE = 1 << 17, 1 << 17

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
_Places = npt.NDArray[np.float32]


class Partition:
    """A model that is being sorted into parts; its temporary files are in a folder of the caller."""

    def __init__(self, source: GaussianSource, folder: Path) -> None:
        """Read the model for the first time.

        `folder` exists and has space for two and a half copies of the model. ValueError: there is no
        Gaussian, or a value is NaN or infinite. OSError: the disk is full.
        """
        if len(source) == 0:
            raise ValueError("the model has no Gaussian, so there is nothing to write")
        self._source, self._places, self._rows = source, folder / "places.tmp", folder / "rows.tmp"
        self._width = 12 + 3 * (source.degree + 1) ** 2
        needed = len(source) * (12 + 4 * self._width)
        free = shutil.disk_usage(folder).free
        if free < 2.5 * needed:
            raise OSError(
                errno.ENOSPC,
                f"{amount(int(2.5 * needed))} are needed for the files and a temporary copy, and "
                f"{amount(free)} are free",
                str(folder),
            )
        with open(self._places, "wb") as file:
            for block in source.blocks():
                block.check()
                file.write(block.means.contiguous().numpy().data)
        self._choose_grid()
        self._count()

    def _choose_grid(self) -> None:
        step = max(1, -(-len(self._source) // _SAMPLE))
        means = np.concatenate([chunk[::step] for chunk in self._chunks()]).astype(np.float64)
        self._box = np.quantile(means, [0.002, 0.998], axis=0)
        self._side = 1.05 * float(np.ptp(self._box, axis=0).max()) or 1.0
        # A flat scene is not cut along its short side.
        self._origin, self._cell = self._box[0] - 0.02 * self._side, self._side / 2**BITS

    def _chunks(self) -> Iterator[_Places]:
        with open(self._places, "rb") as file:
            while len(places := np.fromfile(file, "<f4", 3 * _CHUNK)):
                yield places.reshape(-1, 3)

    def _codes(self, places: _Places) -> Ints:
        """Return the keys of cells; Gaussians outside the grid belong to its nearest cell."""
        index = np.floor((places - self._origin) / self._cell).clip(0, 2**BITS - 1).astype(np.int64)
        return interleaved(index, BITS)

    def _count(self) -> None:
        # Keys of the occupied cells, sorted, and the number of Gaussians in each, int64 [E].
        self.cells = self.counts = np.zeros(0, np.int64)
        for chunk in self._chunks():
            new, times = np.unique(self._codes(chunk), return_counts=True)
            self.cells, place = np.unique(np.concatenate([self.cells, new]), return_inverse=True)
            self.counts = np.bincount(place, np.concatenate([self.counts, times])).astype(np.int64)

    def place(self, parts: Ints) -> Parts:
        """Read the model again and sort its rows.

        `parts`: the part of each of `cells`, int64 [E]; each of 0 to P - 1 occurs.
        """
        starts = np.concatenate([[0], np.cumsum(np.bincount(parts, self.counts).astype(np.int64))])
        position, size = starts[:-1].copy(), 4 * self._width
        with open(self._rows, "wb") as file:
            for block in self._source.blocks():
                found = parts[np.searchsorted(self.cells, self._codes(block.means.numpy()))]
                levels = torch.zeros(len(block)) if block.levels is None else block.levels
                columns = [block.means, block.quats, block.scales, block.opacities[:, None], levels[:, None]]
                rows = torch.cat([*columns, block.sh.flatten(1)], dim=1).numpy()
                by_part = np.argsort(found, kind="stable")
                present, firsts = np.unique(found[by_part], return_index=True)
                for one, some in zip(present, np.split(by_part, firsts[1:]), strict=True):
                    file.seek(int(position[one]) * size)
                    file.write(rows[some].data)
                    position[one] += len(some)
        if (position != starts[1:]).any():
            raise ValueError("the model changed between its two readings: write it when no training does")
        self._places.unlink()
        known = (self._source.comments, self._source.has_levels, is_antialiased(self._source))
        return Parts(self._rows, self._width, *known, self._box, self._side, starts)


@dataclass(frozen=True)
class Parts:
    """The sorted rows on disk; may be sent to another process."""

    file: Path  # float32 rows: mean 3, quaternion 4, log scales 3, opacity logit, level, SH
    width: int  # numbers of a row
    comments: list[str]  # header lines of the model
    has_levels: bool  # whether the model has trained levels
    antialiased: bool  # whether viewers compensate the screen-space blur
    box: Array  # where nearly all of the model is, [2, 3]
    side: float  # of the grid
    starts: Ints  # first row of each part, and the number of rows, int64 [P + 1]

    def read(self, part: int) -> Gaussians:
        """Read the Gaussians of a part."""
        begin, end = int(self.starts[part]), int(self.starts[part + 1])
        count = (end - begin) * self.width
        rows = torch.from_numpy(np.fromfile(self.file, "<f4", count, offset=4 * self.width * begin))
        columns = rows.view(-1, self.width).split([3, 4, 3, 1, 1, self.width - 12], dim=1)
        means, quats, scales, opacities, levels, sh = columns
        found = Gaussians(means, quats, scales, opacities[:, 0], sh.unflatten(1, (-1, 3)))
        return replace(found, comments=self.comments, levels=levels[:, 0] if self.has_levels else None)


def interleaved(index: Ints, bits: int) -> Ints:
    """Return the Morton codes [N] of cells [N, 3]: the bits of x, y and z in turn, x lowest."""
    codes = np.zeros(len(index), np.int64)
    for bit in range(bits):
        for axis in range(3):
            codes |= ((index[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def around(boxes: Sequence[Array]) -> Array:
    """Return the box of boxes, [2, 3] each."""
    every = np.stack(boxes)
    return np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])


def extents(gaussians: Gaussians) -> Array:
    """Return the box of all that a view can show of Gaussians, float64 [2, 3]."""
    rotations = quaternion_matrices(unit_quats(gaussians.quats)).numpy()
    half = REACH * np.linalg.norm(rotations * gaussians.scales.double().exp().numpy()[:, None], axis=2)
    means = gaussians.means.double().numpy()
    return np.stack([(means - half).min(axis=0), (means + half).max(axis=0)])
