# SPDX-License-Identifier: Apache-2.0
"""A model as streamed SOG, version 1, which SuperSplat and the PlayCanvas engine load piece by piece.

Format: developer.playcanvas.com, "The Streamed SOG Format". `lod-meta.json` is a binary tree over the region,
whose leaves are those of `blitzgs.formats.tiles`. A viewer shows one LOD of each leaf, by distance: LOD 0 has
all its Gaussians, and each further one about a quarter as many, merged in cells (`blitzgs.formats.proxies`)
of the same size in all leaves. Each LOD of a leaf is an SOG of its own (`meta.json` and WebP files), in
Morton order.
"""

from __future__ import annotations

import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import GaussianSource
from blitzgs.formats.partition import Parts, around, extents, interleaved
from blitzgs.formats.proxies import merged, moments, shown
from blitzgs.formats.sog import write_sog
from blitzgs.formats.tiles import TILE, Tile, Written, divided, new_folder, workers
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report

META = "lod-meta.json"

Array = npt.NDArray[np.float64]
# LODs of a leaf, and the Gaussians of one for each of the next.
_LODS, _FEWER = 4, 4


def write_streamed_sog(
    path: Path,
    source: GaussianSource,
    most: int = TILE,
    processes: int = 1,
    report: Report = lambda done, total: None,
) -> Written:
    """Write a streamed SOG; its folder appears under its name only when it is complete.

    Leaves have at most `most` Gaussians. All arguments and errors are those of `write_tiles`.
    """
    with new_folder(path) as folder:
        root, parts = divided(source, folder, most)
        # Parts are numbered in this order.
        leaves = [tile for tile in root.every() if not tile.children]
        files = []
        with workers(processes) as run:
            found = np.stack(list(run(partial(_edges, parts), leaves)))
            edges = [0.0, *_medians(found, [leaf.count for leaf in leaves])]
            jobs = [(leaf, lod, edge) for leaf in leaves for lod, edge in enumerate(edges)]
            for file in run(partial(_encode, parts), jobs):
                files.append(file)
                report(len(files), len(jobs))
        parts.file.unlink()
        numbers, size = [number for _, number, _ in files], sum(written for _, _, written in files)
        node, _ = _node([root], files)
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


def _name(leaf: Tile, lod: int) -> str:
    return f"{lod}_{leaf.part}"


def _edges(parts: Parts, leaf: Tile) -> Array:
    """Return the edges of the cells in which a leaf would have a quarter, a 16th and a 64th, [_LODS - 1]."""
    rows = moments(parts.read(leaf.part))
    counts = [max(1, leaf.count // _FEWER**lod) for lod in range(1, _LODS)]
    return np.array([merged(rows, count, parts.box, parts.antialiased)[1] for count in counts])


def _medians(values: Array, weights: list[int]) -> list[float]:
    """Return the weighted median of each column of values [N, C]."""
    order = values.argsort(axis=0)
    middle = (np.cumsum(np.array(weights)[order], axis=0) >= sum(weights) / 2).argmax(axis=0)
    sorted_values = np.take_along_axis(values, order, axis=0)
    return [float(sorted_values[row, column]) for column, row in enumerate(middle)]


def _encode(parts: Parts, job: tuple[Tile, int, float]) -> tuple[Array, int, int]:
    """Write one LOD of a leaf, merged in cells of an edge; return its box, number of Gaussians and size."""
    leaf, lod, edge = job
    gaussians = parts.read(leaf.part)
    if lod > 0:
        rows, _ = merged(moments(gaussians), leaf.count, parts.box, parts.antialiased, edge)
        gaussians = shown(rows, parts.comments)
    means = gaussians.means.double().numpy()
    sides = np.maximum(np.ptp(means, axis=0), 1e-30)
    cells = ((means - means.min(axis=0)) / sides * 1023).astype(np.int64)
    gaussians = gaussians.rows(torch.from_numpy(np.argsort(interleaved(cells, 10), kind="stable")))
    chunk = parts.file.parent / _name(leaf, lod)
    chunk.mkdir()
    bundle = chunk / "bundle.sog"
    write_sog(bundle, gaussians)
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(chunk)
    bundle.unlink()
    return extents(gaussians), len(gaussians), sum(file.stat().st_size for file in chunk.iterdir())


def _node(tiles: list[Tile], files: list[tuple[Array, int, int]]) -> tuple[dict[str, Any], Array]:
    """Return the JSON of tiles as a node, and its box; `files` is what `_encode` returned."""
    if len(tiles) > 1:
        half = len(tiles) // 2
        nodes = [_node(some, files) for some in (tiles[:half], tiles[half:])]
        box = around([box for _, box in nodes])
        content: dict[str, Any] = {"children": [node for node, _ in nodes]}
    elif tiles[0].children:
        return _node(tiles[0].children, files)
    else:
        first = _LODS * tiles[0].part
        box = files[first][0]
        counts = {lod: files[first + lod][1] for lod in range(_LODS)}
        lods = {str(lod): {"file": first + lod, "offset": 0, "count": n} for lod, n in counts.items()}
        content = {"lods": lods}
    return {"bound": {"min": box[0].tolist(), "max": box[1].tolist()}, **content}, box
