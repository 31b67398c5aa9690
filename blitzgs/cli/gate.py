# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs gate`: fit, sample, evaluate and replay spawn gates."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from blitzgs.cli.arguments import DATA, DEVICES, Commands, add_command, number
from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.files import changed
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files
from blitzgs.runs.folder import open_run
from blitzgs.spawn import fit as gate_fit
from blitzgs.spawn.gate import SpawnGate, gate_file
from blitzgs.spawn.samples import MAX_ROWS, SUFFIX, read_sample, write_sample
from blitzgs.training.inputs import open_capture
from blitzgs.training.replay import FIGURES, TABLE, replay
from blitzgs.util.output import OutputFolder

HELP = """\
A spawn gate is a predictor. Among the Gaussians about to be cloned or split (the candidates), it withholds
those whose children would probably be pruned later. It is fitted on the lineage of finished runs: the log of
all births and deaths of Gaussians. The repository's docs/guide/fewer-gaussians.md has an example.

  blitzgs train ... --population.lineage=true       log births and deaths (for each scene)
  blitzgs gate fit RUN RUN RUN --out gate.json      fit on them; prints figures for scenes left out
  blitzgs gate sample RUN --out NAME.parquet        reduce a run's lineage to one small file
  blitzgs gate evaluate gate.json RUN --out DIR     measure it on a scene that it has not seen
  blitzgs gate replay gate.json RUN --out DIR       compare it with an oracle and with random vetoes
  blitzgs train ... --population.gate=gate.json     use it
"""


