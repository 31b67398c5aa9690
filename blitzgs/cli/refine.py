# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs refine`: find lenses and poses of a capture once more."""

from __future__ import annotations

import argparse
import shlex
import time

from blitzgs.cli.arguments import Commands, add_command, add_path
from blitzgs.sfm.refine import refine
from blitzgs.util.terminal import printable

HELP = """\
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


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "refine", run, summary, HELP)
    add_path(parser, "capture", "CAPTURE", "folder of a capture with a COLMAP model")
    add_path(parser, "new", "NEW", "folder to write")


def run(args: argparse.Namespace) -> int:
    """Refine; returns the exit status."""
    begin = time.monotonic()
    print("\n".join(map(printable, refine(args.capture, args.new).lines())))
    print(f"{'time:':15}{(time.monotonic() - begin) / 60:.1f} minutes")
    print(f"next:\n  {printable(f'blitzgs train --data {shlex.quote(str(args.new))} --out RUN')}")
    return 0
