# SPDX-License-Identifier: Apache-2.0
"""The `blitzgs synth` command."""

from __future__ import annotations

import argparse
import time
from dataclasses import fields
from pathlib import Path

from blitzgs.util.progress import image_progress
from blitzgs_synth.generate import generate_city
from blitzgs_synth.options import PRESETS, CityOptions

_HELP = {
    "extent": "edge of the built-up square, metres",
    "views": "number of images",
    "width": "image width, pixels",
    "height": "image height, pixels",
    "points_per_view": "number of feature points to search for in each image",
    "oblique": "fraction of oblique views, 0 to 1",
    "seed": "seed of all random choices",
    "built": "a city; --no-built: flat farmland",
    "grain": "noise of the photographs, in steps of 8-bit values",
    "exposure": "standard deviation of the logarithm of the photographs' gains",
    "altitudes": "number of heights flown at, 1 to 8",
}


def _sizes() -> str:
    return "; ".join(
        f"{name}, {city.views:,} views of {city.width} x {city.height}" for name, city in PRESETS.items()
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `blitzgs synth` to a parser."""
    parser.add_argument(
        "out",
        type=Path,
        metavar="DIR",
        help="folder to create; if it has a part of the same city, only the rest is made",
    )
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        default="demo",
        help=f"city that the other flags change (default: %(default)s): {_sizes()}",
    )
    for field in fields(CityOptions):
        flag = f"--{field.name.replace('_', '-')}"
        if isinstance(field.default, bool):
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, help=_HELP[field.name])
            continue
        parser.add_argument(
            flag,
            type=type(field.default),
            metavar="N" if isinstance(field.default, int) else "X",
            help=_HELP[field.name],
        )
    parser.add_argument(
        "--processes", type=int, metavar="N", help="number of processes (default: one for each core)"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace another generated city in this folder"
    )


def run(args: argparse.Namespace) -> int:
    """Generate the city; returns the exit status. Raises what `generate_city` raises."""
    preset = PRESETS[args.preset]
    chosen = {}
    for field in fields(CityOptions):
        value = getattr(args, field.name)
        chosen[field.name] = getattr(preset, field.name) if value is None else value
    started = time.monotonic()
    with image_progress("Photographing the city") as progress:
        out = generate_city(
            args.out,
            **chosen,
            processes=args.processes,
            overwrite=args.overwrite,
            progress=progress,
        )
    size = f"{chosen['views']} images of {chosen['width']} x {chosen['height']}"
    print(f"{out}: {size}, {time.monotonic() - started:.1f} s")
    return 0
