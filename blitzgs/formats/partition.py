# SPDX-License-Identifier: Apache-2.0
"""Sorts Gaussians by region and octree level, more of them than memory holds.

The first pass over the blocks of a model writes position, size and level of each Gaussian into a temporary
file and counts them in the cells of a grid. From the counts a caller chooses parts, each a set of (cell,
level). The second pass writes the rows of each part next to each other into another temporary file, in the
order of level and then of the model. Memory holds one block and the counts of the occupied cells.
"""

from __future__ import annotations

import errno
import math
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import Gaussians, GaussianSource
from blitzgs.util.terminal import amount

# Cells of the grid along an axis, as a power of two. A cell's key has the digits of an octree, 3 bits each.
BITS = 8
# A splat touches no pixel farther away than so many standard deviations (docs/image.md: alpha >= 1/255).
REACH = math.sqrt(2 * math.log(255))
# The picture for which the geometric errors are: a viewer that refines at 16 pixels shows each level from the
# distance on from which the LOD gate shows it.
_PIXELS, _HEIGHT, _FOV = 16, 1080, math.radians(60)
# Gaussians of trained level 0, or of a model without levels, are in classes of opacity times sqrt(a b) of the
# largest two scales, each half of the one before (docs/decisions.md). A viewer that refines at
# `_PIXELS` leaves one out where it is smaller than so many pixels.
_CLASSES, _FOOTPRINT = 8, 0.1
_PLACE = np.dtype([("mean", "<f4", 3), ("size", "<f4"), ("level", "u1")])
_CHUNK, _SAMPLE = 1 << 17, 1 << 17
_LOD = re.compile(r"comment lod reference_distance (\S+) fork (\S+) levels (\d+) .*")

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Counts:
    """How many Gaussians the occupied cells have.

    Attributes:
        cells: key of the cell of each entry, sorted, int64 [E].
        levels: level of each entry, int64 [E], ascending within a cell.
        counts: number of Gaussians of each entry, int64 [E].
        errors: for each level, the size in the model's unit of what is missing without the finer levels.
        whole_error: the same if nothing is shown.
    """

    cells: Ints
    levels: Ints
    counts: Ints
    errors: list[float]
    whole_error: float


