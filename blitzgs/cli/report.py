# SPDX-License-Identifier: Apache-2.0
"""The commands `blitzgs report` and `compare`: pages about a run, or about several."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from blitzgs.cli.arguments import RUN, Commands, add_command
from blitzgs.runs import run_files
from blitzgs.util.errors import printable, warn

HELP = """\
Write the report of a run as one HTML file that needs no network: metrics of each held-out view, best and
worst views beside their photographs, curves, the model in 3D, stages of time, a plan of the cameras,
exposures, warnings, and the configuration. blitzgs train writes it at its end; this command writes it again,
for example after blitzgs eval.
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    text = f"{RUN}--out FILE  the file (default: RUN/report.html)"
    add_command(commands, "report", run, summary, HELP, text)


def run(args: argparse.Namespace) -> None:
    """Write the report."""
    from blitzgs.report.report import look_of, write_report

    look = None
    try:
        look = look_of(args.folder)
    except (OSError, ValueError, RuntimeError) as error:
        run_files.check_is_run(args.folder)
        print(printable(f"the report goes without the model in 3D: {error}"), file=sys.stderr)
    print(printable(str(write_report(args.folder, look, args.out))))


# The model in 3D is read from the checkpoint, beside the model in memory: only up to so many Gaussians.
_MAX_GAUSSIANS = 4_000_000


def write_final_report(folder: Path, summary: Mapping[str, object] | None) -> bool:
    """Write the report of a run that ends, and tell whether it is there; a failure is a warning."""
    from blitzgs.report.report import look_of, write_report

    count = 0 if summary is None else summary["gaussians"]
    try:
        look = look_of(folder) if isinstance(count, int) and 0 < count <= _MAX_GAUSSIANS else None
        write_report(folder, look)
    except Exception as error:
        warn(f"the report was not written ({type(error).__name__}: {error}); blitzgs report RUN tries again")
        return False
    return True


COMPARE_HELP = """\
Put runs side by side in one HTML file that needs no network: their figures, differences of configuration,
metrics of each view, curves, and pictures of the same views. The others are compared with the first run.
"""


def add_compare(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    text = "folders RUN...  folders of two runs or more\n--out FILE  the file (default: %(default)s)"
    add_command(commands, "compare", run_compare, summary, COMPARE_HELP, text, out=Path("compare.html"))


def run_compare(args: argparse.Namespace) -> None:
    """Write the page."""
    from blitzgs.report.report import compare, write_page

    write_page(args.out, compare(args.folders))
    print(printable(str(args.out)))
