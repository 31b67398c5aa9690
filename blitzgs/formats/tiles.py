# SPDX-License-Identifier: Apache-2.0
"""A model as 3D Tiles 1.1: `tileset.json`, a GLB file with KHR_gaussian_splatting for each tile, and a page.

The page and this module's GLB files go together; with SPZ inside the files, as CesiumJS wants them, there is
no page.

The leaves of the tree hold the Gaussians by region, each in one. A tile above stands for its children
(refine REPLACE): it has an eighth as many, merged from theirs (`blitzgs.formats.proxies`), so all tiles
have at most a seventh more than the model. Bounding volumes are boxes of what a view can show, in the model's
coordinates. `root.transform` maps these to EPSG:4978 where the model is georeferenced, else it turns the
model's up to +Z.
"""

from __future__ import annotations

import glob
import json
import multiprocessing
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import GaussianSource
from blitzgs.formats.glb import EXTENSION, SPZ_EXTENSION, shortest_turn, write_glb, write_spz_glb
from blitzgs.formats.packed import Lost, SpzGrid
from blitzgs.formats.partition import BITS, Partition, Parts, around, extents
from blitzgs.formats.proxies import Rows, merged, moments, shown
from blitzgs.formats.web_page import WebScene, tiles_page
from blitzgs.util.output import locked, sync_to_disk, write_file
from blitzgs.util.progress import Report, follow_parent

TILESET, PAGE = "tileset.json", "index.html"
# Gaussians of a tile: 8 MB at SH degree 3.
TILE = 32_768
# A tile has at most one Gaussian for so many of its children.
_FEWER = 8
# The temporary file with the moments of tiles that have children, each from its `first` row on.
_PROXIES = "proxies.tmp"
# Pixels of the error of a tile in which a cell of its merged Gaussians is one pixel wide.
_PIXELS = 16

Array = npt.NDArray[np.float64]


@dataclass
class Tile:
    """A node of the tree; the last four fields are known once its file is written."""

    count: int  # number of Gaussians; before a tile with children is written, the largest number
    part: int = -1  # number of the leaf's part
    children: list[Tile] = field(default_factory=list)  # tiles of its eighths
    number: int = 0  # of its file
    first: int = 0  # row of its Gaussians among those of all tiles with children
    box: Array = field(default_factory=lambda: np.zeros((2, 3)))  # of what a view can show of its Gaussians
    bytes: int = 0  # size of its file
    edge: float = 0.0  # of the cells in which its Gaussians were merged; 0 for leaves
    lost: Lost = Lost()  # what SPZ cannot hold of them

    def every(self) -> Iterator[Tile]:
        """Yield the tile and those below."""
        yield self
        for child in self.children:
            yield from child.every()

    def height(self) -> int:
        """Return the number of tiles from here to the lowest leaf."""
        return 1 + max((child.height() for child in self.children), default=0)


@dataclass(frozen=True)
class Written:
    """What was written."""

    tiles: int  # number of files
    bytes: int  # their size
    gaussians: int  # number of Gaussians of the model that are in them
    lost: Lost = Lost()  # what SPZ cannot hold of these


