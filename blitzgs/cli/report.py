# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs report`: write the report of a run."""

from __future__ import annotations

import argparse
import sys

from blitzgs.cli.arguments import Commands, add_command, add_run, named_path
from blitzgs.runs.files import check_is_run
from blitzgs.util.terminal import printable

HELP = """\
Write the report of a run as one HTML file that needs no network: metrics of each held-out view, best and
worst views beside their photographs, curves, the model in 3D, stages of time, a plan of the cameras,
exposures, warnings, and the configuration. blitzgs train writes it at its end; this command writes it again,
for example after blitzgs eval.
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "report", run, summary, HELP)
    add_run(parser)
    parser.add_argument("--out", type=named_path, metavar="FILE", help="the file (default: RUN/report.html)")


def run(args: argparse.Namespace) -> int:
    """Write the report; returns the exit status."""
    from blitzgs.report.look import look_of
    from blitzgs.report.report import write_report

    look = None
    try:
        look = look_of(args.folder)
    except (OSError, ValueError, RuntimeError) as error:
        check_is_run(args.folder)
        print(printable(f"the report goes without the model in 3D: {error}"), file=sys.stderr)
    print(printable(str(write_report(args.folder, look, args.out))))
    return 0
