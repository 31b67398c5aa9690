# SPDX-License-Identifier: Apache-2.0
"""Measures every table of the documentation on this machine.

    blitzgs synth CITY --preset city
    python benchmarks/measure.py --work WORK --city CITY --capture sheffield=DIR --capture caliterra=DIR ...
    python benchmarks/report.py

Runs the commands of `report.py`, each on GPUs of its own. The arms of the city run together, and commands
that compare numbers of GPUs have the machine to themselves, at last. The first capture is the one of gsplat's
training loop. WORK gets the runs and a log of each command. What has been measured at this commit is skipped,
and so are commands that need more GPUs than there are. The GPU tests are not part of it (`make gpu-record`).
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import harness
import torch
from quality_plan import parse_named
from report import COMMANDS, RESULTS


@dataclass(frozen=True)
class Job:
    """One command on some GPUs. Jobs start in order; a job of several GPUs waits until so many are free."""

    name: str  # in `COMMANDS`
    gpus: int
    part: str = ""  # flags after those of the command, for a part of what it measures

    @property
    def label(self) -> str:
        """The name of the job's log."""
        return f"{self.name}_{self.gpus}" if self.part else self.name


# Long jobs first. The parts of `city_ranks` are runs that the whole command then finds done.
PLAN = (
    Job("city_ranks", 1, "--ranks 1"), Job("quality", 2), Job("drop_in_full", 1),
    Job("city_ranks", 2, "--ranks 2"), Job("offload", 1), Job("render", 1),
    Job("step_1", 1), Job("step_4", 1), Job("accuracy", 1), Job("city", 4), Job("city_ranks", 4),
    Job("exchange", 4),
)  # fmt: skip


def is_measured(path: Path) -> bool:
    """Tell whether a file of results is of this commit, and has no run that failed."""
    if not path.exists():
        return False
    found = json.loads(path.read_text())
    runs = found.get("runs", found.get("results", []))
    is_done = all(run.get("status", "done") == "done" for run in runs)
    return is_done and bool(found["commit"] == harness.commit())


def words_of(job: Job, captures: dict[str, str], result: Path) -> list[str]:
    """Return a job's command, which runs in the folder of work; `captures`: flags of each."""
    text = COMMANDS[job.name].removeprefix("python ")
    every = " ".join(shlex.join(["--capture", f"{name}={source}"]) for name, source in captures.items())
    text = text.replace("--capture NAME=CAPTURE", every)
    text = re.sub(r"\bCAPTURE\b", next(iter(captures), ""), text)
    words = [*shlex.split(text), *shlex.split(job.part)]
    if job.name == "accuracy" and not (harness.ROOT / "build-exact").exists():
        at = words.index("--exact-library")
        del words[at : at + 2]
    json_flag = [] if job.part else ["--json", str(result)]
    return [sys.executable, str(harness.ROOT / words[0]), *words[1:], *json_flag]


def link(path: Path, target: Path) -> None:
    """Make or renew a link; FileNotFoundError: there is no such folder."""
    path.unlink(missing_ok=True)
    path.symlink_to(target.resolve(strict=True))


def run_all(jobs: list[Job], gpus: int, work: Path, captures: dict[str, str], results: Path) -> int:
    """Run jobs side by side; returns the exit status."""
    begin, free, status = time.monotonic(), list(range(gpus)), 0
    running: list[tuple[Job, list[int], subprocess.Popen[bytes], float]] = []
    environment = harness.child_environment(max(gpus, 1))
    while jobs or running:
        while jobs and jobs[0].gpus <= len(free):
            job = jobs.pop(0)
            mine, free = free[: job.gpus], free[job.gpus :]
            words = words_of(job, captures, results / f"{job.name}.json")
            visible = {"CUDA_VISIBLE_DEVICES": ",".join(map(str, mine))}
            with (work / f"{job.label}.log").open("w") as log:
                process = subprocess.Popen(words, cwd=work, stdout=log, stderr=log, env=environment | visible)
            running.append((job, mine, process, time.monotonic()))
        for entry in [entry for entry in running if entry[2].poll() is not None]:
            running.remove(entry)
            job, mine, process, started = entry
            free = sorted([*free, *mine])
            ended = "done" if process.returncode == 0 else f"FAILED, see {work / job.label}.log"
            status |= int(process.returncode != 0)
            now = time.monotonic()
            print(f"{now - begin:.0f} s: {job.label}: {ended} after {now - started:.0f} s", flush=True)
        time.sleep(0.1)
    return status


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; returns the exit status: 1 when a command failed or could not run."""
    parser = harness.make_parser(__doc__, device=None, writes_json=False)
    parser.add_argument("--work", type=Path, required=True, help="folder for runs and logs")
    parser.add_argument("--city", type=Path, help="folder that blitzgs synth has made")
    parser.add_argument("--capture", action="append", default=[], metavar='"NAME=DIR [--data.FIELD=VALUE]"')
    parser.add_argument("--gpus", type=int, default=torch.cuda.device_count(), help="to use (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS), help="tables (all)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the results (%(default)s)")
    args = parser.parse_args(arguments)
    work, results = args.work, args.results.resolve()
    captures = {}
    try:
        for folder in (work, results):
            folder.mkdir(parents=True, exist_ok=True)
        # Commands name what they read as the documentation does.
        for name in ("configs", "build-exact"):
            if (harness.ROOT / name).exists():
                link(work / name, harness.ROOT / name)
        if args.city is not None:
            link(work / "CITY", args.city)
        for name, source in map(parse_named, args.capture):
            capture, *flags = shlex.split(source)
            link(work / name, Path(capture))
            captures[name] = shlex.join([name, *flags])
    except (ValueError, OSError) as error:
        parser.error(str(error))
    given = {"CITY": args.city is not None, "CAPTURE": bool(captures)}
    jobs, status = [], 0
    for job in PLAN:
        lacks = [
            f"a {word.lower()}" for word, there in given.items() if not there and word in COMMANDS[job.name]
        ]
        if job.gpus > args.gpus:
            lacks.append(f"{job.gpus} GPUs")
        if job.name not in args.only or is_measured(results / f"{job.name}.json"):
            continue
        if lacks:
            print(f"{job.label}: not measured, needs {' and '.join(lacks)}", flush=True)
            status = 1
        else:
            jobs.append(job)
    return run_all(jobs, args.gpus, work, captures, results) | status


if __name__ == "__main__":
    sys.exit(main())
