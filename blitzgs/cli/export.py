# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs export`: write a model as PLY, or as an HTML file with its viewer."""

from __future__ import annotations

import argparse
import math
import os
import sys
from pathlib import Path

from blitzgs.cli.arguments import Commands, add_command, add_device, add_model, named_path
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import check_replaces_ply
from blitzgs.formats.web_page import check_replaces_page
from blitzgs.runs.export import COORDINATES, Exported, export_ply, without_antialiasing
from blitzgs.runs.files import run_and_checkpoint
from blitzgs.runs.folder import open_run
from blitzgs.util.output import write_file

# Default of --max-mb, and the largest file whose text browsers still hold in one piece.
MAX_MB, LARGEST_MB = 50, 500

HELP = """\
Write a model as a PLY file in INRIA's layout, which most viewers read, or as one HTML file to send:

  blitzgs export RUN --ply MODEL.ply
  blitzgs export RUN|CHECKPOINT|FILE.ply --html SCENE.html

The HTML file has the model and a viewer in it; a browser opens it from the disk, without a server. The
model is compressed. Where it would be larger than --max-mb, the SH degree is reduced, then the Gaussians
that contribute least are left out; the page and the output of this command say how many.

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
    add_model(parser)
    add_device(parser)
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--ply", type=named_path, metavar="FILE", help="PLY file to write")
    kind.add_argument("--html", type=named_path, metavar="FILE", help="HTML file to write")
    parser.add_argument(
        "--max-mb",
        type=_megabytes,
        metavar="MB",
        help=f"with --html: largest size of the file in megabytes (default: {MAX_MB})",
    )
    parser.add_argument(
        "--coordinates",
        choices=COORDINATES,
        help="capture: the capture's coordinates; centred: relative to the model's origin; auto: the "
        "capture's if float32 can hold them (default: auto)",
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
    return _export_html(args) if args.html else _export_ply(args)


def _export_html(args: argparse.Namespace) -> int:
    from blitzgs.viewer.studio import open_model
    from blitzgs.viewer.web import web_file

    for flag, given in (("--coordinates", args.coordinates), ("--classic", args.classic)):
        if given:
            raise ValueError(f"{flag} is for --ply; an HTML file needs no such choice")
    path: Path = args.html
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: choose a --html that ends in .html")
    check_replaces_page(path)
    with Ranks.from_environment(args.device) as ranks:
        page = web_file(open_model(args.model, ranks), round(1e6 * (args.max_mb or MAX_MB)))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, page.text)
    size = path.stat().st_size / 1e6
    print(f"{path}: {page.gaussians:,} of {page.of:,} Gaussians, {size:.1f} MB; open it in a browser")
    if page.left_out:
        print(page.left_out)
    return 0


def _export_ply(args: argparse.Namespace) -> int:
    if args.max_mb:
        raise ValueError("--max-mb is for --html; a PLY file has the whole model")
    if args.model.is_file():
        raise ValueError(f"{args.model} is a file: --ply takes the folder of a run, or a checkpoint in it")
    _check_format(args.ply)
    run_folder, checkpoint = run_and_checkpoint(args.model)
    with Ranks.from_environment(args.device) as ranks:
        folder = open_run(run_folder)
        model = folder.model(ranks.device, checkpoint)
        antialiased = model.config.model.antialiased
        if args.classic and antialiased:
            stored = folder.cameras()
            model = without_antialiasing(model, [stored.cameras[index] for index in stored.train])
        args.ply.parent.mkdir(parents=True, exist_ok=True)
        exported = export_ply(model, args.ply, args.coordinates or "auto")
    print(f"{args.ply}: {len(model):,} Gaussians, {args.ply.stat().st_size / 1e6:.1f} MB")
    _explain(exported, antialiased, args)
    return 0


def _megabytes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= LARGEST_MB:
        raise argparse.ArgumentTypeError(f"must be a number of megabytes up to {LARGEST_MB}, got {text}")
    return value


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
