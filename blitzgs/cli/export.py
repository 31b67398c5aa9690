# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs export`: write a model in a format of other programs, or as an HTML file."""

from __future__ import annotations

import argparse
import math
import os
import re
import shlex
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from blitzgs.cli.arguments import DATA, DEVICE, MODEL, Commands, Types, add_arguments, add_command, number
from blitzgs.cli.view import photographs
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import GaussianSource, check_memory, is_antialiased, triple_of
from blitzgs.formats.models import FORMATS, Format, check_replaces, offset_of, open_gaussians, system_of
from blitzgs.formats.selection import Selected, Selection, read_polygon
from blitzgs.formats.web_page import check_replaces_page
from blitzgs.runs.cameras import stored_cameras
from blitzgs.runs.clean import cleaned
from blitzgs.runs.export import (
    COORDINATES,
    Exported,
    export,
    export_file,
    export_folder,
    without_antialiasing,
)
from blitzgs.runs.folder import Model, open_run, subject_of
from blitzgs.runs.run_files import run_and_checkpoint
from blitzgs.runs.source import Watched, open_source, source_of, up_of_run
from blitzgs.runs.world import in_world, load_world_frame
from blitzgs.util.output import write_file
from blitzgs.util.progress import Report, ending_by_exception, image_progress

# Default of --max-mb, and the largest file whose text browsers still hold in one piece.
MAX_MB, LARGEST_MB = 50, 500
# Fewer bytes than a Gaussian of SH degree 0 has in an HTML file: half, so that views decide which go.
_LEAST_BYTES = 10

HELP = """\
Write a model in a format of other programs, or as one HTML file to send:

  blitzgs export RUN --ply MODEL.ply                      INRIA's layout, which most viewers read
  blitzgs export RUN --sog MODEL.sog                      small, for the web
  blitzgs export RUN|CHECKPOINT|FILE --html SCENE.html    the model and a viewer, opened from the disk
  blitzgs export FILE.splat --spz MODEL.spz               a model of another program

The guide's page on formats compares them. --compressed-ply and --spz need packages: pip install
"blitzgs[formats]".

Georeferenced models are written around their own origin, because the files' numbers cannot hold large
coordinates. The offset is in FILE.offset.json and, where there is one, in the header.

A PLY file of a model trained with view.lod has all its Gaussians, and most viewers show them all. The last
property, `level`, and a comment tell a viewer what a view keeps (docs/guide/view-level.md).

A model trained with model.antialiased is marked in formats that can say so (PLY: `comment SplatRenderMode:
mip`). For a viewer that does not know the mark, --classic multiplies the opacities by the compensation that
antialiasing has at the distance of the training views; at other distances it is an approximation.

--clean leaves out Gaussians that at most K training photographs saw and that are far from the rest or large:
floaters, and the fringe of the model. It writes a picture of what went (FILE.clean.jpg), and prints the
held-out PSNR before and after where the photographs are at hand.

An HTML file larger than --max-mb is made smaller: first the SH degree is reduced, then the Gaussians that
contribute least are left out; the page and the output of this command say how many.

A city that no browser holds at once is written as a folder that viewers load piece by piece:

  blitzgs export RUN|CHECKPOINT|FILE --tiles CITY            # 3D Tiles 1.1; then blitzgs view CITY
  blitzgs export RUN|CHECKPOINT|FILE --tiles CITY --spz-tiles  # for CesiumJS
  blitzgs export RUN|CHECKPOINT|FILE --streamed-sog CITY     # for SuperSplat

Memory does not grow with a run or a PLY file; the disk needs two and a half times the size of the model.
See docs/guide/formats.md.
"""
KINDS = "\n".join(f"--{name} FILE  {found.title} file to write" for name, found in FORMATS.items())
KINDS += """
--html FILE  HTML file to write
--tiles DIR  folder to make for 3D Tiles (tileset.json)
--streamed-sog DIR  folder to make for streamed SOG (lod-meta.json)
"""
ARGUMENTS = f"""{MODEL}{DEVICE}{DATA}
--max-mb MB  with --html: largest size of the file in megabytes (default: {MAX_MB})
--classic  for viewers without antialiasing: write opacities that make up for it
--spz-tiles  with --tiles: SPZ inside the tiles, for CesiumJS, and no page
--tile-gaussians N  with --tiles and --streamed-sog: Gaussians of a tile (default: 32768)
--processes N  with --tiles and --streamed-sog: processes that write tiles (default: as many as CPU cores)
--coordinates {"|".join(COORDINATES)}|world  capture: the capture's coordinates; centred: relative to the
    model's origin; auto: the capture's if float32 can hold them; world: those of RUN/geo.json (`blitzgs
    align`), as auto (default: auto)
--clean [K=1]  leave out floaters and fringes that at most K training photographs saw (default: %(const)s)
--sh-degree 0|1|2|3  write at most this SH degree
--crop-axes xy|xz|yz  axes of the polygon's corners (default: xy)
--crop-polygon FILE  keep this region: a GeoJSON polygon, or lines "x y", in the coordinates of --crop
--min-opacity O  keep Gaussians of at least this opacity
--most N  keep the N Gaussians that contribute most to views of the capture (of a file, and in tiles and
    streamed SOG: of the largest opacity times length)
--levels FIRST-LAST  keep these octree levels, for example 0-3
"""
_TILES = "--tiles and --streamed-sog"


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    count = number(int, lambda value: value >= 1, "a whole number from 1 on")
    types: Types = {
        **dict.fromkeys(("--tile-gaussians", "--processes", "--most", "--clean"), count),
        "--max-mb": number(
            float, lambda mb: 0 < mb <= LARGEST_MB, f"a number of megabytes up to {LARGEST_MB}"
        ),
        "--min-opacity": number(float, lambda value: 0 <= value < 1, "from 0 to below 1"),
        "--levels": _levels,
        "--sh-degree": int,
    }
    parser = add_command(commands, "export", run, summary, HELP, ARGUMENTS, types, device="auto")
    add_arguments(parser.add_mutually_exclusive_group(required=True), KINDS)
    parser.add_argument(
        "--crop",
        type=float,
        nargs=6,
        metavar=tuple("xyzXYZ"),
        help="keep this box, in the capture's coordinates (with --coordinates world: the world's)",
    )