def write_tiles(
    path: Path,
    source: GaussianSource,
    transform: Array,
    scene: WebScene,
    title: str,
    most: int = TILE,
    processes: int = 1,
    report: Report = lambda done, total: None,
    spz: bool = False,
) -> Written:
    """Write a tileset; its folder appears under its name only when it is complete.

    Args:
        path: folder to make; it does not exist or is empty.
        source: at least one Gaussian; read twice, block by block.
        transform: [4, 4], from the model's coordinates to those of the tileset.
        scene: how the page beside the tileset shows it, in the model's coordinates.
        title: heading of the page.
        most: Gaussians of a tile; a leaf that would be smaller than a 256th of the region may have more.
        processes: that merge and encode.
        report: called with the number of tiles written, and of all.
        spz: compress the tiles, and write no page.

    Raises:
        ValueError: there is no Gaussian, or a value is not finite.
        FileExistsError: the folder has files.
        OSError: the disk is full, or `path` cannot be written; nothing is left.
    """
    with new_folder(path) as folder:
        root, parts = divided(source, folder, most)
        (folder / "tiles").mkdir()
        _encode_all(partial(_encode, parts, spz), root, processes, report)
        parts.file.unlink()
        (folder / _PROXIES).unlink(missing_ok=True)
        content, _ = _node(root)
        content["transform"] = transform.T.ravel().tolist()
        names = [EXTENSION, SPZ_EXTENSION] if spz else [EXTENSION]
        tileset = {
            "asset": {"version": "1.1", "generator": "BlitzGS"},
            # As long as the scene is larger than that, something is shown.
            "geometricError": max(parts.side, 2 * content["geometricError"]),
            "root": content,
            # 3D Tiles 1.1 has GLB contents of its own; by this, viewers learn before the first content which
            # glTF extensions they need.
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": {"extensionsUsed": names, "extensionsRequired": names}},
            "extras": {
                "gaussians": len(source), "degree": source.degree, "comments": source.comments,
                "view": asdict(scene),
            },
        }  # fmt: skip
        if not spz:
            write_file(folder / PAGE, tiles_page(title))
        write_file(folder / TILESET, json.dumps(tileset, allow_nan=False))
    tiles = list(root.every())
    leaves = [tile.lost for tile in tiles if not tile.children]
    lost = Lost(sum(some.cut for some in leaves), sum(some.left_out for some in leaves))
    return Written(len(tiles), sum(tile.bytes for tile in tiles), len(source) - lost.left_out, lost)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder, which gets its final name when the context ends without an error.

    What a process left here that was killed is removed.

    Raises:
        FileExistsError: `path` is a file or a link, or a folder with files.
        OSError: the folder cannot be written.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir()) or (path.is_dir() and any(path.iterdir())):
        raise FileExistsError(f"{path} exists and is not an empty folder: remove it or choose another name")
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'[0-9a-f]' * 8}.partial"):
        with suppress(OSError), locked(left):
            shutil.rmtree(left)
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    unfinished.mkdir()
    held = ExitStack()
    with suppress(OSError):  # some file systems of networks have no locks
        held.enter_context(locked(unfinished))
    try:
        yield unfinished
        sync_to_disk(unfinished)
        os.rename(unfinished, path)
        sync_to_disk(path.parent)
    except OSError as error:
        # A write to a full disk names no file, or one that is gone when the user reads this.
        if error.errno is not None:
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        held.close()


