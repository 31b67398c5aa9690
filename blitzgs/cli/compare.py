# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs compare`: put runs side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from blitzgs.cli.arguments import Commands, add_command, named_path
from blitzgs.util.terminal import printable

HELP = """\
Put runs side by side in one HTML file that needs no network: their figures, differences of configuration,
metrics of each view, curves, and pictures of the same views. The others are compared with the first run.
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "compare", run, summary, HELP)
    parser.add_argument(
        "folders", nargs="+", type=named_path, metavar="RUN", help="folders of two runs or more"
    )
    parser.add_argument(
        "--out",
        type=named_path,
        metavar="FILE",
        default=Path("compare.html"),
        help="the file (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Write the page; returns the exit status."""
    from blitzgs.report.compare import compare
    from blitzgs.report.page import write_page

    write_page(args.out, compare(args.folders))
    print(printable(str(args.out)))
    return 0
