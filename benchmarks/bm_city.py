# SPDX-License-Identifier: Apache-2.0
r"""Trains a synthetic city with and without the view level: quality, speed by phase, memory, popping, ranks.

    blitzgs synth CITY --preset city
    python benchmarks/bm_city.py CITY --out RESULTS --scale 0.6 --gpus 2 --ranks 1 2 --popping \
        --json benchmarks/results/city.json

The arms are `configs/city.yaml` with the LOD gate and the cull mask (full), without the one (no_lod), the
other (no_mask), or both (all_off), and those of --arm NAME="--section.field=value ...". Every run is a
process on one GPU; each GPU has one at a time. The numbers of ranks above 1 follow when these are over: the
first of --arms, under torchrun, with the machine to itself. With several --batch-sizes, the first of --arms
is trained with each on every number of ranks.

A run writes its figures into RESULTS/runs after its set-up, training, evaluation and popping. Some seconds
before --seconds-per-run are over, its training stops where it is and is evaluated there ("finished": false).
The tables and --json are written when a run ends, and when this program is ended by SIGTERM. The same
command then skips the runs that are done; it does not repeat one for its popping alone. --collect trains
nothing, and writes tables and JSON of what there is in RESULTS. Other fields of the configuration may follow
as --section.field=value. In a copy without a repository, BLITZGS_COMMIT names the commit.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import quality_report
import torch
from bm_quality import Pool, work
from city_report import TABLES
from city_run import RESERVE, CityRun
from harness import ROOT, make_parser, markdown_table, positive, write_json
from quality_plan import parse_named, runs_of

CONFIG = ROOT / "configs" / "city.yaml"
ON = "--population.importance=true"
ARMS = {
    "full": f"{ON} --view.lod=true --view.cull=true",
    "no_lod": f"{ON} --view.lod=false --view.cull=true",
    "no_mask": f"{ON} --view.lod=true --view.cull=false",
    "all_off": "--population.importance=false --view.lod=false --view.cull=false",
}
Json = dict[str, Any]


class CityPool(Pool):
    """Runs the trainings of the city."""

    worker = "city_run.py"

    def __init__(self, args: Any, ranks: int) -> None:
        """Make a slot for each group of `ranks` GPUs."""
        super().__init__(args.out, args.gpus, 1, ranks)
        self.args = args

    def report(self) -> None:
        """Write the tables."""
        collect(self.args)

    def summary(self, result: Json) -> str:
        """Return a run's result as one line."""
        return str({key: result.get(key) for key in ("status", "finished", "psnr", "images_per_second")})


