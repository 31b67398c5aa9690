# SPDX-License-Identifier: Apache-2.0
"""The commands `blitzgs sfm` and `blitzgs refine`: find out where photographs were taken from."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from pathlib import Path

from blitzgs.capture.colmap import camera_models, find_models
from blitzgs.capture.transforms import find_transforms
from blitzgs.cli.arguments import Commands, add_command, add_path
from blitzgs.config.fields import Config
from blitzgs.config.files import changed
from blitzgs.runs.run_files import CONFIG
from blitzgs.sfm.photographs import Photographs, estimate, has_photographs_alone, photograph_folder
from blitzgs.sfm.reconstruct import MAPPERS, PAIRS, WORK, Settings, is_finished, reconstruct
from blitzgs.sfm.refine import refine
from blitzgs.util.errors import UserError, printable

HELP = """\
Find out where photographs were taken from, and write a capture that blitzgs train --data reads.

  blitzgs sfm PHOTOS CAPTURE

PHOTOS is a folder of overlapping photographs, also with subfolders; of a folder with images/ it is that.
Masks in masks/ (black: not used) keep features away from what moves. COLMAP does the work: pycolmap (pip
install 'blitzgs[sfm]') or the program colmap, on a GPU if it is built for one.

Photographs of one camera (by EXIF, else by size and folder) share its lens. With GPS in 9 of 10 photographs,
each is matched with its 50 nearest and the model is in metres east, north and up (CAPTURE/geo.json);
altitudes that are missing, equal or contradictory are left out. Without GPS all pairs are matched, or, of
more than 300 photographs, neighbours by name. More than 500 photographs are placed by the global mapper.

An interrupted command goes on when it is repeated, and later photographs are added. CAPTURE gets sparse/0, a
link to the photographs, and sfm/: cameras.png (a plan of the cameras), report.json (errors in pixels,
photographs without a pose and why), and COLMAP's database and messages.
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "sfm", run, summary, HELP)
    add_path(parser, "photos", "PHOTOS", "folder of the photographs")
    add_path(parser, "capture", "CAPTURE", "folder to write")
    parser.add_argument(
        "--pairs", choices=PAIRS, default="auto", help="which photographs are compared (default: see above)"
    )
    parser.add_argument(
        "--mapper", choices=MAPPERS, default="auto", help="how poses are found (default: see above)"
    )
    parser.add_argument(
        "--camera-model",
        choices=("auto", *(name for name in camera_models() if name != "EQUIRECTANGULAR")),
        default="auto",
        metavar="MODEL",
        help="COLMAP's name of the lens, such as OPENCV_FISHEYE (default: OPENCV for a camera of 15 or more "
        "photographs, else SIMPLE_RADIAL)",
    )


def run(args: argparse.Namespace) -> None:
    """Reconstruct."""
    find_poses(
        photograph_folder(args.photos), args.capture, Settings(args.pairs, args.mapper, args.camera_model)
    )
    _print_next(args.capture)


def find_poses(folder: Path, capture: Path, settings: Settings) -> None:
    """Reconstruct, and print what will be done and what was found."""
    photographs = Photographs.of(folder)
    count = len(photographs.names)
    for name, problem in photographs.damage.items():
        print(printable(f"{name} is left out: {problem}"), file=sys.stderr)
    print(f"poses of {count:,} photographs: about {estimate(photographs.sizes)}", file=sys.stderr, flush=True)
    begin = time.monotonic()
    found = reconstruct(photographs, capture, settings)
    _print_found([*found.lines(), f"{'picture:':15}{capture / WORK / 'cameras.png'}"], begin)


def with_poses(config: Config, folder: Path) -> Config:
    """Return a configuration whose capture has poses: of photographs alone they are found first.

    They go into `folder`, which is used as it is if it is finished. Under torchrun rank 0 finds them and the
    others, which have not joined yet, wait for its report (UserError: a rank has failed meanwhile).
    """
    photographs = _photographs_alone(config)
    if photographs is None:
        return config
    first = os.environ.get("RANK", "0") == "0"
    if is_finished(folder):
        if first:
            print(f"poses: those of {folder}, found before (blitzgs sfm adds photographs)", file=sys.stderr)
    elif first:
        print(
            f"{config.data.path} has photographs without poses: they are found first, into {folder}",
            file=sys.stderr,
        )
        find_poses(photographs, folder, Settings())
    while not is_finished(folder):
        from blitzgs.distributed.watchdog import early_failure

        if failure := early_failure():
            raise UserError(f"there are no poses, because {failure}")
        time.sleep(1.0)
    return changed(config, "data", path=os.path.realpath(folder), images="images")


def understood_alone(config: Config) -> str | None:
    """Return what a training would do first with photographs that have no poses; None: they have."""
    folder = _photographs_alone(config)
    if folder is None:
        return None
    photographs = Photographs.of(folder)
    return (
        f"{len(photographs.names):,} photographs without poses: a training finds them first, in about "
        f"{estimate(photographs.sizes)}; then this command says more (blitzgs sfm finds poses alone)"
    )


def _photographs_alone(config: Config) -> Path | None:
    """Return the folder of photographs that have no poses; None: they have.

    FileNotFoundError: the folder is a run or a part of a capture, whose pictures need no poses.
    """
    root = Path(config.data.path)
    if not config.data.path or not has_photographs_alone(root, config.data.images):
        return None
    if (root / CONFIG).is_file():
        raise FileNotFoundError(
            f"{root} is a run and no capture: name the capture that its {CONFIG} has as data.path"
        )
    if find_models(root.parent) or find_transforms(root.parent):
        raise FileNotFoundError(
            f"{root} lies in a capture that has its cameras: --data={shlex.quote(str(root.parent))} (or find "
            "others with blitzgs sfm)"
        )
    return photograph_folder(root, config.data.images)


REFINE_HELP = """\
Find lenses, poses and points of a capture once more, and write a capture that blitzgs train --data reads.

  blitzgs refine CAPTURE NEW

Many captures were posed with a lens that is nearly right: its axis in the middle of the picture, or a
distortion that was taken out by another program. Their models are blurred by what the lens misses. This
command lets COLMAP (pycolmap: pip install 'blitzgs[sfm]') find the axis and the distortion too, from the
pixels at which the photographs saw their points; it needs a COLMAP model that has these.

NEW gets sparse/0, links to all else of CAPTURE, and sfm/refined.json. Its world stays that of CAPTURE. A lens
is refined if 15 photographs or more have it, and gets distortion if that takes another tenth of the error.
Where the median miss falls by less than a tenth, NEW has the model of CAPTURE.
"""


def add_refine(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "refine", run_refine, summary, REFINE_HELP)
    add_path(parser, "capture", "CAPTURE", "folder of a capture with a COLMAP model")
    add_path(parser, "new", "NEW", "folder to write")


def run_refine(args: argparse.Namespace) -> None:
    """Refine."""
    begin = time.monotonic()
    _print_found(refine(args.capture, args.new).lines(), begin)
    _print_next(args.new)


def _print_found(lines: list[str], begin: float) -> None:
    print(
        "\n".join(map(printable, [*lines, f"{'time:':15}{(time.monotonic() - begin) / 60:.1f} minutes"])),
        flush=True,
    )


def _print_next(capture: Path) -> None:
    print(f"next:\n  {printable(f'blitzgs train --data {shlex.quote(str(capture))} --out RUN')}")
