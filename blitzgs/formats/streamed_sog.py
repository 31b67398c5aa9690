# SPDX-License-Identifier: Apache-2.0
"""A model as streamed SOG, version 1, which SuperSplat and the PlayCanvas engine load piece by piece.

Format: developer.playcanvas.com, "The Streamed SOG Format". `lod-meta.json` has a binary tree over the
region. A viewer shows one LOD of each leaf: LOD 0 has all its Gaussians, LOD n lacks the n finest octree
levels of the model. Each LOD of a leaf is an SOG of its own (`meta.json` and WebP files), in Morton order.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import GaussianSource
from blitzgs.formats.partition import BITS, Counts, Partition, Parts, extents, interleaved
from blitzgs.formats.sog import write_sog
from blitzgs.formats.tiles import TILE, Written, each_part, new_folder
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report

META = "lod-meta.json"

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass
class _Leaf:
    part: int
    by_level: list[int]  # number of Gaussians of each level


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
    with new_folder(path) as partial:
        partition = Partition(source, partial)
        counts = partition.count()
        parts_of_entries = np.zeros(len(counts.cells), np.int64)
        leaves: list[_Leaf] = []
        tree = _split(counts, np.arange(len(counts.cells)), 0, most, parts_of_entries, leaves)
        parts = partition.place(parts_of_entries, counts.counts)
        lods = len(counts.errors)
        # Numbers of Gaussians of each LOD; those that a leaf has none of are left out.
        jobs = [
            (leaf.part, lod, count)
            for leaf in leaves
            for lod, count in enumerate(np.cumsum(leaf.by_level)[::-1].tolist())
            if count
        ]
        boxes, size = {}, 0
        for (part, lod, _), (box, written) in zip(
            jobs, each_part(_encode, parts, partial, processes, jobs, report), strict=True
        ):
            size += written
            if lod == 0:
                boxes[part] = box
        parts.file.unlink()
        totals = [sum(count for _, lod, count in jobs if lod == one) for one in range(lods)]
        while totals[-1] == 0:
            totals.pop()
        files = {(part, lod): index for index, (part, lod, _) in enumerate(jobs)}
        node, _ = _node(tree, boxes, {(part, lod): count for part, lod, count in jobs}, files)
        meta = {
            "version": 1,
            "asset": {"generator": "BlitzGS"},
            "count": sum(totals),
            "counts": totals,
            "lodLevels": len(totals),
            "filenames": [f"{_name(part, lod)}/meta.json" for part, lod, _ in jobs],
            "tree": node,
        }
        write_file(partial / META, json.dumps(meta, allow_nan=False))
    return Written(len(jobs), size, len(source))


def _split(
    counts: Counts, entries: Ints, depth: int, most: int, parts: Ints, leaves: list[_Leaf]
) -> tuple[Any, Any] | _Leaf:
    """Halve a region along z, y and x in turn until a part has at most so many Gaussians."""
    while True:
        if counts.counts[entries].sum() <= most or depth == 3 * BITS:
            by_level = np.bincount(
                counts.levels[entries], weights=counts.counts[entries], minlength=len(counts.errors)
            )
            leaf = _Leaf(len(leaves), by_level.astype(int).tolist())
            parts[entries] = leaf.part
            leaves.append(leaf)
            return leaf
        upper = (counts.cells[entries] >> (3 * BITS - 1 - depth) & 1).astype(bool)
        depth += 1
        if upper.any() and not upper.all():
            low = _split(counts, entries[~upper], depth, most, parts, leaves)
            return low, _split(counts, entries[upper], depth, most, parts, leaves)


def _name(part: int, lod: int) -> str:
    return f"{lod}_{part}"


def _encode(parts: Parts, folder: Path, job: tuple[int, int, int]) -> tuple[Array, int]:
    """Write one LOD of a leaf; return the box of its Gaussians and the size of its files."""
    part, lod, count = job
    gaussians = parts.read(part, count)
    means = gaussians.means.double().numpy()
    sides = np.maximum(np.ptp(means, axis=0), 1e-30)
    cells = ((means - means.min(axis=0)) / sides * 1023).astype(np.int64)
    gaussians = gaussians.rows(torch.from_numpy(np.argsort(interleaved(cells, 10), kind="stable")))
    chunk = folder / _name(part, lod)
    chunk.mkdir()
    bundle = chunk / "bundle.sog"
    write_sog(bundle, gaussians)
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(chunk)
    bundle.unlink()
    return extents(gaussians), sum(file.stat().st_size for file in chunk.iterdir())


def _node(
    tree: tuple[Any, Any] | _Leaf,
    boxes: dict[int, Array],
    counts: dict[tuple[int, int], int],
    files: dict[tuple[int, int], int],
) -> tuple[dict[str, Any], Array]:
    """Return the JSON of a node and its box."""
    if isinstance(tree, _Leaf):
        lods = {
            str(lod): {"file": files[tree.part, lod], "offset": 0, "count": counts[tree.part, lod]}
            for lod in range(len(tree.by_level))
            if (tree.part, lod) in files
        }
        return {"bound": _bound(boxes[tree.part]), "lods": lods}, boxes[tree.part]
    nodes = [_node(half, boxes, counts, files) for half in tree]
    every = np.stack([box for _, box in nodes])
    box = np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])
    return {"bound": _bound(box), "children": [node for node, _ in nodes]}, box


def _bound(box: Array) -> dict[str, list[float]]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}