def held_out(city: Path, count: int, path: Path) -> None:
    """Write the names of `count` views, evenly over the flight, into a file for `data.split`."""
    names = sorted(file.name for file in (city / "images").iterdir())
    total = len(names)
    chosen = [name for i, name in enumerate(names) if i * count // total != (i + 1) * count // total]
    path.write_text("".join(f"{name}\n" for name in chosen))


def plan(args: Any, overrides: Sequence[str]) -> list[CityRun]:
    """Return the runs: all arms on one rank, then the first arm on each further number of ranks.

    The batch sizes after the first are for the first arm alone. ValueError: an argument cannot be used.
    """
    views = sum(1 for _ in (args.city / "images").iterdir())
    if args.held_out >= views:
        raise ValueError(f"--held-out must be below the number of views, {views}, got {args.held_out}")
    split = args.out / "held_out.txt"
    held_out(args.city, args.held_out, split)
    capture = {"city": f"'{args.city}' --data.split={json.dumps(str(split))}"}
    common = " ".join([f"--schedule.scale={args.scale}", "--log.every=200", *overrides])
    arms = {arm: ARMS[arm] for arm in args.arms} | dict(map(parse_named, args.arm))
    if not arms:
        raise ValueError("nothing to train: --arms and --arm name no arm")
    recipes = {arm: f"'{CONFIG}' {flags} {common}" for arm, flags in arms.items()}
    first, device = next(iter(arms)), "cuda" if args.gpus else "cpu"
    sizes = list(dict.fromkeys(args.batch_sizes)) or [None]
    runs = []
    for ranks, size in itertools.product(dict.fromkeys(args.ranks), sizes):
        is_first = ranks == 1 and size == sizes[0]
        batch = "" if size is None else f" --schedule.batch_size={size}"
        chosen = {arm: recipes[arm] + batch for arm in (arms if is_first else [first])}
        for spec in runs_of(capture, chosen, [0], [], None, device, ranks):
            frames = args.popping if is_first and spec.recipe == first else 0
            runs.append(CityRun(**dataclasses.asdict(spec), limit=args.seconds_per_run, popping=frames))
    return runs


def about_city(city: Path) -> Json:
    """Return what `blitzgs synth` noted about the city, and number and bytes of its images."""
    manifest = city / "city.json"
    if not manifest.exists():
        raise ValueError(
            f"{city}: there is no city.json: wait until blitzgs synth has ended, or run it again"
        )
    sizes = [file.stat().st_size for file in (city / "images").iterdir()]
    found: Json = json.loads(manifest.read_text())
    return found | {"images": len(sizes), "image_bytes": sum(sizes)}


def collect(args: Any) -> str:
    """Write city.md into the results, and the JSON; return the Markdown (OSError: there are no results)."""
    order = {arm: place for place, arm in enumerate(ARMS)}
    runs = quality_report.read_runs(args.out / quality_report.RUNS)
    runs.sort(key=lambda run: (run["ranks"], order.get(run["recipe"], len(ARMS)), run.get("batch_size", 0)))
    saved = args.out / "city.json"
    file = {"city": json.loads(saved.read_text()), "results": runs}
    if not runs:
        return "no run has any results yet"
    about = quality_report.origin_of(runs)
    write_json(args.json, "cpu", **about, **file)
    lines = [f"# The city\n\n`{about['command']}`, commit {about['commit']}"]
    for name, rows_of in TABLES.items():
        if rows := rows_of(file):
            lines.append(f"## {name}\n\n{markdown_table(rows)}")
    for run in runs:
        if run["status"] != "done":
            lines.append(
                f"Not done: {run['name']}: {run.get('error', 'it was stopped or ended from outside')}"
            )
    text = "\n\n".join(lines) + "\n"
    (args.out / "city.md").write_text(text)
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, device=None)
    parser.add_argument("city", type=Path, help="folder that blitzgs synth has made")
    parser.add_argument("--out", type=Path, required=True, metavar="RESULTS", help="folder of the results")
    parser.add_argument("--arms", nargs="*", choices=ARMS, default=list(ARMS), help="(all)")
    parser.add_argument(
        "--arm", action="append", default=[], metavar="NAME=FLAGS", help="another arm: flags of city.yaml"
    )
    gpus = torch.cuda.device_count()
    parser.add_argument("--gpus", type=int, default=gpus, help="to use; 0: the CPU (%(default)s)")
    parser.add_argument("--ranks", type=positive, nargs="+", default=[1], help="(%(default)s)")
    parser.add_argument(
        "--batch-sizes", type=positive, nargs="+", default=[], metavar="B", help="views a step (the recipe's)"
    )
    parser.add_argument(
        "--popping", type=int, nargs="?", const=240, default=0, metavar="FRAMES",
        help="measure popping, and what views can leave out, on the first arm's model (240 frames)",
    )  # fmt: skip
    parser.add_argument("--seconds-per-run", type=float, default=100.0, help="(%(default)s)")
    parser.add_argument("--held-out", type=positive, default=64, help="views to measure (%(default)s)")
    parser.add_argument("--scale", type=float, default=0.9, help="of the schedule (%(default)s)")
    parser.add_argument("--collect", action="store_true", help="train nothing; write tables and JSON")
    args, overrides = parser.parse_known_args(arguments)
    try:
        if args.collect:
            print(collect(args))
            return 0
        if args.seconds_per_run <= RESERVE:
            raise ValueError(f"--seconds-per-run must be above {RESERVE:g}, got {args.seconds_per_run:g}")
        if args.gpus and max(args.ranks) > args.gpus:
            raise ValueError(f"--ranks {max(args.ranks)} needs as many --gpus, got {args.gpus}")
        about = about_city(args.city)
        (args.out / quality_report.RUNS).mkdir(parents=True, exist_ok=True)
        (args.out / "city.json").write_text(json.dumps(about))
        runs = plan(args, overrides)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    try:
        for ranks in dict.fromkeys(args.ranks):
            group = [run for run in runs if run.ranks == ranks]
            work(group, CityPool(args, ranks), None)
    finally:
        print(collect(args))
    return int(not all(quality_report.is_done(args.out, run.name) for run in runs))


if __name__ == "__main__":
    sys.exit(main())
