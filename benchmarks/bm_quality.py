# SPDX-License-Identifier: Apache-2.0
r"""Measures quality against training time: captures x recipes x seeds, also with gsplat's strategies.

    python benchmarks/bm_quality.py --out RESULTS \
        --capture park=DATA/park --capture "town=DATA/town --data.downscale=2" \
        --recipe aerial=configs/aerial.yaml \
        --recipe "classic=configs/aerial.yaml --model.antialiased=false" \
        --recipe gsplat=gsplat-default-reset --recipe "mcmc=gsplat-mcmc --cap_max=2000000" \
        --seeds 0 1 2 --gpus 4 --minutes 8

A recipe is a configuration file or "defaults", with overrides; or one of gsplat's strategies, with options
of its trainer (`benchmarks/opponents/gsplat_training.py`): gsplat-default (as in its wheel),
gsplat-default-reset (with the resets of opacities that 1.5.3 skips by mistake) and gsplat-mcmc; or
"partition-4x5:" before a configuration, for blocks that are trained separately and then merged
(`benchmarks/opponents/spatial_partition.py`).

--stress YAML runs the stress grid of a configuration (`benchmarks/quality_plan.py`) instead of recipes, and
writes stress.md; --only "schedule=25.B=(4|16)$" chooses a part of it.

Every run is a process. By default, each GPU has one run at a time. With more (--per-gpu) the models are as
good, but times no longer compare, and the table says so. When a run ends, it writes a JSON file into
RESULTS/runs. The same command then skips the runs that are finished and repeats those that failed.
quality.json and --json have all runs, quality.md the tables. --collect adds the runs of other folders, or of
their quality.json, for example if several machines share the runs. In a copy without a repository,
BLITZGS_COMMIT names the commit.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import harness
import quality_report
from quality_plan import STRESS_SEEDS, RunSpec, end_of, parse_named, runs_of, stress_markdown, stress_recipes
from quality_run import describe, write

EVALUATE_AT = (1_000, 2_000, 4_000, 7_000, 10_000, 15_000, 20_000)
LOG_LINES = 12  # number of lines that a failed run's result has of the run's log
PRINT_EVERY = 60.0  # seconds between two lines about the present runs


@dataclass
class Job:
    """A run and its process."""

    spec: RunSpec
    slot: int  # decides its GPU
    process: subprocess.Popen[bytes]
    log: TextIO  # to which the process prints


class Pool:
    """Runs trainings side by side, one in each slot."""

    # Program beside this file that does one run; it takes the paths of the run's SPEC and RESULT.
    worker = "quality_run.py"

    def __init__(self, out: Path, gpus: int, per_gpu: int, ranks: int = 1) -> None:
        """Make `per_gpu` slots for each group of `ranks` GPUs; without a GPU, `per_gpu` slots for the CPU.

        ValueError: there are too few GPUs, or several runs would share them.
        """
        if ranks > 1 and (per_gpu > 1 or 0 < gpus < ranks):
            raise ValueError(f"--ranks {ranks} needs as many --gpus, and --per-gpu 1")
        self.out, self.gpus, self.per_gpu, self.ranks = out, gpus, per_gpu, ranks
        self.slots = list(range(max(gpus // ranks, 1) * per_gpu))
        self.jobs: list[Job] = []
        for folder in (quality_report.RUNS, "logs", "specs"):
            (out / folder).mkdir(parents=True, exist_ok=True)

    def start(self, spec: RunSpec) -> None:
        """Start a run on a free slot."""
        slot = self.slots.pop(0)
        spec_path = self.out / "specs" / f"{spec.name}.json"
        spec_path.write_text(json.dumps(dataclasses.asdict(spec)))
        log = (self.out / "logs" / f"{spec.name}.txt").open("w")
        worker = Path(__file__).with_name(self.worker)
        environment = harness.child_environment(max(self.gpus, 1) * self.per_gpu)
        if self.gpus:
            visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
            visible = visible or [str(gpu) for gpu in range(self.gpus)]
            first = slot % (self.gpus // self.ranks) * self.ranks
            environment["CUDA_VISIBLE_DEVICES"] = ",".join(visible[first : first + self.ranks])
        command = [sys.executable, str(worker), str(spec_path), str(self.result_path(spec))]
        if self.ranks > 1:
            command[1:1] = harness.torchrun(self.ranks)
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        self.jobs.append(Job(spec, slot, process, log))

    def result_path(self, spec: RunSpec) -> Path:
        """Return the path of a run's result."""
        return self.out / quality_report.RUNS / f"{spec.name}.json"

    def ended(self) -> list[Job]:
        """Return the runs that have ended since the last call, and complete their results."""
        over = [job for job in self.jobs if job.process.poll() is not None]
        for job in over:
            job.log.close()
            self.jobs.remove(job)
            self.slots.append(job.slot)
            self._complete(job)
        return over

    def _complete(self, job: Job) -> None:
        """Add to the result how many runs shared the machine; write one if the process ended without it."""
        path = self.result_path(job.spec)
        result: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        if not result or (job.process.returncode != 0 and result["status"] == "done"):
            tail = Path(job.log.name).read_text(errors="replace").splitlines()[-LOG_LINES:]
            error = f"the process ended with status {job.process.returncode}: " + " | ".join(tail)
            result = describe(job.spec) | {"status": "failed", "error": error}
        write(path, result | {"per_gpu": self.per_gpu, "side_by_side": max(self.gpus, 1) * self.per_gpu})

    def report(self) -> None:
        """Write the tables."""
        quality_report.report(self.out)

    def summary(self, result: dict[str, Any]) -> str:
        """Return a run's result as one line."""
        if result["status"] != "done":
            return f"FAILED: {result['error']}"
        metrics, training = end_of(result), result["evaluations"][-1]["train"]
        return (
            f"{metrics['psnr']:.2f} dB / {metrics['ssim']:.4f}, training views {training['psnr']:.2f}, "
            f"{result['seconds']:.1f} s, {result['gaussians']:,} Gaussians"
        )

    def stop(self) -> None:
        """End all present runs; the next call of this program repeats them."""
        for job in self.jobs:
            job.process.terminate()
        for job in self.jobs:
            job.process.wait()
            job.log.close()


