# SPDX-License-Identifier: Apache-2.0
r"""The paper's tables on any scenes: runs what is missing, and writes Markdown and CSV beside its figures.

    python benchmarks/tables.py ablation --out TABLES --seeds 0 1 2 --gpus 4 \
        --scenes town=DATA/town "park=DATA/park --data.downscale=2" \
        --config configs/density.yaml --gate gates/mine.json
    python benchmarks/tables.py scaling --out TABLES --scenes city=DATA/city --gpus 4 --ranks 1 2 4
    python benchmarks/tables.py cost --out TABLES --scenes city=DATA/city --gpus 4 --ranks 1 2 4
    python benchmarks/tables.py oracle --out TABLES --runs town=RUNS/town --gate gates/mine.json --gpus 1
    python benchmarks/tables.py popping --out TABLES --runs town=RUNS/town

main, ablation, rho, onset, scaling and trajectory train, by `bm_quality.py`: a process for each run, into
TABLES/runs. `benchmarks/paper_tables.yaml` has their arms and the paper's figures; every arm is --config with
importance passes, phi, LOD gate, per-view mask and --gate, less what its row leaves out. Without --gate the
arms that differ by the gate alone are left out. cost runs `bm_exchange.py`, on the octree by
`--lod.visible_threshold` of --flags; oracle `blitzgs gate replay` from a run with lineage and checkpoints;
popping `bm_popping.py` on the model of a run with levels. gates/mine.json is a gate that `blitzgs gate fit`
makes from trainings of other scenes.

The ablation of the model level alone, for captures too small to have levels:
    python benchmarks/tables.py ablation --flags "--view.lod=false --view.cull=false" \
        --arms full no_importance no_phi no_pass_1 no_pass_2 no_gate all_off ...

--dry-run lists the runs. --resume continues in a folder that has results; finished runs are not repeated.
--collect adds results of other folders, as bm_quality.py does; without --scenes and --runs, the table is made
of those in TABLES alone.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bm_quality
import harness
import quality_report
import tables_report
import yaml
from quality_plan import parse_named, runs_of

from blitzgs.config.files import load_config

HERE = Path(__file__).parent
PAPER = HERE / "paper_tables.yaml"
EVERYTHING = "--population.importance=true --view.lod=true --view.cull=true"
TRAINED = ("main", "ablation", "rho", "onset", "scaling", "trajectory")
OF_RUNS = ("oracle", "popping")
ORACLE_ARMS = 5
THRESHOLD = "--lod.visible_threshold="  # the one field of --flags that cost has a use for
TABLES = (*TRAINED, "cost", *OF_RUNS)


def recipes_of(
    plan: dict[str, Any], config: str, gate: Path | None, flags: str = "", arms: Sequence[str] | None = None
) -> dict[str, str]:
    """Return the recipes of a table for `bm_quality.py`.

    `plan`: the table's entry of `paper_tables.yaml`. `config`: file that all arms start from, or "defaults".
    `gate`: model file of a spawn gate. `flags`: of all arms; those of an arm follow them. `arms`: their
    names; None: all. ValueError: the table has no such arm.
    """
    known = [*plan["arms"], *plan.get("opponents", {})]
    if arms is not None and (unknown := sorted(set(arms) - set(known))):
        raise ValueError(f"--arms: there is no {', '.join(unknown)} in this table; it has {', '.join(known)}")
    common = f"{EVERYTHING} {flags}".strip()
    if gate is not None:
        common += f" --population.gate={shlex.quote(str(gate.resolve()))}"
    recipes = {}
    for name, arm in plan["arms"].items():
        without_gate = arm["flags"] == "--population.gate=null"
        if gate is None and (arm.get("needs_gate", False) or (without_gate and name == "no_gate")):
            continue
        source = f"partition-{arm['grid']}:{config}" if "grid" in arm else config
        own = arm["flags"]
        if "gate_from" in arm:
            until = load_config(None if config == "defaults" else config).schedule.densify_until
            own += f" --schedule.gate_from={round(arm['gate_from'] * until)}"
        recipes[name] = f"{source} {common} {own}".strip()
    recipes |= plan.get("opponents", {})
    return {name: text for name, text in recipes.items() if arms is None or name in arms}


def train(table: str, plan: dict[str, Any], args: argparse.Namespace, scenes: dict[str, str]) -> int:
    """Train the runs of a table that are not finished; returns the exit status."""
    recipes = recipes_of(plan, args.config, args.gate, args.flags, args.arms)
    device, status = "cuda" if args.gpus > 0 else "cpu", 0
    for ranks in args.ranks if table == "scaling" else [1]:
        specs = runs_of(scenes, recipes, args.seeds, [], args.lpips, device, ranks)
        if args.dry_run:
            for spec in specs:
                state = "finished" if quality_report.is_done(args.out, spec.name) else "to run"
                print(f"{state}: {spec.name}: {' '.join([spec.source, *spec.overrides])}")
        else:
            pool = bm_quality.Pool(args.out, args.gpus, args.per_gpu, ranks)
            status |= bm_quality.train(specs, pool, args.minutes)
    return status


def measure(table: str, args: argparse.Namespace, scenes: dict[str, str]) -> None:
    """Run the other benchmark that a table is made of, for the scenes that have no result."""
    device = "cuda" if args.gpus > 0 else "cpu"
    for scene, text in scenes.items():
        # `blitzgs gate replay` writes a folder.
        path = args.out / (f"oracle.{scene}/replay.json" if table == "oracle" else f"{table}.{scene}.json")
        command = [sys.executable]
        if table == "cost":
            folder, *fields = shlex.split(text)
            downscale = next((f.partition("=")[2] for f in fields if f.startswith("--data.downscale=")), "1")
            command += [str(HERE / "bm_exchange.py"), "--data", folder, "--downscale", downscale]
            threshold = [f.partition("=")[2] for f in shlex.split(args.flags) if f.startswith(THRESHOLD)]
            command += ["--visible-threshold", threshold[-1]] if threshold else []
            command += ["--device", device, "--json", str(path), "--ranks", *map(str, args.ranks)]
        elif table == "oracle":
            if args.gate is None:
                raise ValueError("oracle: give the model file of a spawn gate, --gate FILE")
            command += ["-m", "blitzgs", "gate", "replay", str(args.gate), text, "--out", str(path.parent)]
            command += ["--device", device]
        else:
            command = ["bm_popping.popping", text]
        # A replay writes its result after each arm.
        done = path.exists() and (table != "oracle" or len(json.loads(path.read_text())) == ORACLE_ARMS)
        print(f"{'finished' if done else 'to run'}: {' '.join(command)}", flush=True)
        if done or args.dry_run:
            continue
        if table == "popping":
            from bm_popping import popping  # needs OpenCV's video writer, which other tables do not need

            path.write_text(json.dumps(popping(Path(text), None, device), indent=1))
        else:
            subprocess.run(command, check=True)


def read_results(table: str, out: Path) -> dict[str, Any]:
    """Return scene -> result, of the results that `measure` wrote into a folder."""
    pattern = "oracle.*/replay.json" if table == "oracle" else f"{table}.*.json"
    found = {}
    for path in sorted(out.glob(pattern)):
        name = path.parent.name if table == "oracle" else path.stem
        found[name.partition(".")[2]] = json.loads(path.read_text())
    return found


def tabulate(table: str, plan: dict[str, Any], out: Path) -> str:
    """Write the table of all results in a folder; returns its Markdown (ValueError: there are none)."""
    reference, parts = plan.get("reference", []), []
    rows: list[dict[str, Any]] = []
    if table in TRAINED:
        runs = quality_report.read_runs(out / quality_report.RUNS)
        runs = [run for run in runs if run["status"] == "done"]
        arms = plan["arms"] | {name: {"title": name} for name in plan.get("opponents", {})}
        texts, rows = tables_report.arm_rows(runs, arms)
        if table == "scaling":
            tables_report.speedups(rows)
            texts = [text | {"speedup": row["speedup"]} for text, row in zip(texts, rows, strict=True)]
        if table == "trajectory":
            rows = texts = tables_report.trajectory_rows(runs, "full", reference) if rows else []
            reference = []
        parts = [(table, texts), ("partition", tables_report.partition_rows(runs, arms))]
    for scene, found in read_results(table, out).items():
        if table == "cost":
            rows += tables_report.cost_rows(scene, found["results"], reference)
        elif table == "oracle":
            rows += tables_report.oracle_rows(scene, found, reference)
        else:
            rows += tables_report.popping_rows(scene, found)
    if not rows:
        raise ValueError(f"{out} has no finished results for {table}: give --scenes (or --runs) to make some")
    parts = parts or [(table, rows)]
    return tables_report.write(out, table, plan["source"], [*parts, ("paper", reference)], rows)


def make_parser() -> argparse.ArgumentParser:
    parser = harness.make_parser(__doc__, device=None, writes_json=False)
    parser.add_argument("table", choices=TABLES)
    harness.add_pool_flags(parser)
    parser.add_argument("--scenes", nargs="+", default=[], metavar='"NAME=DIR [--data.FIELD=VALUE]"')
    parser.add_argument("--runs", nargs="+", default=[], metavar="NAME=RUN", help="for oracle and popping")
    parser.add_argument(
        "--config", default="configs/density.yaml", metavar="YAML", help="of all arms (%(default)s)"
    )
    parser.add_argument("--flags", default="", metavar='"--FIELD=VALUE ..."', help="for all arms")
    parser.add_argument("--arms", nargs="+", metavar="ARM", help="only these, by their names in the plan")
    parser.add_argument("--gate", type=Path, metavar="FILE", help="spawn gate, fitted on other scenes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--ranks", type=harness.positive, nargs="+", default=[1, 2, 4], help="of scaling and cost"
    )
    parser.add_argument("--collect", type=Path, nargs="+", default=[], metavar="SOURCE")
    parser.add_argument("--resume", action="store_true", help="carry on in a folder that has results")
    parser.add_argument("--dry-run", action="store_true", help="list the runs, and stop")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Make a table; returns the exit status: 1 when a run failed."""
    parser = make_parser()
    args = parser.parse_args(arguments)
    plan, status = yaml.safe_load(PAPER.read_text())[args.table], 0
    try:
        scenes = dict(map(parse_named, args.runs if args.table in OF_RUNS else args.scenes))
        # A call that was refused leaves an empty folder.
        has_results = any((args.out / quality_report.RUNS).glob("*"))
        if has_results and scenes and not (args.resume or args.dry_run):
            raise ValueError(f"{args.out} has results: --resume carries on, or choose another --out")
        if not args.dry_run:
            quality_report.collect(args.out, args.collect)
        if scenes and args.table in TRAINED:
            status = train(args.table, plan, args, scenes)
        elif scenes:
            measure(args.table, args, scenes)
        if not args.dry_run:
            print(tabulate(args.table, plan, args.out))
    except (ValueError, OSError, subprocess.CalledProcessError) as error:
        parser.error(str(error))
    return status


if __name__ == "__main__":
    sys.exit(main())
