# SPDX-License-Identifier: Apache-2.0
"""Measures a real training after some thousand images: time of a step, of a density event, and of waits.

    python benchmarks/bm_training.py --data DIR --config configs/aerial.yaml [--images 10000] [--FIELD=VALUE]
    torchrun --nproc-per-node=2 benchmarks/bm_training.py --data DIR --config configs/aerial.yaml

First the benchmark trains the capture with `--images` images, as `blitzgs train` does, with loading and
logging of batches but without checkpoints and evaluations. Then it measures `--steps` further steps with the
density events that fall among them, by the host's clock; the GPU is idle before and after. Of these steps it
also reports how many images and masks were decoded, and in which share of the time the host waited for
photographs, and for other ranks or the GPU in each `Watchdog.waiting`. With several ranks the host waits
nowhere else.

On CUDA, `--profiled` more steps, without density events, run under torch's profiler. Reported are: how long
kernels and copies keep the busiest stream occupied, which part of this are barriers and collectives, in which
it waits for other ranks, how long the host waits for the GPU, which kernels take the time, and the longest
gaps on the busiest stream with the kernels before and after each. The figures are those of rank 0; the ranks
wait for each other in every step. The title has the Gaussians of all ranks before the measured steps.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from harness import make_parser, markdown_table, report
from torch.profiler import ProfilerActivity, profile

from blitzgs.config.fields import Transport
from blitzgs.config.files import load_config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.watchdog import NoWatchdog, Watchdog
from blitzgs.runs.log import RunLog
from blitzgs.training.agreement import Agreement, StopRequest
from blitzgs.training.events import densify
from blitzgs.training.inputs import open_capture
from blitzgs.training.trainer import Trainer

LEAST_GAP = 3.0  # us; the usual gap between two kernels that were queued long before


# How the names of the kernels begin in which a stream waits for other ranks: `short_name` of blitzgs' barrier
# and of NCCL's collectives.
WAITING_KERNELS = ("barrier_kernel", "ncclDevKernel")


class Times(NamedTuple):
    """Seconds of some steps in a row, and of each density event among them.

    Attributes:
        steps: seconds of the steps.
        events: seconds of each density event.
        waits: share of the steps' time in which the host waited, by what it waited for.
        decoded: decodings of images and masks.
    """

    steps: float
    events: list[float]
    waits: dict[str, float]
    decoded: int


class StreamUse(NamedTuple):
    """How busy the main stream and the host were in the profiled steps.

    Attributes:
        busy: share of the time, from the first to the last kernel, in which the main stream works.
        exchanging: share of the same time in which barriers or collectives run on the main stream.
        waiting: share of the same time in which the thread that launches kernels waits for the GPU.
        launches: kernels and copies on all streams.
        gaps: (before, after) -> the main stream's gaps between these, in us.
        kernels: name -> duration of each of its launches, on all streams, in us.
    """

    busy: float
    exchanging: float
    waiting: float
    launches: int
    gaps: dict[tuple[str, str], list[float]]
    kernels: dict[str, list[float]]


class MeasuredWatchdog(NoWatchdog):
    """Measures how long the process waits in each context of another watchdog.

    Attributes:
        seconds: by the name of the context.
    """

    def __init__(self, watchdog: Watchdog | NoWatchdog) -> None:
        self._watchdog = watchdog
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def waiting(self, name: str) -> Iterator[None]:
        """See `Watchdog.waiting`."""
        begin = time.perf_counter()
        with self._watchdog.waiting(name):
            yield
        self.seconds[name] += time.perf_counter() - begin

    def working(self, what: str) -> AbstractContextManager[None]:
        """See `Watchdog.working`."""
        return self._watchdog.working(what)

    def report_failure(self, message: str) -> None:
        """See `Watchdog.report_failure`."""
        self._watchdog.report_failure(message)

    def stop(self) -> None:
        """See `Watchdog.stop`."""
        self._watchdog.stop()


class MeasuredTrainer(Trainer):
    """A trainer that takes steps in timed parts; the watchdog of its ranks is a `MeasuredWatchdog`."""

    @torch.no_grad()
    def begin(self, steps: int) -> None:
        """Train the first steps, with their density events."""
        self.state.start_clock()
        self._agreement = Agreement(self.state.ranks, StopRequest(), self.state.save_clock)
        folder = self.state.folder if self.state.ranks.rank == 0 else None
        self.state.log = RunLog(folder, self.state.schedule.iterations, done=0, tensorboard=False)
        self.timed(steps)

    @torch.no_grad()
    def timed(self, steps: int) -> Times:
        """Train further steps with their density events, and measure both."""
        size, first = self.state.schedule.batch_size, self.state.progress.step + 1
        spent, events = 0.0, []
        waited, decoded = self._waited(), self.state.images.memory().decoded
        begin = self._now()
        for step in range(first, first + steps):
            self.step(step)
            self._agreement.after(step)
            for event in self.state.schedule.events((step - 1) * size, step * size):
                if event.kind == "densify":
                    stopped, before = self._now(), self._waited()
                    densify.run(self.state, event)
                    spent += stopped - begin
                    begin = self._now()
                    events.append(begin - stopped)
                    for name, seconds in self._waited().items():  # do not count those of the event
                        waited[name] = waited.get(name, 0.0) + seconds - before.get(name, 0.0)
        spent += self._now() - begin
        shares = {name: (end - waited.get(name, 0.0)) / spent for name, end in self._waited().items()}
        waits = {name: share for name, share in shares.items() if share >= 0.0005}
        return Times(spent, events, waits, self.state.images.memory().decoded - decoded)

    def _waited(self) -> dict[str, float]:
        """Return the seconds that the host has waited so far, by what it waited for."""
        watchdog = cast(MeasuredWatchdog, self.state.ranks.watchdog)
        in_contexts = {f"other ranks or the GPU, {name}": t for name, t in watchdog.seconds.items()}
        return {"photographs": self.loader.waited} | in_contexts

    @torch.no_grad()
    def profiled(self, steps: int) -> list[dict[str, Any]]:
        """Train further steps without density events; return the events of the profiler's trace."""
        first = self.state.progress.step + 1
        self._now()
        with profile(activities=[ProfilerActivity.CUDA], acc_events=True) as profiler:
            for step in range(first, first + steps):
                self.step(step)
            self._now()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trace.json"
            profiler.export_chrome_trace(str(path))
            events: list[dict[str, Any]] = json.loads(path.read_text())["traceEvents"]
        return events

    def _now(self) -> float:
        """Wait for the GPU and return the host's time in seconds."""
        if self.state.ranks.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()


