# SPDX-License-Identifier: Apache-2.0
"""Reporting that benchmarks share: a Markdown table on stdout with the environment, and JSON on request."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch


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
    return info


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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options every benchmark has."""
    parser.add_argument("--repeats", type=int, default=7, help="timed runs, of which the median counts")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="CPU threads")
    parser.add_argument("--json", type=Path, help="write the rows and the environment to this file")


def report(
    title: str, rows: Sequence[dict[str, Any]], path: Path | None, device: torch.device | str = "cpu"
) -> None:
    """Print the rows under their title and environment, and write them as JSON when a path is given."""
    info = environment(device)
    print(f"## {title}\n\n{', '.join(f'{key} {value}' for key, value in info.items())}\n")
    print(markdown_table(rows) + "\n")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"title": title, "environment": info, "rows": list(rows)}, indent=2) + "\n"
        )