FIT = """
runs RUN...  folder of a run with lineage, or a sample
--out FILE  file for the gate, .json (required)
--gate-from IMAGES  also evaluate separately the spawns (births during training) from this time on; take
    schedule.gate_from times schedule.scale of the runs that will use the gate (default: %(default)s)
"""
SAMPLE = """
folder RUN  folder of a run with lineage
--out FILE  file for the sample, .parquet (required)
--rows N  approximate number of births in the file (default: %(default)s)
"""
EVALUATE = """
gate GATE  file of a gate, or "default" (the included one)
runs RUN...  folder of a run with lineage
--out DIR  folder for figures and maps (required)
"""
REPLAY = f"""{DATA}{DEVICES}
gate GATE  file of a gate, or "default" (the included one)
folder RUN  folder of a run with lineage
--out DIR  folder for these runs and their figures (required)
--rate RATE  share of the candidates to withhold (default: %(default)s)
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    types = {
        "gate": gate_file,
        "--gate-from": number(float, lambda value: value >= 0, "0 or more"),
        "--rows": number(int, lambda value: value >= 1, "at least 1"),
        "--rate": number(float, lambda value: 0 <= value <= 1, "in [0, 1]"),
    }
    parser = add_command(commands, "gate", lambda _: 2, summary, HELP)
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    again = "continue one checkpoint several times: without a gate, with it, an oracle and random vetoes"
    for name, function, what, text, defaults in (
        ("fit", run_fit, "fit a gate on the lineage of runs", FIT, {"gate_from": ScheduleConfig.gate_from}),
        ("sample", run_sample, "reduce the lineage of a run to one file", SAMPLE, {"rows": MAX_ROWS}),
        ("evaluate", run_evaluate, "measure a gate on the lineage of runs", EVALUATE, {}),
        ("replay", run_replay, again, REPLAY, {"rate": 0.6, "device": "auto"}),
    ):
        add_command(actions, name, function, what, None, text, types, **defaults)


def run_fit(args: argparse.Namespace) -> None:
    """Fit a gate."""
    if args.out.suffix != ".json":
        raise ValueError(f"--out {args.out}: a gate's file ends in .json")
    runs = [(read_sample if path.suffix == SUFFIX else _spawns_of)(path) for path in args.runs]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figures = gate_fit.fit(runs, args.out, args.gate_from)
    print(f"{args.out}: fitted on {len(runs)} run{'s' * (len(runs) > 1)}; {figures['protocol']}:")
    for entry in figures["held_out"]:
        print(f"  {_judgement(entry)}")


def run_sample(args: argparse.Namespace) -> None:
    """Write a sample of spawns."""
    if args.out.suffix != SUFFIX:
        raise ValueError(f"--out {args.out}: a sample's file ends in {SUFFIX}")
    run = _spawns_of(args.folder)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rate = write_sample(run, args.out, args.rows)
    print(f"{args.out}: {rate:.2%} of {len(run.survived):,} spawns of {run.name}")


def run_evaluate(args: argparse.Namespace) -> None:
    """Judge a gate."""
    gate = SpawnGate(args.gate)
    runs = [_spawns_of(folder) for folder in args.runs]
    output = OutputFolder(args.out)
    figures = args.out / "evaluation.json"
    output.check(figures)
    args.out.mkdir(parents=True, exist_ok=True)
    schedules = [open_run(folder).config().schedule for folder in args.runs]
    gate_from = [Schedule(schedule).pace.image(schedule.gate_from) for schedule in schedules]
    results = gate_fit.evaluate(gate, runs, gate_from, output)
    output.write(figures, (json.dumps(results, indent=1) + "\n").encode())
    for result in results:
        seen = "  (the gate was fitted on this scene)" if result["seen"] else ""
        r = result.get("regions", {}).get("r")
        print(_judgement(result) + ("" if r is None else f"; regions r {r:.2f}") + seen)
    print(f"{args.out}: {figures.name}, {gate_fit.SURVIVAL} and maps of regions")


def run_replay(args: argparse.Namespace) -> None:
    """Train the arms."""
    gate = SpawnGate(args.gate)
    config = open_run(args.folder).config()
    if args.data is not None:
        config = changed(config, "data", path=str(args.data))
    results: list[dict[str, Any]] = []
    with Ranks.from_environment(
        args.device,
        config.ranks.timeout_seconds,
        "auto",
        args.share_gpus,
        tables_on_host=config.memory.resident_gb > 0,
    ) as ranks:
        capture, images = open_capture(config, ranks)
        for result in replay(config, capture, images, args.folder, args.out, gate, args.rate, ranks):
            results.append(result)
            if ranks.rank == 0:
                (args.out / FIGURES).write_text(json.dumps(results, indent=1) + "\n")
                (args.out / TABLE).write_text(_table(results))
        if ranks.rank == 0:
            print(_table(results))


def _spawns_of(folder: Path) -> gate_fit.Spawns:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not the folder of a run")
    lineage = folder / run_files.LINEAGE
    if not lineage.is_dir():
        return gate_fit.read_spawns(lineage)  # which says what is missing
    if not (summary := open_run(folder).summary()):
        raise ValueError(
            f"{folder} is not finished (it has no {run_files.SUMMARY}), so it is not known which Gaussians "
            "survive; finish it with blitzgs train ... --resume"
        )
    return gate_fit.read_spawns(lineage, summary.get("gaussians"))


def _judgement(entry: dict[str, Any]) -> str:
    text = (
        f"{entry['run']}: AUC {entry['auc']:.3f}, best single feature {entry['best_feature']} "
        f"{entry['best_feature_auc']:.3f}; {entry['spawns']:,} spawns, {entry['survived']:.0%} survived"
    )
    if "judged" in entry:
        text += f"; {entry['judged']['spawns']:,} from the gate's onset on, AUC {entry['judged']['auc']:.3f}"
    return text


def _table(results: Sequence[dict[str, Any]]) -> str:
    first = results[0]
    columns = "arm | PSNR | difference | SSIM | peak | difference | final | seconds | known to the oracle"
    lines = [f"| {columns} |", "|---" * 9 + "|"]
    for row in results:
        known = f"{row['matched']:.0%}" if "matched" in row else ""
        lines.append(
            f"| {row['arm']} | {row['psnr']:.3f} | {row['psnr'] - first['psnr']:+.3f} | {row['ssim']:.4f} "
            f"| {row['peak']:,} | {row['peak'] / first['peak'] - 1:+.1%} | {row['final']:,} "
            f"| {row['seconds']:.1f} | {known} |"
        )
    return "\n".join(lines) + "\n"