def stream_use(trace: Sequence[dict[str, Any]]) -> StreamUse:
    """Read how busy the main stream was, its gaps, and how long the host waited."""
    work: dict[int, list[tuple[float, float, str]]] = defaultdict(list)
    calls: dict[int, list[tuple[str, float]]] = defaultdict(list)
    for event in trace:
        kind = event.get("cat")
        if kind in ("kernel", "gpu_memcpy", "gpu_memset"):
            end = event["ts"] + event["dur"]
            work[event["args"]["stream"]].append((event["ts"], end, short_name(event["name"])))
        elif kind in ("cuda_runtime", "cuda_driver"):
            calls[event["tid"]].append((event["name"], event["dur"]))

    def working(items: list[tuple[float, float, str]]) -> float:
        return sum(end - begin for begin, end, name in items if not name.startswith(WAITING_KERNELS))

    main = sorted(max(work.values(), key=working))
    span = main[-1][1] - main[0][0]
    exchanging = sum(end - begin for begin, end, _ in main) - working(main)
    busy, last, before = 0.0, main[0][0], ""
    gaps: dict[tuple[str, str], list[float]] = defaultdict(list)
    for begin, end, name in main:
        if begin - last > LEAST_GAP:
            gaps[before, name].append(begin - last)
        busy += max(end - max(begin, last), 0.0)
        if end >= last:
            last, before = end, name
    launching = max(calls.values(), key=lambda items: sum("Launch" in name for name, _ in items), default=[])
    waits = sum(length for name, length in launching if "Synchronize" in name)
    kernels: dict[str, list[float]] = defaultdict(list)
    for begin, end, name in chain.from_iterable(work.values()):
        kernels[name].append(end - begin)
    launches = sum(map(len, work.values()))
    return StreamUse(busy / span, exchanging / span, waits / span, launches, dict(gaps), dict(kernels))


