# SPDX-License-Identifier: Apache-2.0
"""The command line, `blitzgs COMMAND`; one file per command.

A command's file is imported when the command is used: `blitzgs --help` needs no torch.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import cast

from blitzgs import __version__
from blitzgs.cli.arguments import HelpFormatter, Parser, check_given_once, flag_meant
from blitzgs.cli.output import report_lost, surviving_output
from blitzgs.util.errors import UserError, printable

HELP = """\
Train 3D Gaussian Splatting models of photographs: models of a desk, or of a whole city.
These commands lead from photographs to a capture (with cameras), to pictures and a file for viewers:

  blitzgs sfm PHOTOS CAPTURE
  blitzgs train --data CAPTURE --out RUN
  blitzgs view RUN
  blitzgs render RUN --out PICTURES
  blitzgs export RUN --ply MODEL.ply

blitzgs train --help explains the training; blitzgs train --help FIELD explains a field of its configuration.
"""

# For each command the module, with the function that adds it if that is not `add_to`, and what it does.
COMMANDS = {
    "sfm": ("blitzgs.cli.sfm", "find out where photographs were taken from, and write a capture"),
    "refine": ("blitzgs.cli.sfm:add_refine", "find lenses and poses of a capture anew, for sharper models"),
    "train": ("blitzgs.cli.train", "train a model of photographs with known cameras"),
    "eval": ("blitzgs.cli.evaluate", "measure PSNR and SSIM of a run's held-out views"),
    "render": ("blitzgs.cli.render", "render views of a model to pictures, or a path to a film"),
    "view": ("blitzgs.cli.view", "look at a model in the browser"),
    "report": ("blitzgs.cli.report", "write the report of a run"),
    "compare": ("blitzgs.cli.report:add_compare", "put runs side by side"),
    "export": ("blitzgs.cli.export", "write a model as PLY, SOG, SPZ, GLB ..., or as one HTML file to send"),
    "align": ("blitzgs.cli.align", "find out where a model lies in the world: control points, GPS, a CRS"),
    "gate": ("blitzgs.cli.gate", "fit and evaluate spawn gates, which make smaller models"),
    "doctor": ("blitzgs.cli.doctor", "check this installation"),
    "completion": ("blitzgs.cli.completion", "print a script that completes commands in a shell"),
    "synth": ("blitzgs_synth.generate", "make a synthetic city: photographs, cameras and points to train on"),
}
# Commands whose work the processes of torchrun share.
SHARED = ("train", "eval", "render", "gate")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (1: failed, 2: wrong usage, 130: Ctrl-C).

    A terminal or pipe that closes ends no command: what cannot be printed is lost, and the work goes on.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    # Idle OpenMP threads sleep instead of spinning. On a machine with other work, spinning makes every
    # parallel section wait for the scheduler: small training steps became twenty times slower. Torch reads
    # this when it is loaded, which is after this line.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with surviving_output() as outputs:
        try:
            status = _run(given)
        except SystemExit as ending:  # argparse's, after a help or a wrong usage
            if ending.code:
                _tell_other_ranks("wrong usage, which its output explains")
            raise SystemExit(report_lost(given, outputs) or ending.code) from None
        return report_lost(given, outputs) or status


def _run(given: list[str]) -> int:
    chosen = next((text for text in given if not text.startswith("-")), "")
    name = f"blitzgs {chosen}" if chosen in COMMANDS else "blitzgs"
    # Our warnings are about the user's data, so they are shown without the line of code that raised them.
    # Those of libraries may have several lines.
    warnings.formatwarning = lambda message, *_, **__: (
        printable(f"{name}: warning: " + re.sub(r"\s*\n\s*", " ", str(message).strip())) + "\n"
    )
    try:
        with _importing(name):
            parser, _ = parser_of([chosen])
        if not given:
            parser.print_help(sys.stderr)
            return 2
        args = _arguments(parser, chosen, given)
        if "TORCHELASTIC_RUN_ID" in os.environ and _processes() > 1 and chosen not in SHARED:
            raise ValueError("this is the work of one process: run it without torchrun")
        return cast(Callable[[argparse.Namespace], int | None], args.run)(args) or 0
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        _tell_other_ranks(f"{type(error).__name__}: {_message(error)}")
        # Any other error is a fault of the program and keeps its traceback.
        if not isinstance(error, (ValueError, OSError, ImportError, MemoryError, UserError)):
            raise
        # Those of Python's imports and of YAML have lines.
        lines = isinstance(error, ImportError) or type(error).__name__ == "ConfigError"
        text = f"{name}: {printable(_message(error), lines)}"
        try:
            from rich.console import Console

            Console(stderr=True).out(text, style="red", highlight=False)
        except ImportError:
            print(text, file=sys.stderr)
        return 1


def _processes() -> int:
    """Return how many processes torchrun has started for this command."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def _tell_other_ranks(message: str) -> None:
    """Publish why this process fails, if others of a job may wait for it to join them."""
    if _processes() > 1:
        with suppress(Exception):  # the job's store may have ended, and torch may be what failed
            from blitzgs.distributed.watchdog import report_early_failure

            report_early_failure(message)


