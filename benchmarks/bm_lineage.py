# SPDX-License-Identifier: Apache-2.0
"""Measures what the log of births and deaths costs: a density event, the check at a checkpoint, a training.

    python benchmarks/bm_lineage.py [--gaussians 2000000] [--candidates 0.02] [--json FILE]
    python benchmarks/bm_lineage.py --data DIR --config configs/compact.yaml [--images 30000] [--FIELD=VALUE]

Without --data: density events of a synthetic table, with and without the log. Every event clones or splits a
share of the Gaussians and prunes about as many. Times are medians of wall time with the device idle before
and after. A check writes the remaining rows to disk and compares births less deaths with the population. The
first check follows all events, and no training lies between these, so it waits for most of their rows; the
other follows a single event.

With --data: the share of a training. After a training for warming up, a capture is trained with and without
the log in turn, without evaluations and checkpoints. The benchmark itself waits for the device only at the
end of a training. "lost" compares each training that logs, with its check at the end, with the one beside it
that does not. "in density events and the check" compares only these, by the host's clock, and so varies less.
The log is written to the folder for temporary files (TMPDIR).
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from harness import make_parser, report
from scenes import aerial

from blitzgs.capture.capture import Capture
from blitzgs.capture.images import Images
from blitzgs.config.fields import Config, Transport
from blitzgs.config.files import load_config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.population.density import DensityRules, densify
from blitzgs.runs.log import RunLog
from blitzgs.spawn.lineage import Ledger, Lineage, initial_births
from blitzgs.table.table import GaussianTable
from blitzgs.training.agreement import Agreement, StopRequest
from blitzgs.training.events import handle_all
from blitzgs.training.inputs import open_capture
from blitzgs.training.trainer import Trainer

RULES = DensityRules(grad_threshold=0.5, clone_scale=1.0, min_opacity=0.005)
Rows = list[dict[str, Any]]


def shake(table: GaussianTable, share: float, event: int) -> None:
    """Give a share of the rows large gradients, and an equal share opacities that are pruned."""
    generator = torch.Generator(table.device).manual_seed(event)
    draws = torch.rand(len(table), generator=generator, device=table.device)
    table["grad_count"].fill_(1)
    table["grad_sum"].copy_((draws < share).float())
    table["opacities"].masked_fill_(draws > 1 - share, -9.0)


def events(
    table: GaussianTable, share: float, first: int, count: int, lineage: Lineage | None
) -> list[float]:
    """Return the seconds of each of several density events."""
    ranks, seconds = Ranks(device=table.device), []
    for event in range(first, first + count):
        shake(table, share, event)
        begin = now(table.device)
        densify(
            table, RULES, time=100 * event, step=event, seed=0, level_count=4, ranks=ranks, lineage=lineage
        )
        seconds.append(now(table.device) - begin)
    return seconds


def now(device: torch.device) -> float:
    """Wait for the device and return the time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def seconds_of_check(lineage: Lineage, table: GaussianTable, step: int) -> float:
    """Return the seconds that the check of a checkpoint takes."""
    begin = now(table.device)
    lineage.flush_and_check(table["id"], step)
    return now(table.device) - begin


def measure_events(options: Namespace) -> tuple[str, Rows]:
    """Measure events of a synthetic table; return a title and the rows of the table."""
    scene, count = aerial(options.gaussians, options.device), options.events
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        plain = events(GaussianTable.create(scene.raw()), options.candidates, 0, count, None)
        table = GaussianTable.create(scene.raw())
        lineage = Lineage(Path(folder), Ranks(device=table.device), 0, Ledger())
        lineage.born(initial_births(table["id"], table["parent"], table["means"]), 0)
        logged = events(table, options.candidates, 0, count, lineage)
        behind_all = seconds_of_check(lineage, table, count)
        events(table, options.candidates, count, 1, lineage)
        behind_one = seconds_of_check(lineage, table, count + 1)
        lineage.close()
        megabytes = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
    times = {
        "event": plain,
        "event, logged": logged,
        f"check behind {count} events": [behind_all],
        "check behind one event": [behind_one],
    }
    rows = [{"work": name, "ms": 1e3 * statistics.median(values)} for name, values in times.items()]
    return f"Lineage: {count} events on {scene.name}, {options.candidates:.0%} grow; {megabytes:.0f} MB", rows


class Times(NamedTuple):
    """What one training took.

    Attributes:
        training: seconds of all steps and events.
        check: seconds of the log's check behind them; 0 without a log.
        events: seconds of each density event, by the host's clock.
        gaussians: population at the end, of all ranks.
        megabytes: size of the log.
    """

    training: float
    check: float
    events: list[float]
    gaussians: int
    megabytes: float

    @property
    def total(self) -> float:
        """Seconds with the check."""
        return self.training + self.check


