# SPDX-License-Identifier: Apache-2.0
"""Measures a training step on several ranks: time by stage, bytes exchanged, balance.

    python benchmarks/bm_exchange.py --data DIR [--downscale 2] [--device cuda] [--ranks 1 2 4] [--batch 4 16]
    python benchmarks/bm_exchange.py --gaussians 16000000 --device cuda [--ranks 1 2 4]

With --data the Gaussians are the octree of the capture's points, seen from evenly spaced training views;
otherwise the `aerial` scene of `scenes.py`. Each number of ranks runs under torchrun, and takes the trainer's
own steps (`blitzgs.training.step`): every batch is visited once with tiles divided by an estimate, then
several times with tiles divided by their measured cost.

Stages: a barrier precedes every step, so that all ranks start it together. The time of a stage is the time
between its marks on the device, of the slowest rank, as a median over batches and visits. "alone" is the sum
of all stages. If ranks share memory, splats are sent in "project"; "exchange back" then sums the gradients
that lie with other ranks.

Step: all batches run one after the other without a barrier, as in training. The time is that from the
first to the last by the host's clock, divided by their number, as a median over the visits.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import torch
from harness import Clock, make_parser, torchrun, write_json
from report_tables import exchange_lines
from scenes import aerial

from blitzgs.capture.capture import load_capture
from blitzgs.config.fields import FORK, Config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TILE_COST, TileOwners
from blitzgs.frame.render import RenderOptions
from blitzgs.frame.tiles import LOSS_HALO
from blitzgs.frame.transport.protocol import stages_told_to
from blitzgs.ops.projection_types import Views
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.initialisation import octree_gaussians
from blitzgs.runs.guard import LossGuard
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.training.batches import Batch
from blitzgs.training.step import Stepper
from blitzgs.view.levels import measure_levels
from blitzgs.view.views import Space, ViewSet, render_options, trained_centres

STAGES = (
    "project", "exchange", "sort", "raster", "loss", "raster back", "exchange back", "optimiser", "other",
)  # fmt: skip


# The Gaussians of all ranks, and the views; the batches have the keys of their views; last the extent.
Inputs = tuple[GaussianTable, RenderOptions, list[tuple[list[int], Views]], float]


def capture_inputs(args: argparse.Namespace, device: torch.device) -> Inputs:
    """Return the octree of a capture's points and evenly spaced training views."""
    capture = load_capture(args.data, downscale=args.downscale)
    space = Space.of(capture.offset, capture.extent)
    points = torch.from_numpy(capture.points).to(device) / space.unit
    centres = trained_centres([capture.cameras[i] for i in capture.train], space).to(device)
    table = octree_gaussians(
        points, torch.from_numpy(capture.colors).to(device), centres,
        measure_levels(points, centres, FORK), args.visible_threshold,
    ).table(sh_degree=3, opacity=0.5)  # fmt: skip
    views = ViewSet(capture.cameras, space, device)
    count = min(args.batch * args.batches, len(capture.train))
    chosen = [capture.train[k * len(capture.train) // count] for k in range(count)]
    groups = [chosen[i : i + args.batch] for i in range(0, len(chosen), args.batch)]
    options = render_options(Config(), space, 3)
    return table, options, [(group, views.pick(group)) for group in groups], space.extent


def aerial_inputs(args: argparse.Namespace, device: torch.device) -> Inputs:
    """Return the `aerial` scene, the same on every rank of one kind of device."""
    scene = aerial(args.gaussians, device, views=args.batch * args.batches)
    keys = list(range(len(scene.viewmats)))
    batches = [
        (keys[at], Views(scene.viewmats[at], scene.Ks[at], scene.width, scene.height))
        for at in (slice(first, first + args.batch) for first in keys[:: args.batch])
    ]
    options = RenderOptions(sh_degree=3, near_plane=0.1, far_plane=1e6)
    return GaussianTable.create(scene.raw()), options, batches, 500.0


class Workload:
    """This rank's share of the Gaussians, and steps of training over the batches."""

    def __init__(self, args: argparse.Namespace, ranks: Ranks) -> None:
        inputs = capture_inputs if args.data else aerial_inputs
        table, self.options, self.batches, extent = inputs(args, ranks.device)
        self.ranks, self.total, config = ranks, len(table), Config()
        rows = torch.arange(ranks.rank, self.total, ranks.world_size, device=table.device)
        rows = rows[morton_order(table["means"][rows])]
        self.table = GaussianTable({name: table[name][rows].to(ranks.device) for name in table})
        self.owners, self.guard, self.steps = TileOwners(ranks), LossGuard(), 0
        self.loss = config.loss
        optimiser = TableAdam(config.optimiser, Schedule(config.schedule), extent, ranks.device)
        self.stepper = Stepper(self.table, optimiser, self.owners, config.loss, 1.0)
        views = self.batches[0][1]
        shape = (len(views), views.height, views.width, 3)
        self.targets = torch.full(shape, 128, dtype=torch.uint8, device=ranks.device)
        self.samples = torch.full((len(views),), 3.0 * views.height * views.width, device=ranks.device)

    def batch(self, keys: list[int], views: Views) -> Batch:
        """Return views with grey photographs, their tiles divided as the trainer does."""
        samples, targets, ranges = self.samples[: len(keys)], self.targets[: len(keys)], None
        if self.ranks.world_size > 1:
            ranges = self.owners.divide(keys, views.width, views.height, LOSS_HALO)
        return Batch(keys, views, targets, None, samples, ranges)

    def step(self, batch: Batch) -> dict[str, Any]:
        """Take one training step."""
        self.steps += 1
        frame, terms, sums = self.stepper.forward(self.steps, self.options, batch)
        self.guard.check(self.steps, [str(key) for key in batch.indices], sums, self.table, frame)
        self.stepper.backward(self.steps, frame, terms)
        sent = () if frame.way_back is None else frame.way_back.traffic.sent
        return {
            "splats": len(frame.projected.gaussian_ids),
            "visible": len(frame.projected.visible_ids),
            "sent": sum(sent) - sent[self.ranks.rank] if sent else 0,
            "work": sums,
            "ranges": batch.ranges,
        }

    def staged(self) -> Iterator[tuple[list[float], dict[str, Any]]]:
        """Visit all batches with a barrier before each step; yield its stages in ms and its figures."""
        for keys, views in self.batches:
            batch = self.batch(keys, views)
            self.ranks.barrier()
            clock = Clock(self.ranks.device)
            with stages_told_to(clock.mark):
                result = self.step(batch)
            times = dict.fromkeys(STAGES, 0.0)
            for stage, ms in clock.stages():
                times[stage] += ms
            yield list(times.values()), result

    def in_a_row(self) -> float:
        """Visit all batches without a barrier; return ms per step."""
        self.ranks.barrier()
        begin = time.perf_counter()
        for keys, views in self.batches:
            self.step(self.batch(keys, views))
        self.ranks.barrier()
        return 1000 * (time.perf_counter() - begin) / len(self.batches)


def balance_of(result: dict[str, Any]) -> float:
    """Return the largest cost of a rank over the mean."""
    if result["ranges"] is None:
        return 1.0
    ranges = result["ranges"]
    cost = result["work"].read()[-ranges.n_views * ranges.tiles_per_view :].double() + TILE_COST
    parts = [cost[begin:end].sum().item() for begin, end in pairwise(ranges.bounds)]
    return max(parts) / statistics.mean(parts)


def measure(args: argparse.Namespace) -> None:
    """Run on this process's rank; rank 0 prints one JSON line."""
    with Ranks.from_environment(args.device) as ranks:
        load = Workload(args, ranks)
        estimated = [balance_of(result) for _, result in load.staged()]
        load.in_a_row()  # warm up
        row = statistics.median(load.in_a_row() for _ in range(args.visits))
        measured, times, totals = [], [], torch.zeros(3, dtype=torch.int64, device=ranks.device)
        for _ in range(args.visits):
            for milliseconds, result in load.staged():
                times.append(
                    ranks.all_reduce(torch.tensor(milliseconds, device=ranks.device), "max").tolist()
                )
                measured.append(balance_of(result))
                totals += torch.tensor(
                    [result[name] for name in ("splats", "visible", "sent")], device=ranks.device
                )
        splats, visible, sent = (x / len(times) for x in ranks.all_reduce(totals).tolist())
        report = {
            "views": args.batch,
            "ranks": ranks.world_size,
            "device": torch.cuda.get_device_name() if ranks.device.type == "cuda" else "cpu",
            "gaussians": load.total,
            "visible per step": visible,
            "splats per step": splats,
            "splats sent to other ranks": sent,
            "bytes per step": {"splats": 52 * sent, "gradients": (36 if ranks.memory is None else 48) * sent},
            "balance": {"estimated": max(estimated), "measured": max(measured)},
            "ms": {s: statistics.median(t[i] for t in times) for i, s in enumerate(STAGES)},
        }
        report["bytes per visible gaussian"] = sum(report["bytes per step"].values()) / max(visible, 1)
        report["ms"] |= {"alone": statistics.median(sum(t) for t in times), "step": row}
        if ranks.rank == 0:
            print("REPORT " + json.dumps(report), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--data", help="a capture; its points become the Gaussians")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument(
        "--visible-threshold",
        type=float,
        default=Config().lod.visible_threshold,
        help="as in `lod`; 0 where every camera sees a small part of the capture (%(default)s)",
    )
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the aerial scene (%(default)s)")
    parser.add_argument("--batch", type=int, nargs="+", default=[4], help="views per step (%(default)s)")
    parser.add_argument("--batches", type=int, default=6, help="different batches (%(default)s)")
    parser.add_argument("--visits", type=int, default=3, help="timed visits of every batch (%(default)s)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    args = parser.parse_args()
    if "WORLD_SIZE" in os.environ:
        [args.batch] = args.batch
        measure(args)
        return
    reports = []
    for batch, count in itertools.product(args.batch, args.ranks):
        command = [sys.executable, *torchrun(count), *sys.argv, "--batch", str(batch)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        line = next(text for text in done.stdout.splitlines() if text.startswith("REPORT "))
        reports.append(json.loads(line.removeprefix("REPORT ")))
        print("\n".join(exchange_lines({"results": reports})), flush=True)
    write_json(args.json, args.device, results=reports)


if __name__ == "__main__":
    main()
