# SPDX-License-Identifier: Apache-2.0
"""What benchmarks share: medians by device events, the parts of a training step, and reports.

A report is a Markdown table on stdout, and JSON with command, commit and machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))  # of the helpers that benchmarks share with the tests
WARM_UP = 5  # steps before those that count
BEST_DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def environment(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return what a timing depends on: processor, threads, device and versions."""
    info: dict[str, Any] = {
        "processor": processor_name(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if torch.device(device).type == "cuda":
        info["device"] = torch.cuda.get_device_name(device)
        info["cuda"] = str(torch.version.cuda)
    if (gsplat := sys.modules.get("gsplat")) is not None:
        info["gsplat"] = str(getattr(gsplat, "__version__", "of unknown version"))
    return info


def commit() -> str:
    """Return the commit of the code that runs, with "+changes" when tracked files differ from it.

    A copy of the sources without their repository takes it from the environment variable BLITZGS_COMMIT;
    without that it is "unknown".
    """
    if named := os.environ.get("BLITZGS_COMMIT"):
        return named
    try:
        revision = _git("rev-parse", "--short=10", "HEAD")
        changed = _git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return revision + ("+changes" if changed else "")


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def command_line() -> str:
    """Return the command that started this program, without the interpreter's folder and without --json."""
    words = [os.path.relpath(sys.argv[0], ROOT), *sys.argv[1:]]
    if "--json" in words:
        at = words.index("--json")
        del words[at : at + 2]
    return shlex.join(["python", *words])


def write_json(path: Path | None, device: torch.device | str, **results: Any) -> None:
    """Write the results of a benchmark as JSON, with "command", "commit" and "environment" for `report.py`.

    The folder is made. None: nothing is written. `device`: on which the benchmark ran.
    """
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"command": command_line(), "commit": commit(), "environment": environment(device)}
    path.write_text(json.dumps(about | results, indent=1) + "\n")


def processor_name() -> str:
    """Return the processor's name where the system tells it, else the architecture."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def format_value(value: Any) -> str:
    """Return a table cell: four significant digits for a float, thousands separated for an integer."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    names = list(head)
    first, *others = [f"| {' | '.join(line)} |" for line in (names, *rows)]
    return [first, f"|{'---|' * len(names)}", *others]


def markdown_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows of equal keys as a Markdown table, the keys as its head."""
    return "\n".join(table(rows[0], (map(format_value, row.values()) for row in rows)))


def make_parser(
    description: str | None,
    *,
    device: str | None = BEST_DEVICE,
    repeats: int | None = None,
    writes_json: bool = True,
) -> argparse.ArgumentParser:
    """Return a parser of the options that benchmarks share; --help prints the description as it is written.

    `device`, `repeats`: defaults of --device and --repeats; None: no such option. `writes_json`: whether
    there is --json.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if device is not None:
        parser.add_argument("--device", default=device)
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats, help="timed runs (%(default)s)")
    if writes_json:
        parser.add_argument("--json", type=Path, help="write the results, commit and machine to this file")
    return parser


def positive(text: str) -> int:
    """Read a number of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value


def add_pool_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the commands that train runs side by side (`bm_quality.Pool`)."""
    parser.add_argument("--out", type=Path, required=True, metavar="RESULTS", help="folder of the results")
    gpus = torch.cuda.device_count()
    parser.add_argument(
        "--gpus", type=int, default=gpus, metavar="N", help="to use; 0: the CPU (%(default)s)"
    )
    parser.add_argument("--per-gpu", type=positive, default=1, metavar="N", help="runs on each (%(default)s)")
    parser.add_argument("--lpips", type=Path, metavar="FILE", help="TorchScript module of LPIPS with weights")
    parser.add_argument("--minutes", type=float, metavar="M", help="start no run later than this")


def report(
    title: str, rows: Sequence[dict[str, Any]], path: Path | None, device: torch.device | str = "cpu"
) -> None:
    """Print the rows under their title and environment, and write them as JSON when a path is given."""
    info = environment(device)
    print(f"## {title}\n\n{', '.join(f'{key} {value}' for key, value in info.items())}\n")
    print(markdown_table(rows) + "\n")
    write_json(path, device, title=title, rows=list(rows))


def synchronize(device: torch.device | str) -> None:
    """Wait for the GPU, if the device is one."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def seconds_of(device: torch.device | str, call: Callable[[], object]) -> float:
    """Return the seconds of a call by the host's clock, with the device idle before and after."""
    synchronize(device)
    begin = time.perf_counter()
    call()
    synchronize(device)
    return time.perf_counter() - begin


def child_environment(side_by_side: int) -> dict[str, str]:
    """Return the environment of programs that run side by side: package, commit, and share of the cores."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        "OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // side_by_side)),
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONUNBUFFERED": "1",
        "BLITZGS_COMMIT": commit(),
    }


def torchrun(ranks: int) -> list[str]:
    """Return the arguments of Python that run the script which follows them on so many ranks of this host."""
    return ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]


class Clock:
    """Time between marks, on the device's own clock."""

    def __init__(self, device: torch.device | str = "cuda") -> None:
        self._cuda = torch.device(device).type == "cuda"
        self._marks: list[tuple[str, Any]] = []
        self.mark("")

    def mark(self, stage: str) -> None:
        """End a stage."""
        at: Any = time.perf_counter()
        if self._cuda:
            at = torch.cuda.Event(enable_timing=True)
            at.record()
        self._marks.append((stage, at))

    def stages(self) -> list[tuple[str, float]]:
        """Return name and milliseconds of each stage, in order."""
        if self._cuda:
            torch.cuda.synchronize()
        return [
            (name, begin.elapsed_time(end) if self._cuda else 1000 * (end - begin))
            for (_, begin), (name, end) in zip(self._marks, self._marks[1:], strict=False)
        ]


def stage_medians(
    step: Callable[[Callable[[str], None]], object],
    repeats: int,
    prepare: Callable[[], object] = lambda: None,
    device: torch.device | str = "cuda",
) -> list[tuple[str, float]]:
    """Return name and median milliseconds of each stage, in order, last of the "total" of a step.

    `step` gets a function, to be called with the name of each stage at its end. `prepare` is not timed.
    """
    samples = []
    for _ in range(WARM_UP + repeats):
        prepare()
        clock = Clock(device)
        step(clock.mark)
        stages = clock.stages()
        samples.append([*stages, ("total", sum(ms for _, ms in stages))])
    columns = zip(*samples[WARM_UP:], strict=True)
    return [(column[0][0], statistics.median(ms for _, ms in column)) for column in columns]
