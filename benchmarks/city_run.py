# SPDX-License-Identifier: Apache-2.0
"""Trains one run of `bm_city.py` in a separate process: python benchmarks/city_run.py SPEC RESULT.

SPEC is a JSON file of a `CityRun`. RESULT is written anew whenever more is known: after the set-up, the
training, the evaluation, and the popping. Its "status" is "done" at the end, "stopped" if a signal from
outside has stopped the training, and else "running" or "failed".
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bm_popping
import torch
from harness import environment, synchronize
from quality_plan import RunSpec
from quality_run import describe, means_of, work, write

from blitzgs.config.fields import Config
from blitzgs.distributed.group import Ranks
from blitzgs.runs.run_files import LOG
from blitzgs.runs.trained_model import TrainedModel
from blitzgs.training.agreement import Agreement
from blitzgs.training.events.evaluate import measure
from blitzgs.training.inputs import open_capture, read_ahead
from blitzgs.training.records import population_report
from blitzgs.training.trainer import Trainer
from blitzgs.util.progress import Laps

# A training stops so long before its process ends itself, in seconds; it is then evaluated.
RESERVE = 16.0
EVENTS = ("lod_gate", "pass_1", "pass_2", "clear_cull")

Record = dict[str, Any]


@dataclass(frozen=True)
class CityRun(RunSpec):
    """A run with its limits."""

    limit: float = 100.0  # seconds after which the process ends itself, whatever it does
    popping: int = 0  # frames of the flight after the evaluation, 0: none


class CityTrainer(Trainer):
    """A trainer that neither evaluates nor saves at its end, which its caller does or leaves out."""

    def finish(self, agreement: Agreement) -> Record:
        """Do nothing."""
        return {}

    def _stop(self, reason: str, saves: bool = True) -> None:
        """Write no checkpoint of a stopped run: it takes longer than the time that is left."""


def phases_of(config: Config, records: Sequence[Record], images: int, seconds: float) -> list[Record]:
    """Divide a run by what its schedule has on, from the records of its log.

    `images` and `seconds` are those of the whole training. Returns for each phase "from" and "to" in images,
    "on" (growth, LOD, mask), "seconds", "images_per_second" of the whole phase, "median_images_per_second"
    between two records, "active" and "visible" (shares of the Gaussians, means over the logged steps), and
    "gaussians" at its end.
    """
    schedule, view = config.schedule, config.view
    begins = schedule.t1 or schedule.t2
    cleared = (schedule.t2 + schedule.iterations) / 2
    marks = sorted({0, begins, schedule.densify_until, schedule.t2, cleared, schedule.iterations})
    steps = [record for record in records if "loss" in record]
    clock = [(0.0, 0.0)] + [(record["t"], record["t"] / record["images_per_second"]) for record in steps]
    if images > clock[-1][0]:
        clock.append((images, seconds))
    pairs = list(zip(clock, clock[1:], strict=False))

    def seconds_at(t: float) -> float:
        for (a, seconds_a), (b, seconds_b) in pairs:
            if t <= b:
                return seconds_a + (seconds_b - seconds_a) * (t - a) / max(1, b - a)
        return clock[-1][1]

    phases = []
    for begin, end in zip(marks, marks[1:], strict=False):
        first, last = begin * schedule.scale, min(end * schedule.scale, clock[-1][0])
        if first >= clock[-1][0]:
            break
        inside = [record for record in steps if first < record["t"] <= last]
        rates = [
            (b - a) / max(seconds_b - seconds_a, 1e-9)
            for (a, seconds_a), (b, seconds_b) in pairs
            if a >= first and b <= last
        ]
        parts = {
            "growth": begin < schedule.densify_until,
            "LOD": view.lod and begin >= schedule.densify_until,
            "mask": view.cull and config.population.importance and begins <= begin < cleared,
        }
        spent = seconds_at(last) - seconds_at(first)
        phases.append(
            {
                "from": first,
                "to": last,
                "on": " + ".join(name for name, is_on in parts.items() if is_on) or "–",
                "seconds": spent,
                "images_per_second": (last - first) / max(spent, 1e-9),
                "median_images_per_second": statistics.median(rates) if rates else None,
                "active": _mean_share(inside, "active"),
                "visible": _mean_share(inside, "visible"),
                "gaussians": inside[-1]["gaussians"] if inside else None,
            }
        )
    return phases


def _mean_share(records: Sequence[Record], name: str) -> float | None:
    return statistics.fmean(r[name] / r["gaussians"] for r in records) if records else None


def train(spec: CityRun, result: Record, path: Path, folder: Path, since: float) -> Record:
    """Train, evaluate and, if planned, measure popping; add to the result, and write it after each part.

    Returns its last "status".

    `path`: of the result's file, which rank 0 writes. `folder`: for the run's log. `since`: when the process
    began, by `time.monotonic`.
    """
    config, laps = spec.config(), Laps()
    reading = read_ahead(config.data)
    with Ranks.from_environment(
        spec.device, config.ranks.timeout_seconds, config.ranks.transport, lap=laps.lap
    ) as ranks:
        folder = Path(ranks.broadcast_object(str(folder)))  # all ranks are on one host
        wall: dict[str, float] = result.setdefault("wall", {})

        def note(part: str) -> None:
            """Note when a part was over, and write what is known."""
            wall[part] = round(time.monotonic() - since, 2)
            if ranks.rank == 0:
                write(path, result)

        capture, images = open_capture(config, ranks, reading=reading)
        laps.lap("capture")
        trainer = CityTrainer(config, capture, images, folder, ranks, laps=laps)
        state = trainer.state
        result["views"] = {"train": len(capture.train), "test": len(capture.test)}
        result["environment"] = environment(ranks.device)
        note("set_up")
        deadline = threading.Event()

        def stop() -> None:
            """Stop the training as a signal from outside does: the ranks agree on what one of them got."""
            deadline.set()
            os.kill(os.getpid(), signal.SIGTERM)

        timer = threading.Timer(max(1.0, spec.limit - RESERVE - (time.monotonic() - since)), stop)
        timer.daemon = True
        if ranks.rank == 0:
            timer.start()
        result["finished"] = trainer.train() is not None
        result["set_up"] = laps.seconds
        timer.cancel()
        is_done = result["finished"] or deadline.is_set()
        synchronize(ranks.device)
        images_seen, seconds = state.images_seen, state.progress.seconds
        result |= {
            "images": images_seen, "planned_images": state.schedule.iterations,
            "batch_size": config.schedule.batch_size, "seconds": seconds,
            "images_per_second": images_seen / max(seconds, 1e-9), "gaussians": state.population(),
            "population": population_report(state, trainer.memory),
        }  # fmt: skip
        if ranks.rank == 0:
            records = [json.loads(line) for line in (folder / LOG).read_text().splitlines()]
            result["phases"] = phases_of(state.config, records, images_seen, seconds)
            result["events"] = [record for record in records if record.get("event") in EVENTS]
        note("trained")
        with torch.no_grad():
            result |= means_of(measure(state, capture.test, None))
        note("evaluated")
        if spec.popping and ranks.world_size == 1:
            state.catch_up()
            model = TrainedModel(state.config, state.progress, state.space, state.table)
            result["popping"] = bm_popping.popping_of(model, capture.cameras, ranks, frames=spec.popping)
            note("popped")
    return {"status": "done" if is_done else "stopped"}


def main(arguments: Sequence[str]) -> int:
    """Do one run; returns the exit status."""
    since = time.monotonic()
    spec_path, result_path = map(Path, arguments)
    spec = CityRun(**json.loads(spec_path.read_text()))
    # On every rank: no rank outlives its parent, and a run that hangs ends, too.
    watchdog = threading.Timer(spec.limit, os._exit, (1,))
    watchdog.daemon = True
    watchdog.start()
    result = describe(spec) | {"status": "running", "finished": False}
    with tempfile.TemporaryDirectory() as folder:
        return work(result, result_path, lambda: train(spec, result, result_path, Path(folder), since))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