class Partition:
    """A model that is being sorted into parts; its temporary files are in a folder of the caller."""

    def __init__(self, source: GaussianSource, folder: Path) -> None:
        """Read the model for the first time.

        Args:
            source: at least one Gaussian.
            folder: an existing folder with space for a copy of the model.

        Raises:
            ValueError: there is no Gaussian, or a value is NaN or infinite.
            OSError: the disk is full.
        """
        if len(source) == 0:
            raise ValueError("the model has no Gaussian, so there is nothing to write")
        self._source, self._places, self._rows = source, folder / "places.tmp", folder / "rows.tmp"
        self._width = 12 + 3 * (source.degree + 1) ** 2
        needed = len(source) * (_PLACE.itemsize + 4 * self._width)
        free = shutil.disk_usage(folder).free
        if free < 2 * needed:
            raise OSError(
                errno.ENOSPC,
                f"{amount(2 * needed)} are needed for the files and a temporary copy, and "
                f"{amount(free)} are free",
                str(folder),
            )
        with open(self._places, "wb") as file:
            for block in source.blocks():
                block.check()
                places = np.zeros(len(block), _PLACE)
                places["mean"], places["size"] = block.means.numpy(), _sizes(block)
                if block.levels is not None:
                    places["level"] = block.levels.numpy()
                file.write(places.data)
        self._measure()

    def _measure(self) -> None:
        """Choose the grid and the classes, which are levels coarser than the trained ones."""
        step = max(1, -(-len(self._source) // _SAMPLE))
        some = np.concatenate([chunk[::step] for chunk in self._chunks()])
        means = some["mean"].astype(np.float64)
        low, high = np.quantile(means, [0.002, 0.998], axis=0)
        side = 1.05 * float((high - low).max()) or 1.0
        # A flat scene is not cut along its short side.
        self._origin, self._cell = low - 0.02 * side, side / 2**BITS
        self.box = np.stack([low, high])
        largest = max(float(np.quantile(some["size"].astype(np.float64), 0.99)), 1e-30)
        lod = next((found for line in self._source.comments if (found := _LOD.fullmatch(line.strip()))), None)
        errors, self._merged, self._classes = [], 0, _CLASSES
        if self._source.has_levels and lod is not None:
            distance, fork, levels = float(lod[1]), float(lod[2]), int(lod[3])
            angle = _PIXELS * 2 * math.tan(_FOV / 2) / _HEIGHT
            # Finer levels than those of an octree are taken together, or viewers would switch all the time.
            self._merged = max(1, round(math.log(2) / math.log(fork)))
            last = range(0, levels + self._merged - 1, self._merged)
            errors = [angle * distance * fork ** (-0.5 - level) for level in last]
            # Level 0 has everything that is large enough at the largest distance of training.
            smallest = max(errors[0] * _FOOTPRINT / _PIXELS, 1e-30)
            self._classes = min(max(1, math.ceil(math.log2(largest / smallest))), _CLASSES // 2)
            largest = smallest * 2**self._classes
        first = largest * _PIXELS / _FOOTPRINT
        self._largest = largest
        errors = [first * 2.0**-index for index in range(1, self._classes + (not errors))] + errors
        # The coarsest level is shown at any distance at which the scene is larger than that.
        self._errors, self._whole_error = errors, max(side, 2 * errors[0])

    def _chunks(self) -> Iterator[npt.NDArray[np.void]]:
        with open(self._places, "rb") as file:
            while len(places := np.fromfile(file, _PLACE, _CHUNK)):
                yield places

    def _codes(self, places: npt.NDArray[np.void]) -> Ints:
        """Return cell << 8 | level; Gaussians outside the grid belong to its nearest cell."""
        last = 2**BITS - 1
        index = np.floor((places["mean"] - self._origin) / self._cell).clip(0, last).astype(np.int64)
        codes = interleaved(index, BITS)
        with np.errstate(divide="ignore"):
            levels = np.floor(np.log2(self._largest / places["size"].astype(np.float64)))
        levels = levels.clip(0, self._classes - 1).astype(np.int64)
        if self._merged:
            trained = -(-places["level"].astype(np.int64) // self._merged)
            levels = np.where(trained > 0, trained + self._classes - 1, levels).clip(0, len(self._errors) - 1)
        return codes << 8 | levels

    def count(self) -> Counts:
        """Count the Gaussians of each cell and level."""
        codes, counts = np.zeros(0, np.int64), np.zeros(0, np.int64)
        for chunk in self._chunks():
            new, times = np.unique(self._codes(chunk), return_counts=True)
            codes, inverse = np.unique(np.concatenate([codes, new]), return_inverse=True)
            merged = np.zeros(len(codes), np.int64)
            np.add.at(merged, inverse, np.concatenate([counts, times]))
            counts = merged
        self._entries = codes
        return Counts(codes >> 8, codes & 255, counts, self._errors, self._whole_error)

    def place(self, parts: Ints, counts: Ints) -> Parts:
        """Read the model again and sort its rows.

        Args:
            parts: the part of each entry of `count`, int64 [E].
            counts: `Counts.counts`.

        Returns:
            The parts; their rows are in the order of level and then of the model.
        """
        groups, group_of_entry = np.unique(parts * 256 + (self._entries & 255), return_inverse=True)
        totals = np.zeros(len(groups), np.int64)
        np.add.at(totals, group_of_entry, counts)
        position = np.cumsum(totals) - totals
        size, chunks = 4 * self._width, _Cursor(self._chunks())
        with open(self._rows, "wb") as file:
            for block in self._source.blocks():
                codes = self._codes(chunks.take(len(block)))
                found = group_of_entry[np.searchsorted(self._entries, codes)]
                rows = np.empty((len(block), self._width), "<f4")
                rows[:, 0:3], rows[:, 3:7] = block.means.numpy(), block.quats.numpy()
                rows[:, 7:10], rows[:, 10] = block.scales.numpy(), block.opacities.numpy()
                rows[:, 11] = 0 if block.levels is None else block.levels.numpy()
                rows[:, 12:] = block.sh.reshape(len(block), -1).numpy()
                by_group = np.argsort(found, kind="stable")
                present, starts = np.unique(found[by_group], return_index=True)
                for one, some in zip(present, np.split(by_group, starts[1:]), strict=True):
                    file.seek(int(position[one]) * size)
                    file.write(rows[some].data)
                    position[one] += len(some)
        self._places.unlink()
        ends = np.cumsum(totals)[np.flatnonzero(np.diff(groups >> 8, append=-1))]
        starts = np.concatenate([[0], ends])
        return Parts(self._rows, self._width, self._source.comments, self._source.has_levels, starts)


class _Cursor:
    """Takes as many places at a time as a block has rows."""

    def __init__(self, chunks: Iterator[npt.NDArray[np.void]]) -> None:
        self._chunks, self._left = chunks, np.zeros(0, _PLACE)

    def take(self, count: int) -> npt.NDArray[np.void]:
        while len(self._left) < count:
            more = next(self._chunks, None)
            if more is None:
                raise ValueError("the model has more Gaussians in its second reading than in its first")
            self._left = np.concatenate([self._left, more])
        taken, self._left = self._left[:count], self._left[count:]
        return taken


@dataclass(frozen=True)
class Parts:
    """The sorted rows on disk; may be sent to another process.

    Attributes:
        file: float32 rows: mean 3, quaternion 4, log scales 3, opacity logit, level, SH.
        width: numbers of a row.
        comments: header lines of the model.
        has_levels: whether the model has trained levels.
        starts: first row of each part, and the number of rows, int64 [P + 1].
    """

    file: Path
    width: int
    comments: list[str]
    has_levels: bool
    starts: Ints

    def read(self, part: int, count: int | None = None) -> Gaussians:
        """Read the first `count` Gaussians of a part, those of the coarsest levels; None: all."""
        begin = int(self.starts[part])
        end = int(self.starts[part + 1]) if count is None else begin + count
        values = np.fromfile(
            self.file, "<f4", (end - begin) * self.width, offset=4 * self.width * begin
        ).reshape(-1, self.width)
        rows = torch.from_numpy(values)
        return Gaussians(
            means=rows[:, 0:3], quats=rows[:, 3:7], scales=rows[:, 7:10], opacities=rows[:, 10],
            sh=rows[:, 12:].reshape(len(rows), -1, 3), comments=self.comments,
            levels=rows[:, 11] if self.has_levels else None,
        )  # fmt: skip


def _sizes(block: Gaussians) -> Array:
    """Return opacity times the square root of the product of the largest two scales, float64 [N]."""
    broad = block.scales.double().sum(1) - block.scales.double().amin(1)
    return (broad / 2 + torch.nn.functional.logsigmoid(block.opacities.double())).exp().numpy()


def interleaved(index: Ints, bits: int) -> Ints:
    """Return the Morton codes [N] of cells [N, 3]: the bits of x, y and z in turn, x lowest."""
    codes = np.zeros(len(index), np.int64)
    for bit in range(bits):
        for axis in range(3):
            codes |= ((index[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def extents(gaussians: Gaussians) -> Array:
    """Return the box of all that a view can show of Gaussians, float64 [2, 3]."""
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats.double(), dim=1).T.numpy()
    rotations = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    half = REACH * np.linalg.norm(rotations * gaussians.scales.double().exp().numpy().T, axis=1).T
    means = gaussians.means.double().numpy()
    return np.stack([(means - half).min(axis=0), (means + half).max(axis=0)])
