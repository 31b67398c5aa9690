# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs report`: write the report of a run."""

from __future__ import annotations

import argparse

from blitzgs.cli.arguments import Commands, add_command, add_run, named_path

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
    from blitzgs.report.report import write_report

    print(write_report(args.folder, out=args.out))
    return 0