def _arguments(parser: Parser, chosen: str, given: list[str]) -> argparse.Namespace:
    args, unknown = parser.parse_known_args(given)
    parser_of = getattr(args, "parser", parser)
    if chosen == "train":
        # The configuration says what may have been meant by an unknown field or one without its section.
        given_values = [text for text in unknown if re.match("--.*=", text)]
        fields = [t for t in given_values if "." in t.partition("=")[0] or not flag_meant(parser_of, t)]
        args.overrides = [*args.overrides, *fields]
        unknown = [text for text in unknown if text not in fields]
    if unknown:
        meant = flag_meant(parser_of, unknown[0])
        if chosen == "train" and not args.data and not unknown[0].startswith("-"):
            meant = f"--data {unknown[0]}"
        hint = f"; did you mean {meant}?" if meant else ""
        if chosen == "train" and not meant:
            hint = " (configuration fields are written --section.field=value)"
        parser_of.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    check_given_once(parser_of, given)
    return args


def parser_of(chosen: Container[str]) -> tuple[Parser, dict[str, Parser]]:
    """Return the parser of all commands, and each command's; only the chosen ones' modules are imported."""
    parser = Parser(prog="blitzgs", description=HELP, formatter_class=HelpFormatter)
    parser.add_argument("--version", action="version", version=f"blitzgs {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (place, summary) in COMMANDS.items():
        if name in chosen:
            module, _, function = place.partition(":")
            getattr(import_module(module), function or "add_to")(commands, summary)
        else:
            commands.add_parser(name, help=summary)
    return parser, commands.choices


@contextmanager
def _importing(name: str) -> Iterator[None]:
    """End the process at once on Ctrl-C while modules are imported, which may not be interrupted halfway.

    Modules are no garbage: searching them for it takes a tenth of their imports' time, and 0.1 s later.
    """
    usual = threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, f"{name}: interrupted\n".encode())
        os._exit(130)

    if usual:
        signal.signal(signal.SIGINT, end)
    gc.disable()
    try:
        yield
    finally:
        if gc.get_freeze_count() == 0:  # what is frozen later might be garbage
            gc.freeze()
        gc.enable()
        if usual:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _message(error: BaseException) -> str:
    """Return the error's text; for an error of the operating system, the file and the reason."""
    if isinstance(error, MemoryError) and not str(error):
        return "the memory is not sufficient: use smaller images (--data.downscale) or a larger machine"
    if isinstance(error, ModuleNotFoundError):  # of those that every installation has
        return f"{sys.executable} has no {error.name}: use the Python of the environment that has BlitzGS"
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    if isinstance(error, (FileExistsError, NotADirectoryError)):
        path = Path(str(error.filename))
        file = next((part for part in (path, *path.parents) if part.exists() and not part.is_dir()), path)
        return f"{file} is a file where a folder is needed: choose another name"
    return f"{error.filename}: {error.strerror}"