def last_line(job: Job) -> str:
    """Return the last line that a run printed."""
    lines = Path(job.log.name).read_text(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "starting")


def work(specs: Sequence[RunSpec], pool: Pool, minutes: float | None) -> None:
    """Train the runs that are not finished, and write the tables whenever one ends."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    left = [spec for spec in specs if not quality_report.is_done(pool.out, spec.name)]
    print(
        f"{len(specs)} runs, {len(specs) - len(left)} of them done before; {len(pool.slots)} at a time",
        flush=True,
    )
    begin, count, total, printed = time.monotonic(), 0, len(left), 0.0
    try:
        while left or pool.jobs:
            elapsed = time.monotonic() - begin
            is_late = minutes is not None and elapsed > 60 * minutes
            while left and pool.slots and not is_late:
                # The result of an earlier, failed attempt could be taken for this one's.
                pool.result_path(left[0]).unlink(missing_ok=True)
                pool.start(left.pop(0))
            for job in pool.ended():
                count += 1
                result = json.loads(pool.result_path(job.spec).read_text())
                print(
                    f"[{count}/{total}, {elapsed:.0f} s] {job.spec.name}: {pool.summary(result)}", flush=True
                )
                pool.report()
            if elapsed > printed + PRINT_EVERY:
                printed = elapsed
                for job in pool.jobs:
                    print(f"  {elapsed:.0f} s: {job.spec.name}: {last_line(job)}", flush=True)
            if is_late and left and not pool.jobs:
                print(
                    f"{minutes:g} minutes are over: {len(left)} runs left; the same command continues",
                    flush=True,
                )
                return
            time.sleep(0.1)
    finally:
        pool.stop()


def train(specs: Sequence[RunSpec], pool: Pool, minutes: float | None) -> int:
    """Do the work, and print the tables; returns the exit status: 1 when one of the runs has failed."""
    work(specs, pool, minutes)
    print(quality_report.report(pool.out))
    wanted = {spec.name for spec in specs}
    runs = quality_report.read_runs(pool.out / quality_report.RUNS)
    return int(any(run["status"] != "done" and run["name"] in wanted for run in runs))


def make_parser() -> argparse.ArgumentParser:
    parser = harness.make_parser(__doc__, device=None)
    harness.add_pool_flags(parser)
    parser.add_argument("--capture", action="append", default=[], metavar='"NAME=DIR [--data.FIELD=VALUE]"')
    parser.add_argument("--recipe", action="append", default=[], metavar='"NAME=SOURCE [--FIELD=VALUE]"')
    parser.add_argument("--seeds", type=int, nargs="+", help="of the trainings (default: 0)")
    parser.add_argument("--stress", metavar="YAML", help="run the stress grid of this configuration")
    parser.add_argument("--only", metavar="REGEX", default="", help="of recipes, those whose names have this")
    parser.add_argument(
        "--evaluate-at",
        type=harness.positive,
        nargs="*",
        default=list(EVALUATE_AT),
        metavar="IMAGES",
        help="measure held-out views after so many images, and at the end (%(default)s)",
    )
    parser.add_argument(
        "--ranks", type=harness.positive, default=1, metavar="N", help="GPUs that train a run (%(default)s)"
    )
    parser.add_argument(
        "--collect", type=Path, nargs="*", metavar="SOURCE",
        help="add these runs; without recipes, report alone",
    )  # fmt: skip
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit status: 1 when a planned run failed."""
    parser = make_parser()
    args = parser.parse_args(arguments)
    try:
        captures, recipes = dict(map(parse_named, args.capture)), dict(map(parse_named, args.recipe))
        seeds, evaluate_at = args.seeds or [0], args.evaluate_at
        if args.stress is not None:
            recipes |= stress_recipes(args.stress)
            seeds, evaluate_at = args.seeds or STRESS_SEEDS, []
        recipes = {name: source for name, source in recipes.items() if re.search(args.only, name)}
        quality_report.collect(args.out, args.collect or [])
        specs = []
        if captures or recipes or args.collect is None:
            device = "cuda" if args.gpus > 0 else "cpu"
            specs = runs_of(captures, recipes, seeds, evaluate_at, args.lpips, device, args.ranks)
        pool = Pool(args.out, args.gpus, args.per_gpu, args.ranks)
    except (ValueError, OSError, re.error) as error:
        parser.error(str(error))
    status = train(specs, pool, args.minutes)
    runs = quality_report.read_runs(args.out / quality_report.RUNS)
    harness.write_json(args.json, "cpu", **quality_report.origin_of(runs), runs=runs)
    if args.stress is not None:
        table = stress_markdown(runs)
        (args.out / "stress.md").write_text(table)
        print(table)
    return status


if __name__ == "__main__":
    sys.exit(main())