def run(args: argparse.Namespace) -> None:
    """Export a model."""
    if args.clean is None:
        _refuse(args, ("data",), "is for --clean, which compares with the photographs")
    with ending_by_exception():
        if args.tiles or args.streamed_sog:
            _export_tiles(args, _selection(args))
            return
        _refuse(args, ("tile_gaussians", "processes", "spz_tiles"), f"is for {_TILES}")
        (_export_html if args.html else _export_file)(args)


def _refuse(args: argparse.Namespace, flags: Iterable[str], reason: str) -> None:
    for flag in flags:
        value = getattr(args, flag)
        if value is not None and value is not False:  # 0 is given
            raise ValueError(f"--{flag.replace('_', '-')} {reason}")


def _export_tiles(args: argparse.Namespace, selection: Selection | None) -> None:
    _refuse(args, ("max_mb", "coordinates", "classic", "clean"), f"is not for {_TILES}")
    if args.streamed_sog:
        _refuse(args, ("spz_tiles",), "is for --tiles")
    from blitzgs.formats.streamed_sog import write_streamed_sog
    from blitzgs.formats.tiles import TILE, Written, write_tiles
    from blitzgs.viewer.web import open_city

    start, city = time.monotonic(), open_city(args.model, checked=selection is None)
    source, path = city.source, args.tiles or args.streamed_sog
    most, processes = args.tile_gaussians or TILE, args.processes or len(os.sched_getaffinity(0))
    x, y, z = city.offset.tolist()
    beside: Path | None = None
    done: list[Written] = []
    with image_progress("Exporting", unit="") as report:

        def write_streamed(folder: Path, found: GaussianSource) -> None:
            done.append(write_streamed_sog(folder, found, most, processes, report))

        source = _chosen(source, report, selection, (x, y, z))
        if args.tiles:
            place = city.transform(), city.scene, city.title
            done.append(write_tiles(path, source, *place, most, processes, report, args.spz_tiles))
        else:
            beside = export_folder(source, (x, y, z), city.extent, write_streamed, path)
    (written,) = done
    print(
        f"{path}: {written.gaussians:,} Gaussians in {written.tiles:,} tiles, {written.bytes / 1e6:.1f} MB, "
        f"{time.monotonic() - start:.0f} s"
    )
    if beside is not None:
        print(f"coordinates are relative to ({x!r}, {y!r}, {z!r}), as {beside} says")
    elif args.tiles and not (city.frame and city.frame.crs) and math.hypot(x, y, z) > 2 * city.extent:
        print(f"the tiles lie around ({x!r}, {y!r}, {z!r}); `blitzgs align RUN --crs` puts them on the globe")
    for line in FORMATS["spz"].told(written.lost):
        print(line, file=sys.stderr)
    if args.tiles and not args.spz_tiles:
        print(f"look at it: blitzgs view {shlex.quote(str(path))}")


