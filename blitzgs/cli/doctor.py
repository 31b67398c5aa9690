# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs doctor`: does this installation work, and what is missing.

It works without torch and with libraries that do not load: what may fail runs in processes of its own
(blitzgs/cli/doctor_probes.py), which are ended when they take too long.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from blitzgs import __version__
from blitzgs.cli.arguments import Commands, add_command
from blitzgs.cli.doctor_probes import REINSTALL, REPORT, found
from blitzgs.util.memory import available_bytes, host_bytes

HELP = """\
Check this installation: torch, the GPUs, the libraries, optional packages, and small renderings that are
compared with a float64 reference, on the CPU and on each GPU backend. Each line is

  ok        it works
  warning   it works, but not well or not everywhere
  missing   it is not there; an optional package is needed for some commands only
  failed    it is there and does not work

and says what mends it. The exit status is 1 if something that BlitzGS cannot do without is missing or failed.
Put the output of --json into reports of faults.
"""

ARGUMENTS = """
--json  print the report as JSON
--folder DIR  measure the disk of this folder too, with a file of 64 MB that is removed
"""
_PACKAGE = Path(__file__).resolve().parents[1]
TIMEOUT = 120.0  # seconds of each test
_LITTLE_MEMORY = 4 << 30
_NOT_FOR_USERS = ("test", "lint", "docs", "all")
_LOCAL = "allow connections to 127.0.0.1; until then train with one process"
_NCCL = "NCCL_DEBUG=WARN blitzgs doctor"


@dataclass
class Line:
    """A line of the report."""

    name: str  # what was looked at
    state: str  # "ok", "warning", "missing" or "failed", see `HELP`
    text: str  # what was found
    remedy: str = ""  # what mends it; "": nothing has to be mended
    required: bool = True  # BlitzGS cannot do without it
    values: dict[str, Any] = field(default_factory=dict)  # figures for programs


class ProbeError(Exception):
    """A probe failed or took too long; the message says how."""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    add_command(commands, "doctor", run, summary, HELP, ARGUMENTS)


def run(args: argparse.Namespace) -> int:
    """Print the report; returns 1 if something required is missing or failed, else 0."""
    lines = examine(args.folder)
    broken = [line for line in lines if line.required and line.state in ("missing", "failed")]
    if args.json:
        print(json.dumps({"ok": not broken, "lines": [asdict(line) for line in lines]}, indent=1))
    else:
        for line in lines:
            print(f"{line.state:8} {line.name:12} {line.text}")
            if line.remedy:
                print(f"{'':21} -> {line.remedy}")
        print(f"\n{len(broken)} faults" if broken else "\nBlitzGS works here.")
    return 1 if broken else 0


def examine(folder: Path | None = None) -> list[Line]:
    """Return the lines of the report."""
    lines = [Line("blitzgs", "ok", f"{__version__} in {_PACKAGE}"), _system(), _memory(), *_packages()]
    torch_line = _torch()
    gpus = torch_line.values.get("gpus", [])
    driver = _looked("driver", "restart the machine, or install the driver again", False, _driver)
    lines += [torch_line, driver]
    lines += [*(_gpu(number, gpu) for number, gpu in enumerate(gpus)), _looked("nvcc", "", False, _nvcc)]
    works = torch_line.state in ("ok", "warning")
    # Each with what mends a look that fails, whether it is required, the look and its arguments.
    checks: list[tuple[Any, ...]] = [("lib io", REINSTALL, True, probe, "library", "io")]
    if works:
        architectures = [gpu["architecture"] for gpu in gpus]
        for name in ("cpu", "cuda") if gpus else ("cpu",):
            checks.append((f"lib {name}", REINSTALL, True, probe, "library", name, *architectures))
            checks.append((f"render {name}", REINSTALL, True, probe, "render", name))
        checks.append(("exchange Gloo", _LOCAL, False, _exchange, "cpu"))
        if len(gpus) > 1:
            checks.append(("exchange NCCL", _LOCAL, False, _exchange, "cuda"))
        elif gpus:
            checks.append(("exchange NCCL", _NCCL, False, probe, "nccl", _free_port()))
    if folder is not None:
        checks.append(("disk", "choose a folder that can be written", False, probe, "disk", str(folder)))
    with ThreadPoolExecutor(2) as pool:
        lines += pool.map(lambda check: _looked(*check), checks)
    if not works:
        lines.append(Line("self-tests", "failed", "not run without torch", torch_line.remedy))
    return lines


def _looked(
    name: str, remedy: str, required: bool, look: Callable[..., dict[str, Any]], *arguments: str
) -> Line:
    """Return the line of what a look finds; a look that fails is a line too."""
    try:
        return Line(name, required=required, **look(*arguments))
    except ProbeError as error:
        return Line(name, "failed", str(error), remedy, required)


def probe(name: str, *arguments: str) -> dict[str, Any]:
    """Run a probe in a process of its own and return what it found; raises ProbeError as `run_command`."""
    command = [sys.executable, "-m", "blitzgs.cli.doctor_probes", name, *arguments]
    output = run_command(command)
    try:
        return dict(json.loads(output.splitlines()[-1]))
    except (IndexError, ValueError) as error:
        raise ProbeError(f"printed no result: {output[-200:]!r}") from error


