# SPDX-License-Identifier: Apache-2.0
"""A model as streamed SOG, version 1, which SuperSplat and the PlayCanvas engine load piece by piece.

Format: developer.playcanvas.com, "The Streamed SOG Format". `lod-meta.json` has a binary tree over the
region. A viewer shows one LOD of each leaf, by distance: LOD 0 has all its Gaussians, and each further one
about a quarter as many, merged in cells (`blitzgs.formats.proxies`) of the same size in all leaves. Each LOD
of a leaf is an SOG of its own (`meta.json` and WebP files), in Morton order.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import GaussianSource, is_antialiased
from blitzgs.formats.partition import BITS, Counts, Partition, Parts, extents, interleaved
from blitzgs.formats.proxies import merged, moments, shown
from blitzgs.formats.sog import write_sog
from blitzgs.formats.tiles import TILE, Written, new_folder, workers
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report

META = "lod-meta.json"

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


# LODs of a leaf, and the Gaussians of one for each of the next.
_LODS, _FEWER = 4, 4


@dataclass
class _Leaf:
    part: int
    count: int


def write_streamed_sog(
    path: Path,
    source: GaussianSource,
    most: int = TILE,
    processes: int = 1,
    report: Report = lambda done, total: None,
) -> Written:
    """Write a streamed SOG; its folder appears under its name only when it is complete.

    Args:
        path: folder to make; it does not exist or is empty.
        source: at least one Gaussian; read twice, block by block.
        most: Gaussians of a leaf, as for `write_tiles`.
        processes: that encode.
        report: as for `write_tiles`.

    Raises:
        ValueError: there is no Gaussian, or a value is not finite.
        FileExistsError: the folder has files.
        OSError: the disk is full, or `path` cannot be written; nothing is left.
    """
    with new_folder(path) as folder:
        partition = Partition(source, folder)
        counts = partition.count()
        parts_of_cells = np.zeros(len(counts.cells), np.int64)
        leaves: list[_Leaf] = []
        tree = _split(counts, np.arange(len(counts.cells)), 0, most, parts_of_cells, leaves)
        parts = partition.place(parts_of_cells, counts.counts)
        chosen = (parts, folder, partition.box, is_antialiased(source))
        boxes: dict[int, Array] = {}
        numbers, size = [], 0
        with workers(processes) as run:
            edges = _medians(
                np.stack(list(run(partial(_edges, *chosen), leaves))), [leaf.count for leaf in leaves]
            )
            jobs = [(leaf, lod, edge) for leaf in leaves for lod, edge in enumerate([0.0, *edges])]
            for (leaf, lod, _), (box, number, written) in zip(
                jobs, run(partial(_encode, *chosen), jobs), strict=True
            ):
                numbers.append(number)
                size += written
                if lod == 0:
                    boxes[leaf.part] = box
                report(len(numbers), len(jobs))
        parts.file.unlink()
        node, _ = _node(tree, boxes, numbers)
        meta = {
            "version": 1,
            "asset": {"generator": "BlitzGS"},
            "count": sum(numbers),
            "counts": [sum(numbers[lod::_LODS]) for lod in range(_LODS)],
            "lodLevels": _LODS,
            "filenames": [f"{_name(leaf, lod)}/meta.json" for leaf, lod, _ in jobs],
            "tree": node,
        }
        write_file(folder / META, json.dumps(meta, allow_nan=False))
    return Written(len(jobs), size, len(source))


def _split(
    counts: Counts, cells: Ints, depth: int, most: int, parts: Ints, leaves: list[_Leaf]
) -> tuple[Any, Any] | _Leaf:
    """Halve a region along z, y and x in turn until a part has at most so many Gaussians."""
    while True:
        count = int(counts.counts[cells].sum())
        if count <= most or depth == 3 * BITS:
            leaf = _Leaf(len(leaves), count)
            parts[cells] = leaf.part
            leaves.append(leaf)
            return leaf
        upper = (counts.cells[cells] >> (3 * BITS - 1 - depth) & 1).astype(bool)
        depth += 1
        if upper.any() and not upper.all():
            low = _split(counts, cells[~upper], depth, most, parts, leaves)
            return low, _split(counts, cells[upper], depth, most, parts, leaves)


def _name(leaf: _Leaf, lod: int) -> str:
    return f"{lod}_{leaf.part}"


def _edges(parts: Parts, _: Path, box: Array, antialiased: bool, leaf: _Leaf) -> Array:
    """Return the edges of the cells in which a leaf would have a quarter, a 16th and a 64th, [_LODS - 1]."""
    rows, edges = moments(parts.read(leaf.part)), []
    for lod in range(1, _LODS):
        edges.append(merged(rows, max(1, leaf.count // _FEWER**lod), box, antialiased)[1])
    return np.array(edges)


def _medians(values: Array, weights: list[int]) -> list[float]:
    """Return the weighted median of each column of values [N, C]."""
    order = values.argsort(axis=0)
    middle = (np.cumsum(np.array(weights)[order], axis=0) >= sum(weights) / 2).argmax(axis=0)
    sorted_values = np.take_along_axis(values, order, axis=0)
    return [float(sorted_values[row, column]) for column, row in enumerate(middle)]


def _encode(
    parts: Parts, folder: Path, box: Array, antialiased: bool, job: tuple[_Leaf, int, float]
) -> tuple[Array, int, int]:
    """Write one LOD of a leaf, merged in cells of an edge; return its box, number of Gaussians and size."""
    leaf, lod, edge = job
    gaussians = parts.read(leaf.part)
    if lod > 0:
        rows, _ = merged(moments(gaussians), leaf.count, box, antialiased, edge)
        gaussians = shown(rows, parts.comments)
    means = gaussians.means.double().numpy()
    sides = np.maximum(np.ptp(means, axis=0), 1e-30)
    cells = ((means - means.min(axis=0)) / sides * 1023).astype(np.int64)
    gaussians = gaussians.rows(torch.from_numpy(np.argsort(interleaved(cells, 10), kind="stable")))
    chunk = folder / _name(leaf, lod)
    chunk.mkdir()
    bundle = chunk / "bundle.sog"
    write_sog(bundle, gaussians)
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(chunk)
    bundle.unlink()
    return extents(gaussians), len(gaussians), sum(file.stat().st_size for file in chunk.iterdir())


def _node(
    tree: tuple[Any, Any] | _Leaf, boxes: dict[int, Array], numbers: list[int]
) -> tuple[dict[str, Any], Array]:
    """Return the JSON of a node and its box; `numbers` are those of Gaussians in each file."""
    if isinstance(tree, _Leaf):
        files = range(_LODS * tree.part, _LODS * (tree.part + 1))
        lods = {
            str(lod): {"file": file, "offset": 0, "count": numbers[file]} for lod, file in enumerate(files)
        }
        return {"bound": _bound(boxes[tree.part]), "lods": lods}, boxes[tree.part]
    nodes = [_node(half, boxes, numbers) for half in tree]
    every = np.stack([box for _, box in nodes])
    box = np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])
    return {"bound": _bound(box), "children": [node for node, _ in nodes]}, box


def _bound(box: Array) -> dict[str, list[float]]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}