def _export_html(args: argparse.Namespace) -> None:
    from blitzgs.viewer.studio import open_model
    from blitzgs.viewer.web import web_file

    flags = (*_CHOICES, "coordinates", "classic", "clean")
    _refuse(args, flags, "is not for --html: an HTML file has its own choice")
    path: Path = args.html
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: choose a --html that ends in .html")
    check_replaces_page(path)
    most = round(1e6 * (args.max_mb or MAX_MB))
    with Ranks.from_environment(args.device) as ranks:
        page = web_file(open_model(args.model, ranks, most=most // _LEAST_BYTES), most)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, page.text)
    size = path.stat().st_size / 1e6
    print(f"{path}: {page.gaussians:,} of {page.of:,} Gaussians, {size:.1f} MB; open it in a browser")
    if page.left_out:
        print(page.left_out)
    elif page.gaussians < page.of:
        print("the other Gaussians are too faint to be seen")


def _export_file(args: argparse.Namespace) -> None:
    _refuse(args, ("max_mb",), "is for --html; --most N limits other files")
    name = next(name for name in FORMATS if getattr(args, name.replace("-", "_")))
    kind, path = FORMATS[name], getattr(args, name.replace("-", "_"))
    check_replaces(path, kind)
    selection = _selection(args)
    path.parent.mkdir(parents=True, exist_ok=True)
    if args.model.is_file():
        flags = ("classic", "clean", "coordinates")
        _refuse(args, flags, f"needs the folder of a run, and {args.model} is a file")
        if path.exists() and path.samefile(args.model):
            raise ValueError(f"{path} is the model itself, which would be lost: choose another name")
        source = open_gaussians(args.model, checked=selection is None)
        crs = system_of(args.model, source)
        with image_progress("Exporting", unit="Gaussians") as report:
            source = _chosen(source, report, selection, offset_of(source.comments))
            written = export_file(source, kind, path, crs)
    else:
        source, written = _export_run(args, kind, path, selection)
    count = len(source) - written.lost.left_out
    print(f"{path}: {count:,} Gaussians, {path.stat().st_size / 1e6:.1f} MB")
    for line in kind.unstated(source) + kind.told(written.lost):
        print(line, file=sys.stderr)
    _explain(written, source, kind, args)


def _export_run(
    args: argparse.Namespace, kind: Format, path: Path, selection: Selection | None
) -> tuple[GaussianSource, Exported]:
    """Write the model of a run; it is read into memory only if it is rendered or turned for that."""
    run_folder, checkpoint = run_and_checkpoint(args.model)
    coordinates = args.coordinates or "auto"
    in_memory = args.classic or args.clean is not None or args.most is not None or coordinates == "world"
    opened = open_source(run_folder, checkpoint)
    if not in_memory:
        with image_progress("Exporting", unit="Gaussians") as report:
            source = _chosen(opened, report, selection, opened.space.offset)
            return source, export(source, opened.space, kind, path, coordinates)
    flags = "--classic, --clean, --most and --coordinates world need the model in memory"
    # The model is read with the optimiser's two moments, and copied.
    check_memory(f"{flags}; {run_folder} holds", len(opened), opened.degree, copies=4)
    from blitzgs.viewer.web import contributions

    kept, score = None, None
    with Ranks.from_environment(args.device) as ranks:
        folder = open_run(run_folder)
        model = folder.model(ranks.device, checkpoint)
        if args.most is not None:
            score = contributions(subject_of(model), stored_cameras(run_folder).cameras, ranks).cpu()
        if args.clean is not None:
            kept = _cleaned(model, run_folder, args, path, ranks)
        if args.classic and not model.config.model.antialiased:
            print(
                "--classic changes nothing: the model was trained without model.antialiased", file=sys.stderr
            )
        elif args.classic:
            print(
                "antialiasing is baked into the opacities: right at the training views' distance, else nearly"
            )
            stored = folder.cameras()
            model = without_antialiasing(model, [stored.cameras[index] for index in stored.train])
        crs, up = None, up_of_run(run_folder, model.space)
        if coordinates == "world":
            frame = load_world_frame(run_folder)
            if frame is None:
                raise FileNotFoundError(
                    f"{run_folder} has no geo.json, so its place in the world is unknown: use blitzgs align"
                )
            model, crs, coordinates = in_world(model, frame), frame.crs, "auto"
            up = None if up is None else frame.rotation @ up
    source = Selected(source_of(model, up), selection or Selection(), model.space.offset, kept, score)
    return source, export(source, model.space, kind, path, coordinates, crs)


def _chosen(
    source: GaussianSource, report: Report, selection: Selection | None, offset: tuple[float, float, float]
) -> GaussianSource:
    """Return what the flags choose of a source, whose reading is reported."""
    watched = Watched(source, report)
    return watched if selection is None else Selected(watched, selection, offset)


def _cleaned(model: Model, folder: Path, args: argparse.Namespace, path: Path, ranks: Ranks) -> torch.Tensor:
    """Tell which Gaussians --clean keeps; write the picture, and print what it costs."""
    cameras = open_run(folder).cameras()
    found = cleaned(model, cameras, args.clean, ranks, photographs(folder, args.data))
    picture = path.with_name(path.name + ".clean.jpg")
    if found.picture is not None:
        write_file(picture, found.picture)
    shown = "" if found.picture is None else f", see {picture}"
    print(f"--clean: {len(model) - int(found.kept.sum()):,} of {len(model):,} Gaussians go{shown}")
    if found.psnr is not None:
        before, after = found.psnr
        print(f"held-out PSNR: {before:.3f} dB before, {after:.3f} dB after")
    return found.kept


# Flags of a `Selection`.
_CHOICES = ("crop", "crop_polygon", "min_opacity", "most", "sh_degree", "levels")


def _selection(args: argparse.Namespace) -> Selection | None:
    """Return what the flags choose; None: everything."""
    if args.crop_axes and not args.crop_polygon:
        raise ValueError("--crop-axes is for --crop-polygon")
    if all(getattr(args, name) is None for name in _CHOICES):
        return None
    box = None if args.crop is None else np.array(args.crop).reshape(2, 3)
    if box is not None and not (box[0] < box[1]).all():
        raise ValueError(f"--crop takes the least x y z, then the largest, got {args.crop}")
    first, second = args.crop_axes or "xy"
    return Selection(
        box=box,
        polygon=None if args.crop_polygon is None else read_polygon(args.crop_polygon),
        axes=("xyz".index(first), "xyz".index(second)),
        min_opacity=args.min_opacity or 0.0,
        levels=args.levels,
        sh_degree=args.sh_degree,
        most=args.most,
    )


def _levels(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})(?:-(\d{1,3}))?", text)
    if match is None or int(match[1]) > int(match[2] or match[1]):
        raise argparse.ArgumentTypeError(f"must be two levels such as 0-3, or one, got {text}")
    return int(match[1]), int(match[2] or match[1])


def _explain(exported: Exported, source: GaussianSource, kind: Format, args: argparse.Namespace) -> None:
    """Print what a user of the file must know: offset, rounding, background, antialiasing."""
    if exported.offset is not None:
        x, y, z = exported.offset
        print(f"coordinates are relative to ({x!r}, {y!r}, {z!r}), as {exported.sidecar} says")
    elif args.coordinates == "capture":
        print(f"coordinates are rounded by up to {exported.rounding:.3g}")
    background = triple_of(source.comments, "background")
    if background is not None and any(background):
        colour = "".join(f"{round(255 * min(max(value, 0), 1)):02x}" for value in background)
        print(f"the model was trained over the background #{colour}: set this colour in viewers")
    if is_antialiased(source) and kind.title.endswith("PLY"):
        print(
            "the model is antialiased (comment SplatRenderMode: mip): viewers that do not know this show it "
            "too opaque; for those, export with --classic",
            file=sys.stderr,
        )
