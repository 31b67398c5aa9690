# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs export`: write the model of a run as PLY."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from blitzgs.cli.arguments import Commands, add_command, add_device, add_run, named_path
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import check_replaces_ply
from blitzgs.runs.export import COORDINATES, Exported, export_ply, without_antialiasing
from blitzgs.runs.folder import open_run
from blitzgs.runs.world import in_world, load_frame

HELP = """\
Write the model of a run as a PLY file in INRIA's layout, which most viewers read.

Georeferenced models are written around their own origin, because the file's float32 numbers cannot hold large
coordinates. The offset is in the header (`comment offset X Y Z`) and in FILE.offset.json.

The file of a model trained with view.lod has all its Gaussians, and most viewers show them all. The last
property, `level`, is their octree level. The line
`comment lod reference_distance D fork F levels K finest L` tells a viewer what a view keeps: level l up to
the distance D * F^(1/2 - l), no level above L, and level 0 at any distance.

A model trained with model.antialiased is marked `comment SplatRenderMode: mip`. For a viewer that does not
know the mark, --classic multiplies the opacities by the compensation that antialiasing has at the distance
of the training views; at other distances it is an approximation.
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "export", run, summary, HELP)
    add_run(parser)
    add_device(parser)
    parser.add_argument("--ply", type=named_path, required=True, metavar="FILE", help="file to write")
    parser.add_argument(
        "--coordinates",
        choices=(*COORDINATES, "world"),
        default="auto",
        help="capture: the capture's coordinates; centred: relative to the model's origin; auto: the "
        "capture's if float32 can hold them; world: those of RUN/geo.json (`blitzgs align`), as auto "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--classic",
        action="store_true",
        help="for viewers without antialiasing: write opacities that make up for it",
    )


def run(args: argparse.Namespace) -> int:
    """Export the model of a run; returns the exit status."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("export writes one file from one process: run it without torchrun")
    _check_format(args.ply)
    with Ranks.from_environment(args.device) as ranks:
        folder = open_run(args.folder)
        model = folder.model(ranks.device)
        antialiased = model.config.model.antialiased
        if args.classic and antialiased:
            stored = folder.cameras()
            model = without_antialiasing(model, [stored.cameras[index] for index in stored.train])
        crs, coordinates = "", args.coordinates
        if coordinates == "world":
            frame = load_frame(args.folder)
            if frame is None:
                raise FileNotFoundError(
                    f"{args.folder} has no geo.json, so its place in the world is unknown: use blitzgs align"
                )
            model, crs, coordinates = in_world(model, frame), frame.crs, "auto"
        args.ply.parent.mkdir(parents=True, exist_ok=True)
        exported = export_ply(model, args.ply, coordinates, crs)
    print(f"{args.ply}: {len(model):,} Gaussians, {args.ply.stat().st_size / 1e6:.1f} MB")
    _explain(exported, antialiased, args)
    return 0


def _check_format(path: Path) -> None:
    """Check that no file of another format is replaced, and that the name promises no other format.

    Raises:
        ValueError: the name does not end in .ply.
        FileExistsError: the file is not empty and no PLY.
        OSError: it is no regular file.
    """
    if path.exists() or path.is_symlink():
        check_replaces_ply(path)
    if path.suffix.lower() != ".ply":
        raise ValueError(
            f"{path}: the file will be a PLY, whatever its name: choose a --ply that ends in .ply"
        )


def _explain(exported: Exported, antialiased: bool, args: argparse.Namespace) -> None:
    """Print what a user of the file must know: offset, rounding, antialiasing."""
    if exported.offset is not None:
        x, y, z = exported.offset
        print(f"coordinates are relative to ({x!r}, {y!r}, {z!r}), as {exported.sidecar} says")
    elif args.coordinates == "capture":
        print(f"coordinates are rounded by up to {exported.rounding:.3g}")
    if args.classic and not antialiased:
        print("--classic changes nothing: the model was trained without model.antialiased", file=sys.stderr)
    elif args.classic:
        print("antialiasing is baked into the opacities: right at the training views' distance, else nearly")
    elif antialiased:
        print(
            "the model is antialiased (comment SplatRenderMode: mip): viewers that do not know this show it "
            "too opaque; for those, export with --classic",
            file=sys.stderr,
        )
