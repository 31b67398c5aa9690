# SPDX-License-Identifier: Apache-2.0
"""What benchmarks share: medians by device events, the parts of a training step, and reports.

A report is a Markdown table on stdout, and JSON with command, commit and machine.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch.profiler import record_function

ROOT = Path(__file__).resolve().parents[1]
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
    if (version := gsplat_version()) is not None:
        info["gsplat"] = version
    return info


def gsplat_version() -> str | None:
    """Return the version of gsplat; None if this process has not imported it."""
    module = sys.modules.get("gsplat")
    if module is None:
        return None
    with contextlib.suppress(
        metadata.PackageNotFoundError
    ):  # sources on PYTHONPATH are in no list of packages
        return metadata.version("gsplat")
    return str(getattr(module, "__version__", "of unknown version"))


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


def write_json(path: Path, device: torch.device | str, **results: Any) -> None:
    """Write the results of a benchmark as JSON, with what `benchmarks/report.py` has to know about them.

    Args:
        path: the file; its folder is made.
        device: on which the benchmark ran.
        results: what was measured, beside the keys "command", "commit" and "environment".
    """
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


def markdown_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows of equal keys as a Markdown table, the keys as its head."""
    head = list(rows[0])
    lines = [head, ["---"] * len(head), *([format_value(row[key]) for key in head] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def make_parser(
    description: str | None, *, device: str | None = BEST_DEVICE, repeats: int | None = None
) -> argparse.ArgumentParser:
    """Return a parser of the options that benchmarks share.

    Args:
        description: the docstring of the benchmark, which --help prints as it is written.
        device: default of --device; None: the benchmark has no such option.
        repeats: default of --repeats; None: the benchmark has no such option.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if device is not None:
        parser.add_argument("--device", default=device)
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats, help="timed runs (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results, commit and machine to this file")
    return parser


def report(
    title: str, rows: Sequence[dict[str, Any]], path: Path | None, device: torch.device | str = "cpu"
) -> None:
    """Print the rows under their title and environment, and write them as JSON when a path is given."""
    info = environment(device)
    print(f"## {title}\n\n{', '.join(f'{key} {value}' for key, value in info.items())}\n")
    print(markdown_table(rows) + "\n")
    if path is not None:
        write_json(path, device, title=title, rows=list(rows))


def median_ms(
    function: Callable[..., Any], inputs: Sequence[tuple[Any, ...]], repeats: int = 30, warm_up: int = 5
) -> float:
    """Return the median milliseconds of ``function(*inputs[i])``, rotating among the input sets.

    The sets together must be larger than the last-level cache; otherwise the cache is measured.
    """
    cuda = any(torch.is_tensor(x) and x.is_cuda for x in _flatten(inputs))
    for i in range(warm_up):
        function(*inputs[i % len(inputs)])
    times = []
    for i in range(repeats):
        arguments = inputs[i % len(inputs)]
        if cuda:
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            # Keeps the device busy while the work is queued, so that there are no gaps between launches.
            torch.cuda._sleep(200_000)
            start.record()
            function(*arguments)
            end.record()
            end.synchronize()
            times.append(start.elapsed_time(end))
        else:
            begin = time.perf_counter()
            function(*arguments)
            times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times)


class Clock:
    """Time between marks on the device."""

    def __init__(self) -> None:
        self.marks: list[tuple[str, torch.cuda.Event]] = []
        self.mark("")

    def mark(self, stage: str) -> None:
        """End a stage."""
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self.marks.append((stage, event))

    def stages(self) -> list[tuple[str, float]]:
        """Return name and time of each stage, in order."""
        torch.cuda.synchronize()
        return [(name, begin.elapsed_time(end))
                for (_, begin), (name, end) in zip(self.marks, self.marks[1:], strict=False)]  # fmt: skip


def _flatten(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in _flatten(item)]
    return [value]


# Names of the calls in which the host waits for CUDA.
_WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize", "cudaMemcpy")


class Parts:
    """The times of named parts of steps.

    Between two parts nothing waits for the device, so a part's device time is what lies between its begin and
    its end on the device: its kernels, and pauses in which the device has nothing to do because the host is
    late. If the host's times of all parts add up to the time of a step, the host limits it.
    """

    def __init__(self, device: torch.device) -> None:
        """Time parts on a device."""
        self._cuda = device.type == "cuda"
        self._host: dict[str, float] = defaultdict(float)
        self._events: list[tuple[str, Any, Any]] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the time of the block to the part `name`."""
        begin = self._mark()
        start = time.perf_counter()
        yield
        self._host[name] += time.perf_counter() - start
        self._events.append((name, begin, self._mark()))

    def rows(self, steps: int) -> list[dict[str, Any]]:
        """Return the times of each part per step, in milliseconds."""
        device: dict[str, float] = defaultdict(float)
        if self._cuda:
            torch.cuda.synchronize()
            for name, begin, end in self._events:
                device[name] += begin.elapsed_time(end)
        rows = [
            {"part": name, "host, ms": spent / steps * 1e3, "device, ms": device[name] / steps}
            for name, spent in self._host.items()
        ]
        total = {key: sum(row[key] for row in rows) for key in ("host, ms", "device, ms")}
        return [*rows, {"part": "all", **total}]

    def _mark(self) -> Any:
        if not self._cuda:
            return None
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


class TracedParts:
    """Marks named parts of steps, so that `trace` counts the work of each.

    Attributes:
        names: of the parts, in the order in which they began.
    """

    def __init__(self) -> None:
        """Begin without parts."""
        self.names: dict[str, None] = {}

    def __call__(self, name: str) -> record_function:
        """Return the context of a part."""
        self.names[name] = None
        return record_function(name)


def trace(
    run: Callable[[], object], steps: int, device: torch.device, parts: TracedParts | None = None
) -> tuple[list[dict[str, Any]], float, str]:
    """Run some steps under torch's profiler.

    Args:
        run: takes the steps.
        steps: their number.
        device: the device they run on.
        parts: marks the parts of the steps.

    Returns:
        Per step, for each part and at the end for all: number of torch ops (those called by other ops
        included), launches of kernels, waits of the host; the kernels' time in a step, in milliseconds; and a
        table of the kernels, or on the CPU the ops, that take most time.
    """
    cuda = device.type == "cuda"
    activities = [torch.profiler.ProfilerActivity.CPU]
    if cuda:
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profile:
        run()
        if cuda:
            torch.cuda.synchronize()
    found, names = profile.key_averages(), {} if parts is None else parts.names
    on_host = [e for e in profile.events() if e.device_type == torch.autograd.DeviceType.CPU]
    spans = {name: [e.time_range for e in on_host if e.name == name] for name in names}
    rows = [
        {"part": name, **_counts([e for e in on_host if any(_within(e.time_range, s) for s in own)], steps)}
        for name, own in spans.items()
    ]
    # The device has events for the parts too, whose time is that of their kernels.
    kernels = [e for e in found if e.device_type == torch.autograd.DeviceType.CUDA and e.key not in names]
    kernel_ms = sum(e.self_device_time_total for e in kernels) / 1e3 / steps
    rows.append({"part": "all", **_counts(on_host, steps)})
    sort_by = "self_device_time_total" if cuda else "self_cpu_time_total"
    table = found.table(sort_by=sort_by, row_limit=40, max_name_column_width=70)
    return rows, kernel_ms, table


def _counts(events: Sequence[Any], steps: int) -> dict[str, float]:
    """Return per step how many events of the host are torch ops, launches and waits."""
    names = [event.name for event in events]
    return {
        "torch ops": sum("::" in name for name in names) / steps,
        "launches": sum("Launch" in name for name in names) / steps,
        "waits": sum(name in _WAITS for name in names) / steps,
    }


def _within(span: Any, whole: Any) -> bool:
    return bool(whole.start <= span.start and span.end <= whole.end)
