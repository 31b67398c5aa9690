# SPDX-License-Identifier: Apache-2.0
"""A model as 3D Tiles 1.1: `tileset.json`, a GLB file with KHR_gaussian_splatting for each tile, and a page.

The tree is an octree over the region. A tile holds the coarsest levels of its region that its ancestors do
not hold, as many as fit, and its children add the next ones (refine ADD), so every Gaussian is in one tile.
Bounding volumes are boxes of what a view can show, in the model's coordinates. `root.transform` maps these to
EPSG:4978 where the model is georeferenced, else it turns the model's up to +Z.
"""

from __future__ import annotations

import fcntl
import glob
import json
import math
import multiprocessing
import os
import secrets
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import GaussianSource
from blitzgs.formats.glb import write_glb
from blitzgs.formats.partition import BITS, Counts, Partition, Parts, extents
from blitzgs.formats.web_page import WebScene, tiles_page
from blitzgs.util.output import sync_to_disk, write_file
from blitzgs.util.progress import Report, follow_parent

TILESET, PAGE = "tileset.json", "index.html"
# Gaussians of a tile: 8 MB at SH degree 3.
TILE = 32_768
_EXTENSION = "KHR_gaussian_splatting"

Array = npt.NDArray[np.float64]


@dataclass
class Tile:
    """A node of the tree.

    Attributes:
        error: size in the model's unit of what is missing where the children are not shown; 0 for leaves.
        entries: entries of `Counts` that the tile holds.
        children: tiles of its eighths.
        part: number of the tile's part; None: the tile holds nothing.
    """

    error: float
    entries: list[npt.NDArray[np.int64]]
    children: list[Tile] = field(default_factory=list)
    part: int | None = None


@dataclass(frozen=True)
class Written:
    """What was written.

    Attributes:
        tiles: number of files.
        bytes: their size.
        gaussians: number of Gaussians in them.
    """

    tiles: int
    bytes: int
    gaussians: int


def write_tiles(
    path: Path,
    source: GaussianSource,
    transform: Array,
    scene: WebScene,
    title: str,
    most: int = TILE,
    processes: int = 1,
    report: Report = lambda done, total: None,
) -> Written:
    """Write a tileset; its folder appears under its name only when it is complete.

    Args:
        path: folder to make; it does not exist or is empty.
        source: at least one Gaussian; read twice, block by block.
        transform: [4, 4], from the model's coordinates to those of the tileset.
        scene: how the page beside the tileset shows it, in the model's coordinates.
        title: heading of the page.
        most: Gaussians of a tile; a tile that would be smaller than a 256th of the region may have more.
        processes: that encode tiles.
        report: called with the number of tiles written, and of all.

    Raises:
        ValueError: there is no Gaussian, or a value is not finite.
        FileExistsError: the folder has files.
        OSError: the disk is full, or `path` cannot be written; nothing is left.
    """
    with new_folder(path) as folder:
        partition = Partition(source, folder)
        counts = partition.count()
        root, parts_of_entries = tree(counts, most)
        parts = partition.place(parts_of_entries, counts.counts)
        (folder / "tiles").mkdir()
        encoded = list(each_part(_encode, parts, folder / "tiles", processes, report=report))
        parts.file.unlink()
        content, _ = _node(root, [(box, count) for box, count, _ in encoded])
        content["transform"] = transform.T.ravel().tolist()
        used = {"extensionsUsed": [_EXTENSION], "extensionsRequired": [_EXTENSION]}
        tileset = {
            "asset": {"version": "1.1", "generator": "BlitzGS"},
            "geometricError": counts.whole_error,
            "root": content,
            # 3D Tiles 1.1 has GLB contents of its own; by this, viewers learn before the first content which
            # glTF extensions they need.
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": used},
            "extras": {
                "gaussians": len(source), "degree": source.degree, "comments": source.comments,
                "view": asdict(scene),
            },
        }  # fmt: skip
        write_file(folder / PAGE, tiles_page(title))
        write_file(folder / TILESET, json.dumps(tileset, allow_nan=False))
    return Written(len(encoded), sum(size for *_, size in encoded), len(source))


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
        with suppress(OSError), _locked(left):
            shutil.rmtree(left)
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    unfinished.mkdir()
    held = ExitStack()
    with suppress(OSError):  # some file systems of networks have no locks
        held.enter_context(_locked(unfinished))
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


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; BlockingIOError: another process has it."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def tree(counts: Counts, most: int) -> tuple[Tile, npt.NDArray[np.int64]]:
    """Make the tree; return its root, and the part of each entry."""
    parts = np.full(len(counts.cells), -1, np.int64)
    number = 0

    def numbered(tile: Tile) -> None:
        nonlocal number
        if tile.entries:
            tile.part, number = number, number + 1
            parts[np.concatenate(tile.entries)] = tile.part
        for child in tile.children:
            numbered(child)

    root = _tile(counts, np.arange(len(counts.cells)), 0, -1, most)
    numbered(root)
    return root, parts


