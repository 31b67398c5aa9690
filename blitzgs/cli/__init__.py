# SPDX-License-Identifier: Apache-2.0
"""The command line: `blitzgs train | eval | render | export | gate | synth`, one file per command."""

from __future__ import annotations

import argparse
import difflib
import io
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from blitzgs import __version__
from blitzgs.capture.images import PhotographError
from blitzgs.cli import evaluate, export, gate, render, train
from blitzgs.cli.arguments import add_command
from blitzgs.distributed.group import MismatchError
from blitzgs.runs.checkpoint import CheckpointError
from blitzgs.runs.folder_checks import FolderError
from blitzgs.runs.guard import ModelLostError, NonFiniteError
from blitzgs.table.host_table import HostMemoryError
from blitzgs.table.pool import ResidenceError
from blitzgs.util.printable import printable
from blitzgs_synth import command as synth

HELP = """\
Train 3D Gaussian Splatting models of photographs with known cameras: models of a desk, or of a whole city.
These commands lead from a capture (a COLMAP model and its photographs) to pictures and a file for viewers:

  blitzgs train --data CAPTURE --out RUN
  blitzgs render RUN --out PICTURES
  blitzgs export RUN --ply MODEL.ply
"""

# Errors that a user can cause and correct: they are reported as a message. Any other error is a fault of the
# program and keeps its traceback.
USER_ERRORS = (
    ValueError,
    OSError,
    ImportError,
    CheckpointError,
    FolderError,
    HostMemoryError,
    MismatchError,
    ModelLostError,
    NonFiniteError,
    PhotographError,
    ResidenceError,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (1: failed, 2: wrong usage, 130: Ctrl-C)."""
    # File names may contain bytes that are not UTF-8; print them escaped.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    parser = _parser()
    args, rest = parser.parse_known_args(arguments)
    trains = args.command == "train"
    unknown = [text for text in rest if not (trains and text.startswith("--") and "=" in text)]
    if unknown:
        hint = " (configuration fields are written --section.field=value)" if trains else ""
        if meant := _flag_meant(args.parser, unknown[0]):
            hint = f"; did you mean {meant}?"
        args.parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    args.overrides = rest
    # Our warnings are about the user's data, so they are shown without the line of code that raised them.
    warnings.formatwarning = lambda message, *_, **__: (
        f"blitzgs {args.command}: warning: {printable(str(message))}\n"
    )
    try:
        status: int = args.run(args)
    except USER_ERRORS as error:
        Console(stderr=True, highlight=False, emoji=False).print(
            f"blitzgs {args.command}: {printable(_message(error))}", style="red", markup=False, soft_wrap=True
        )
        return 1
    except KeyboardInterrupt:
        print(f"blitzgs {args.command}: interrupted", file=sys.stderr)
        return 130
    return status


def _flag_meant(parser: argparse.ArgumentParser, text: str) -> str | None:
    """Return the command's flag that an unknown one resembles; None for a field and if no flag is like it."""
    name = text.partition("=")[0]
    flags = re.findall(r"--[\w-]+", parser.format_usage())
    if not name.startswith("--") or "." in name:
        return None
    return next(iter(difflib.get_close_matches(name, flags, n=1, cutoff=0.75)), None)


def _message(error: Exception) -> str:
    """Return the error's text; for an error of the operating system, the file and the reason."""
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    if isinstance(error, (FileExistsError, NotADirectoryError)):
        path = Path(str(error.filename))
        file = next((part for part in (path, *path.parents) if part.exists() and not part.is_dir()), path)
        return f"{file} is a file where a folder is needed: choose another name"
    return f"{error.filename}: {error.strerror}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="blitzgs", description=HELP, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"blitzgs {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in (train, evaluate, render, export, gate):
        command.add_to(commands)
    city = add_command(
        commands, "synth", synth.run, "make a synthetic city: photographs, cameras and points to train on"
    )
    synth.add_arguments(city)
    return parser