def short_name(name: str) -> str:
    """Return a kernel's name without namespaces, template arguments and parameters."""
    name = name.replace("(anonymous namespace)::", "").removeprefix("void ")
    return re.split(r"[<(]", name)[0].split("::")[-1].strip()


def figures(times: Times, steps: int, use: StreamUse | None, profiled: int) -> list[dict[str, Any]]:
    """Return the rows of the table."""
    rows: list[tuple[str, Any]] = [("a step without density events, ms", 1e3 * times.steps / steps)]
    if times.events:
        every = steps / len(times.events)
        rows += [
            (f"with them, one in {every:.3g} steps, ms", 1e3 * (times.steps + sum(times.events)) / steps),
            ("a density event, ms", 1e3 * sum(times.events) / len(times.events)),
        ]
    rows.append(("images and masks decoded a step", times.decoded / steps))
    rows += [(f"the host waits for {name}", f"{share:.1%}") for name, share in times.waits.items()]
    if use is not None:
        rows += [
            ("the main stream is busy", f"{use.busy:.0%}"),
            ("of this in barriers and collectives", f"{use.exchanging:.0%}"),
            ("the host waits for the GPU", f"{use.waiting:.0%}"),
            ("kernels and copies a step", use.launches / profiled),
        ]
    return [{"figure": name, "value": value} for name, value in rows]


def longest_gaps(use: StreamUse, steps: int, count: int = 8) -> list[dict[str, Any]]:
    """Return the rows of the table of gaps, those that take most first."""
    ordered = sorted(use.gaps.items(), key=lambda item: -sum(item[1]))
    return [
        {"before": before, "after": after, "us a step": sum(gaps) / steps, "times a step": len(gaps) / steps}
        for (before, after), gaps in ordered[:count]
    ]


def longest_kernels(use: StreamUse, steps: int, count: int = 16) -> list[dict[str, Any]]:
    """Return the rows of the table of kernels and copies, those that take most first."""
    ordered = sorted(use.kernels.items(), key=lambda item: -sum(item[1]))
    return [
        {"kernel": name, "us a step": sum(times) / steps, "times a step": len(times) / steps}
        for name, times in ordered[:count]
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__, device="auto")
    parser.add_argument("--data", required=True, metavar="DIR", help="the capture")
    parser.add_argument("--config", type=Path, metavar="YAML", help="of the training (default: the defaults)")
    parser.add_argument("--images", type=int, default=10_000, help="trained before (%(default)s)")
    parser.add_argument("--steps", type=int, default=500, help="timed steps (%(default)s)")
    parser.add_argument("--profiled", type=int, default=40, help="steps under the profiler (%(default)s)")
    args, overrides = parser.parse_known_args(arguments)
    config = load_config(args.config, [*overrides, f"data.path={json.dumps(str(Path(args.data).resolve()))}"])
    job, schedule = config.ranks, Schedule(config.schedule)
    before = args.images // schedule.batch_size
    if before + args.steps + args.profiled > schedule.steps:
        raise SystemExit(f"the schedule ends after {schedule.iterations:,} images: lower --images")
    with (
        Ranks.from_environment(
            args.device, job.timeout_seconds, cast(Transport, job.transport), job.share_gpus
        ) as ranks,
        tempfile.TemporaryDirectory() as folder,
    ):
        shared = ranks.broadcast_object(folder)  # the ranks write to one folder
        ranks.watchdog = MeasuredWatchdog(ranks.watchdog)
        capture, images = open_capture(config, ranks)
        trainer = MeasuredTrainer(config, capture, images, Path(shared), ranks)
        trainer.begin(before)
        count = trainer.state.population()
        times, use = trainer.timed(args.steps), None
        if ranks.device.type == "cuda":
            use = stream_use(trainer.profiled(args.profiled))
        trainer.close()
        if ranks.rank == 0:
            title = (
                f"Training: {ranks.world_size} rank(s), {count:,} Gaussians after {args.images:,} images, "
                f"{schedule.batch_size} a step"
            )
            report(title, figures(times, args.steps, use, args.profiled), args.json, ranks.device)
            if use is not None:
                print(markdown_table(longest_kernels(use, args.profiled)))
            if use is not None and use.gaps:
                print(markdown_table(longest_gaps(use, args.profiled)))


if __name__ == "__main__":
    main()