def run_command(command: Sequence[str]) -> str:
    """Run a command and return its standard output.

    ProbeError: it cannot be started, failed, was killed or took longer than `TIMEOUT`.
    """
    path = os.pathsep.join(filter(None, [str(_PACKAGE.parent), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path}
    try:
        how: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace"}
        done = subprocess.run(command, env=environment, timeout=TIMEOUT, **how)
    except OSError as error:
        raise ProbeError(f"{command[0]}: {error.strerror}") from error
    except subprocess.TimeoutExpired:
        raise ProbeError(f"no answer within {TIMEOUT:g} s") from None
    last = done.stderr.strip().rpartition("\n")[2].strip()[:300]
    if done.returncode < 0:
        raise ProbeError(f"ended by {signal.Signals(-done.returncode).name}: {last}")
    if done.returncode:
        raise ProbeError(last or f"exit status {done.returncode}")
    return done.stdout


def _system() -> Line:
    cores = len(os.sched_getaffinity(0))
    versions = f"Python {platform.python_version()}, {' '.join(platform.libc_ver())}"
    text = f"{versions}, Linux {platform.release()}, {cores} of {os.cpu_count()} cores"
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return Line("system", "failed", f"{text}, {platform.machine()}", "BlitzGS runs on Linux x86-64")
    return Line("system", "ok", text, values={"cores": cores})


def _memory() -> Line:
    total, free = host_bytes(), available_bytes()
    text = f"{free / 1e9:.1f} of {total / 1e9:.1f} GB free"
    little = free < _LITTLE_MEMORY
    remedy = "end other programs, or train with --data.downscale=2" if little else ""
    return Line("memory", "warning" if little else "ok", text, remedy, False, {"bytes": total, "free": free})


def _packages() -> list[Line]:
    """Return a line for each package that BlitzGS needs (but torch), and for each of the extras."""
    if not (wanted := _requirements()):
        return [Line("packages", "warning", "blitzgs is not installed as a package", "pip install .", False)]
    lines = []
    for requirement in wanted:
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"](\w+)", requirement)
        if not name or name[0] in ("torch", "blitzgs") or (extra and extra[1] in _NOT_FOR_USERS):
            continue
        what = f"blitzgs[{extra[1]}]" if extra else "needed"
        try:
            lines.append(Line(name[0], "ok", f"{metadata.version(name[0])} ({what})", "", not extra))
        except metadata.PackageNotFoundError:
            remedy = f"pip install '{what if extra else name[0]}'"
            lines.append(Line(name[0], "missing", f"({what})", remedy, not extra))
    return lines


def _requirements() -> list[str]:
    """Return what the installed package requires; empty: there is none."""
    try:
        return metadata.requires("blitzgs") or []
    except metadata.PackageNotFoundError:
        return []


def _version(text: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", text.partition("+")[0])[:2]))


def _torch() -> Line:
    # The installed package may state the lowest version that works, and the first that is not tested.
    wanted = next((text for text in _requirements() if re.match(r"torch\b", text)), "torch")
    bounds, install = dict(re.findall(r"(>=|<)\s*([\d.]+)", wanted)), f"pip install '{wanted}'"
    try:
        found = probe("torch_")
    except ProbeError as error:
        missing = "No module named 'torch'" in str(error)
        return Line("torch", "missing" if missing else "failed", str(error), install)
    version = _version(found["version"])
    cuda = f"CUDA {found['cuda']}" if found["cuda"] else "for CPUs only"
    nccl = f", NCCL {found['nccl']}" if found["nccl"] else ""
    line = Line("torch", "ok", f"{found['version']}, {cuda}{nccl}, {found['threads']} threads", values=found)
    if version < _version(bounds.get(">=", "0")):
        return replace(line, state="failed", text=f"{line.text}: too old", remedy=install)
    if "<" in bounds and version >= _version(bounds["<"]):
        return replace(line, state="warning", text=f"{line.text}: newer than what is tested", remedy=install)
    return line


def _driver() -> dict[str, Any]:
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    if shutil.which("nvidia-smi") is None:
        return found("missing", "no NVIDIA driver: BlitzGS trains on the CPU")
    version = run_command(query).split("\n")[0]
    return found("ok", f"NVIDIA {version}")


def _gpu(number: int, gpu: dict[str, Any]) -> Line:
    peers = f"writes to GPUs {gpu['peers']}" if gpu["peers"] else "no peer access"
    memory = f"{gpu['free_bytes'] / 1e9:.1f} of {gpu['bytes'] / 1e9:.1f} GB free"
    text = f"{gpu['name']}, {gpu['architecture']}, {memory}, {peers}"
    return Line(f"GPU {number}", "ok", text, "", False, gpu)


def _nvcc() -> dict[str, Any]:
    if shutil.which("nvcc") is None:
        return found("missing", "only needed to build the CUDA library from the sources")
    return found("ok", "".join(re.findall(r"release [\d.]+", run_command(["nvcc", "--version"]))))


def _exchange(device: str) -> dict[str, Any]:
    port = _free_port()
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(lambda rank: probe("exchange", device, rank, port), "01"))
    what = f"two ranks, {parts[0]['backend']}"
    if all(part["differing_values"] == 0 and part["covered"] > 0.1 for part in parts):
        return found("ok", f"{what}: the bits of one", ranks=parts)
    return found("failed", f"{what}: another image than one rank's", REPORT, ranks=parts)


def _free_port() -> str:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return str(listener.getsockname()[1])