def _tile(counts: Counts, entries: npt.NDArray[np.int64], depth: int, above: int, most: int) -> Tile:
    """Make the tile of a cell of the octree.

    Args:
        counts: of the model.
        entries: those in the cell that no ancestor holds.
        depth: of the cell.
        above: finest level that its ancestors hold.
        most: Gaussians of a tile.
    """
    levels = counts.levels[entries]
    by_level = np.bincount(levels, weights=counts.counts[entries])
    fitting = int((np.cumsum(by_level) <= most).sum())
    if fitting == len(by_level) or depth == BITS:
        return Tile(0.0, [entries])
    # All levels below `fitting`; where not even the coarsest fits, the children share it.
    held = max(above, fitting - 1)
    own, rest = entries[levels <= held], entries[levels > held]
    octants = counts.cells[rest] >> 3 * (BITS - 1 - depth) & 7
    children = [
        _tile(counts, rest[octants == octant], depth + 1, held, most) for octant in np.unique(octants)
    ]
    if len(own) == 0 and len(children) == 1:
        return children[0]
    error = counts.errors[held] if held >= 0 else counts.whole_error
    return Tile(error, [own] if len(own) else [], children)


def each_part(
    work: Any,
    parts: Parts,
    folder: Path,
    processes: int,
    numbers: list[Any] | None = None,
    report: Report = lambda done, total: None,
) -> Iterator[Any]:
    """Yield `work(parts, folder, number)` for all parts in order, computed by several processes."""
    chosen = list(range(len(parts.starts) - 1)) if numbers is None else numbers
    with ExitStack() as stack:
        if processes == 1:
            found: Iterator[Any] = map(partial(work, parts, folder), chosen)
        else:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(processes, context, _prepare)
            stack.callback(pool.shutdown, cancel_futures=True)
            found = pool.map(partial(work, parts, folder), chosen)
        for done, one in enumerate(found, 1):
            report(done, len(chosen))
            yield one


def _prepare() -> None:
    follow_parent()
    torch.set_num_threads(1)


def _encode(parts: Parts, folder: Path, part: int) -> tuple[Array, int, int]:
    """Write the file of a part; return the box of its Gaussians, their number, and the file's size."""
    gaussians = parts.read(part)
    file = folder / f"{part:06d}.glb"
    # glTF's up is +Y and that of 3D Tiles +Z; viewers turn contents between the two.
    write_glb(file, gaussians, up=(0.0, 0.0, 1.0))
    return extents(gaussians), len(gaussians), file.stat().st_size


def _node(tile: Tile, boxes: list[tuple[Array, int]]) -> tuple[dict[str, Any], Array]:
    """Return the JSON of a tile and the box of its contents and those of its descendants."""
    content: dict[str, Any] = {"boundingVolume": {}, "geometricError": tile.error, "refine": "ADD"}
    inside = []
    if tile.part is not None:
        box, count = boxes[tile.part]
        inside.append(box)
        content["content"] = {
            "uri": f"tiles/{tile.part:06d}.glb",
            "boundingVolume": {"box": _box(box)},
            "extras": {"gaussians": count},
        }
    if tile.children:
        nodes = [_node(child, boxes) for child in tile.children]
        content["children"] = [node for node, _ in nodes]
        inside += [box for _, box in nodes]
    every = np.stack(inside)
    box = np.stack([every[:, 0].min(axis=0), every[:, 1].max(axis=0)])
    content["boundingVolume"] = {"box": _box(box)}
    return content, box


def _box(box: Array) -> list[float]:
    """Return the centre and the half axes, as 3D Tiles has boxes; no half axis is 0."""
    half = np.maximum((box[1] - box[0]) / 2, 1e-6)
    return [*box.mean(axis=0).tolist(), *np.diag(half).ravel().tolist()]


def upright(up: tuple[float, float, float]) -> Array:
    """Return the rotation [4, 4] that turns a direction to +Z by the shortest way."""
    x, y, z = np.array(up, np.float64) / math.hypot(*up)
    turned = np.eye(4)
    if z < -1 + 1e-12:
        turned[:3, :3] = np.diag([1.0, -1.0, -1.0])
        return turned
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    turned[:3, :3] += cross + cross @ cross / (1 + z)
    return turned
