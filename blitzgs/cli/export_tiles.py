# SPDX-License-Identifier: Apache-2.0
"""The flags of `blitzgs export` that write a model as tiles."""

from __future__ import annotations

import argparse
import os
import time
from typing import TYPE_CHECKING

from blitzgs.cli.arguments import named_path, number
from blitzgs.formats.selection import Selected, Selection

if TYPE_CHECKING:
    from argparse import _MutuallyExclusiveGroup

HELP = """\
A city that no browser holds at once is written as a folder that viewers load piece by piece:

  blitzgs export RUN|CHECKPOINT|FILE.ply --tiles CITY       # 3D Tiles 1.1; then blitzgs view CITY
  blitzgs export RUN|CHECKPOINT|FILE.ply --streamed-sog CITY  # for SuperSplat

Memory does not grow with the model; the disk needs twice the size of the model. See docs/guide/tiles.md.
"""
_FLAGS = ("tile_gaussians", "processes")
_POSITIVE = number(int, lambda value: value >= 1, "a whole number from 1 on")


def add_kinds(kind: _MutuallyExclusiveGroup) -> None:
    """Add the flags that choose what is written."""
    kind.add_argument(
        "--tiles", type=named_path, metavar="DIR", help="folder to make for 3D Tiles (tileset.json)"
    )
    kind.add_argument(
        "--streamed-sog",
        type=named_path,
        metavar="DIR",
        help="folder to make for streamed SOG (lod-meta.json)",
    )


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of both."""
    parser.add_argument(
        "--tile-gaussians",
        type=_POSITIVE,
        metavar="N",
        help="with --tiles and --streamed-sog: Gaussians of a tile (default: 32768)",
    )
    parser.add_argument(
        "--processes",
        type=_POSITIVE,
        metavar="N",
        help="with --tiles and --streamed-sog: processes that write tiles (default: as many as CPU cores)",
    )


def check_flags(args: argparse.Namespace) -> None:
    """Raise ValueError if a flag of the tiles is given for another kind of file."""
    for name in _FLAGS:
        if getattr(args, name) is not None and not is_tiles(args):
            raise ValueError(f"--{name.replace('_', '-')} is for --tiles and --streamed-sog")


def is_tiles(args: argparse.Namespace) -> bool:
    """Tell whether tiles are asked for."""
    return bool(args.tiles or args.streamed_sog)


def export_tiles(args: argparse.Namespace, selection: Selection | None) -> int:
    """Write the Gaussians that meet a selection as tiles; returns the exit status."""
    for flag in ("max_mb", "coordinates", "classic", "clean"):
        if getattr(args, flag):
            raise ValueError(f"--{flag.replace('_', '-')} is not for --tiles and --streamed-sog")
    from blitzgs.formats.streamed_sog import write_streamed_sog
    from blitzgs.formats.tiles import TILE, write_tiles
    from blitzgs.viewer.tileset import open_city

    start, city = time.monotonic(), open_city(args.model)
    source = (
        city.source if selection is None else Selected(city.source, selection, tuple(city.offset.tolist()))
    )
    processes = args.processes or len(os.sched_getaffinity(0))
    most = args.tile_gaussians or TILE
    if args.tiles:
        path = args.tiles
        written = write_tiles(
            path, source, city.transform(), city.scene, city.title, most=most, processes=processes
        )
    else:
        path = args.streamed_sog
        written = write_streamed_sog(path, source, most=most, processes=processes)
    seconds = time.monotonic() - start
    print(
        f"{path}: {written.gaussians:,} Gaussians in {written.tiles:,} tiles, {written.bytes / 1e6:.1f} MB, "
        f"{seconds:.0f} s"
    )
    if args.tiles:
        print(f"look at it: blitzgs view {path}")
    return 0