def divided(source: GaussianSource, folder: Path, most: int) -> tuple[Tile, Parts]:
    """Divide a model into parts of at most so many Gaussians; return the root of their tree, and them.

    `folder`: of temporary files. ValueError, OSError: as `Partition`.
    """
    partition = Partition(source, folder)
    keys, counts = partition.cells, partition.counts
    parts = np.full(len(keys), -1, np.int64)
    number = first = 0

    def leaf(cells: npt.NDArray[np.int64]) -> Tile:
        nonlocal number
        parts[cells] = number
        number += 1
        return Tile(int(counts[cells].sum()), number - 1)

    def tile(cells: npt.NDArray[np.int64], depth: int) -> Tile:
        sizes = counts[cells]
        if sizes.sum() <= most or depth == BITS:
            return leaf(cells)
        octants = keys[cells] >> 3 * (BITS - 1 - depth) & 7
        totals = np.bincount(octants, sizes, minlength=8)
        # Small eighths beside each other are one leaf.
        children, together = [], np.zeros(0, np.int64)
        for octant in np.flatnonzero(totals):
            inside = cells[octants == octant]
            if len(together) and counts[together].sum() + totals[octant] > most:
                children.append(leaf(together))
                together = np.zeros(0, np.int64)
            if totals[octant] > most:
                children.append(tile(inside, depth + 1))
            else:
                together = np.concatenate([together, inside])
        if len(together):
            children.append(leaf(together))
        if len(children) == 1:
            return children[0]
        # A tile much smaller than others is not worth a request: its children are the parent's.
        small = most // _FEWER
        children = [one for child in children for one in (child.count < small and child.children or [child])]
        return Tile(min(most, max(1, sum(child.count for child in children) // _FEWER)), children=children)

    root = tile(np.arange(len(keys)), 0)
    for index, one in enumerate(root.every()):
        one.number = index
        if one.children:
            one.first, first = first, first + one.count
    return root, partition.place(parts)


@contextmanager
def workers(processes: int) -> Iterator[Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]]:
    """Yield a `map` whose function is computed by several processes; its results come in order."""
    if processes == 1:
        yield map
        return
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _prepare)
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    follow_parent()
    torch.set_num_threads(1)


def _encode_all(
    encode: Callable[[Tile], tuple[Array, int, int, float, Lost]], root: Tile, processes: int, report: Report
) -> None:
    """Write all tiles, children before their parents."""
    tiles, done = sorted(root.every(), key=Tile.height), 0
    with workers(processes) as run:
        for _, level in groupby(tiles, key=Tile.height):
            same = list(level)
            for tile, found in zip(same, run(encode, same), strict=True):
                tile.box, tile.count, tile.bytes, tile.edge, tile.lost = found
                done += 1
                report(done, len(tiles))


def _encode(parts: Parts, spz: bool, tile: Tile) -> tuple[Array, int, int, float, Lost]:
    """Write the file of a tile; return its last fields, with the number of its Gaussians."""
    edge, lost, folder = 0.0, Lost(), parts.file.parent
    if not tile.children:
        gaussians = parts.read(tile.part)
    else:
        rows = np.concatenate([_moments(parts, child) for child in tile.children])
        least = max(child.edge for child in tile.children)
        most = min(tile.count, max(1, len(rows) // _FEWER))
        rows, edge = merged(rows, most, parts.box, parts.antialiased, least)
        with open(os.open(folder / _PROXIES, os.O_WRONLY | os.O_CREAT, 0o666), "wb") as file:
            file.seek(tile.first * rows.itemsize * rows.shape[1])
            file.write(rows.data)
        gaussians = shown(rows, parts.comments)
    path = folder / _uri(tile)
    # glTF's up is +Y and that of 3D Tiles +Z; viewers turn contents between the two.
    count = len(gaussians)
    if spz:
        grid = SpzGrid.of(gaussians)
        gaussians = gaussians.rows(grid.holds(gaussians))
        lost = write_spz_glb(path, gaussians, grid)._replace(left_out=count - len(gaussians))
    else:
        write_glb(path, gaussians, up=(0.0, 0.0, 1.0))
    return extents(gaussians), count, path.stat().st_size, edge, lost


def _moments(parts: Parts, tile: Tile) -> Rows:
    if not tile.children:
        return moments(parts.read(tile.part))
    width = parts.width - 2  # no level; a covariance has one number less than quaternion and scales
    file = parts.file.with_name(_PROXIES)
    return np.fromfile(file, "<f4", tile.count * width, offset=4 * tile.first * width).reshape(-1, width)


def _uri(tile: Tile) -> str:
    return f"tiles/{tile.number:06d}.glb"


def _node(tile: Tile) -> tuple[dict[str, Any], Array]:
    """Return the JSON of a tile and the box of its contents and those of its descendants."""
    node: dict[str, Any] = {
        "boundingVolume": {},
        "geometricError": _PIXELS * tile.edge,
        "refine": "REPLACE",
        "content": {
            "uri": _uri(tile),
            "boundingVolume": {"box": _box(tile.box)},
            "extras": {"gaussians": tile.count - tile.lost.left_out},
        },
    }
    nodes = [_node(child) for child in tile.children]
    if nodes:
        node["children"] = [child for child, _ in nodes]
    box = around([tile.box, *(box for _, box in nodes)])
    node["boundingVolume"] = {"box": _box(box)}
    return node, box


def _box(box: Array) -> list[float]:
    """Return the centre and the half axes, as 3D Tiles has boxes; no half axis is 0."""
    half = np.maximum((box[1] - box[0]) / 2, 1e-6)
    return [*box.mean(axis=0).tolist(), *np.diag(half).ravel().tolist()]


def upright(up: tuple[float, float, float]) -> Array:
    """Return the rotation [4, 4] that turns a direction to +Z by the shortest way."""
    turned = np.eye(4)
    turned[:3, :3] = shortest_turn(up, 2)
    return turned