class TimedTrainer(Trainer):
    """A trainer that measures the first images of a run."""

    @torch.no_grad()
    def timed(self, images: int) -> Times:
        """Train with the events that change the model."""
        state, size, seconds = self.state, self.state.schedule.batch_size, []
        folder = state.folder if state.ranks.rank == 0 else None
        state.log = RunLog(folder, state.schedule.iterations, done=0, tensorboard=False)
        agreement = Agreement(state.ranks, StopRequest(), state.save_clock)
        state.start_clock()
        begin = now(state.ranks.device)
        for step in range(1, images // size + 1):
            self.step(step)
            for event in state.schedule.events((step - 1) * size, step * size):
                if event.kind not in ("evaluate", "checkpoint"):
                    before = time.perf_counter()
                    handle_all(state, [event])
                    if event.kind == "densify":
                        seconds.append(time.perf_counter() - before)
            agreement.after(step)
        training, check = now(state.ranks.device) - begin, 0.0
        if state.lineage is not None:
            check = seconds_of_check(state.lineage, state.table, state.progress.step)
        parts = state.folder.glob("lineage/*.parquet")
        megabytes = sum(path.stat().st_size for path in parts) / 1e6
        return Times(training, check, seconds, state.population(), megabytes)


def train(config: Config, capture: Capture, pictures: Images, ranks: Ranks, images: int, logs: bool) -> Times:
    """Train once in a new folder, with or without the log."""
    config = replace(config, population=replace(config.population, lineage=logs))
    with tempfile.TemporaryDirectory() as folder:
        shared = Path(ranks.broadcast_object(folder)) / "run"  # the ranks write to one folder
        trainer = TimedTrainer(config, capture, pictures, shared, ranks)
        times = trainer.timed(images)
        trainer.close()
        ranks.barrier()
    return times


def figures(pairs: Sequence[tuple[Times, Times]]) -> Rows:
    """Return the rows of the table from trainings without and with the log, in pairs."""
    plain, logged = zip(*pairs, strict=True)
    lost = [with_log.total / without.total - 1 for without, with_log in pairs]
    in_events = [
        (sum(with_log.events) + with_log.check - sum(without.events)) / without.total
        for without, with_log in pairs
    ]

    def event(trainings: Sequence[Times]) -> float:
        return 1e3 * statistics.median(second for times in trainings for second in times.events)

    values = {
        "training without the log, s": statistics.median(times.total for times in plain),
        "with the log and its check, s": statistics.median(times.total for times in logged),
        "lost": f"{statistics.median(lost):.2%} ({min(lost):.2%} to {max(lost):.2%})",
        "lost, in density events and the check": f"{statistics.median(in_events):.2%}",
        "a density event, ms": event(plain),
        "a density event with the log, ms": event(logged),
        "the check, ms": 1e3 * statistics.median(times.check for times in logged),
        "density events": len(logged[0].events),
        "size of the log, MB": logged[0].megabytes,
    }
    return [{"figure": name, "value": value} for name, value in values.items()]


def measure_training(config: Config, ranks: Ranks, images: int, repeats: int) -> tuple[str, Rows]:
    """Train with and without the log in turn; return a title and the rows of the table."""
    capture, pictures = open_capture(config, ranks)

    def once(logs: bool) -> Times:
        return train(config, capture, pictures, ranks, images, logs)

    once(False)
    pairs = []
    for repeat in range(repeats):
        order = (False, True) if repeat % 2 == 0 else (True, False)
        times = {logs: once(logs) for logs in order}
        pairs.append((times[False], times[True]))
    title = (
        f"Lineage: {repeats} pairs of trainings of {images:,} images, {ranks.world_size} rank(s), "
        f"{pairs[0][0].gaussians:,} Gaussians at the end"
    )
    return title, figures(pairs)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__, repeats=3)
    parser.add_argument("--gaussians", type=int, default=2_000_000)
    parser.add_argument("--candidates", type=float, default=0.02, help="share that grows at an event")
    parser.add_argument("--events", type=int, default=20)
    parser.add_argument("--data", metavar="DIR", help="a capture: measure trainings of it")
    parser.add_argument("--config", type=Path, metavar="YAML", help="of the training (default: the defaults)")
    parser.add_argument("--images", type=int, help="trained on (default: the whole schedule)")
    options, overrides = parser.parse_known_args(arguments)
    if options.data is None:
        title, rows = measure_events(options)
        report(title, rows, options.json, options.device)
        return
    path = json.dumps(str(Path(options.data).resolve()))
    config = load_config(options.config, [*overrides, f"data.path={path}"])
    job, whole = config.ranks, Schedule(config.schedule).iterations
    images = options.images or whole
    if images > whole:
        parser.error(f"--images {images:,}: the schedule ends after {whole:,}")
    with Ranks.from_environment(
        options.device, job.timeout_seconds, cast(Transport, job.transport), job.share_gpus
    ) as ranks:
        title, rows = measure_training(config, ranks, images, options.repeats)
        if ranks.rank == 0:
            report(title, rows, options.json, ranks.device)


if __name__ == "__main__":
    main()
