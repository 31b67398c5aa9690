# SPDX-License-Identifier: Apache-2.0
"""A training step on several ranks: time by stage, bytes exchanged, balance, and what half precision costs.

    python benchmarks/bm_exchange.py --data DIR [--downscale 2] [--ranks 1 2 4] [--batch 4]
    python benchmarks/bm_exchange.py --gaussians 16000000 --device cuda [--ranks 1 2 4]

With --data the Gaussians are the octree of the capture's points, seen from its training views; otherwise the
`aerial` scene of `scenes.py`. Each number of ranks runs under torchrun; every batch is visited twice, the
first time with tiles divided by an estimate, the second by their measured cost. Times are of the second
visit: the median over batches of the slowest rank.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from scenes import aerial
from torch import Tensor

from blitzgs.distributed.exchange import Splats, plan_route, send, send_back
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import LOSS_REACH, TILE_COST, Share, TileOwners, cost_balance
from blitzgs.distributed.pixels import collect_images
from blitzgs.model import GaussianTable
from blitzgs.ops.project import Rows
from blitzgs.pipeline import Frame, RenderOptions, Views
from blitzgs.population.initialisation import octree_gaussians
from blitzgs.scene.capture import load_capture
from blitzgs.training.batches import Batch
from blitzgs.training.config import Config
from blitzgs.training.loss import loss_terms
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.schedule import Schedule
from blitzgs.training.views import Space, ViewSet, camera_centres, render_options
from blitzgs.view.levels import measure_levels

ops = torch.ops.blitzgs
STAGES = (
    "project",
    "exchange",
    "sort",
    "raster",
    "loss",
    "raster back",
    "exchange back",
    "project back",
    "optimiser",
)


class Clock:
    """Marks the ends of stages, on the device's own time."""

    def __init__(self, device: torch.device) -> None:
        self.cuda = device.type == "cuda"
        self.marks: list[Any] = []

    def mark(self) -> None:
        """End a stage."""
        if self.cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self.marks.append(event)
        else:
            self.marks.append(time.perf_counter())

    def milliseconds(self) -> list[float]:
        """Time between consecutive marks."""
        if self.cuda:
            torch.cuda.synchronize()
        pairs = zip(self.marks, self.marks[1:], strict=False)
        return [a.elapsed_time(b) if self.cuda else 1000 * (b - a) for a, b in pairs]


class Workload:
    """A shard of a scene and batches of views of it."""

    def __init__(self, args: argparse.Namespace, ranks: Ranks) -> None:
        self.ranks, config = ranks, Config()
        if args.data:
            capture = load_capture(args.data, downscale=args.downscale)
            space = Space.of(capture.offset, capture.extent)
            points = torch.from_numpy(capture.points) / space.unit
            centres = camera_centres([capture.cameras[i] for i in capture.train], space)
            table = octree_gaussians(
                points,
                torch.from_numpy(capture.colors),
                centres,
                measure_levels(points, centres, config.lod.fork, config.lod.base_resolution),
                visible_threshold=config.lod.visible_threshold,
                sh_degree=3,
                opacity=0.5,
            )
            self.options = render_options(config, space, 3)
            views = ViewSet(list(capture.cameras), space, ranks.device)
            chosen = capture.train[: args.batch * args.batches]
            groups = [chosen[i : i + args.batch] for i in range(0, len(chosen), args.batch)]
            self.batches = [(group, views.pick(group)) for group in groups]
            extent = space.extent
        else:
            scene = aerial(args.gaussians, views=args.batch * args.batches)
            table = GaussianTable.create(scene.raw() | _bookkeeping(args.gaussians))
            self.options = RenderOptions(sh_degree=3, near_plane=0.1, far_plane=1e6)
            self.batches = [
                (
                    list(range(first, first + args.batch)),
                    Views(
                        scene.viewmats[first : first + args.batch].to(ranks.device),
                        scene.Ks[first : first + args.batch].to(ranks.device),
                        scene.width,
                        scene.height,
                    ),
                )
                for first in range(0, len(scene.viewmats), args.batch)
            ]
            extent = 500.0
        self.total = len(table)
        rows = torch.arange(ranks.rank, self.total, ranks.world_size)
        self.table = GaussianTable({name: table[name][rows].to(ranks.device) for name in table})
        self.optimiser = LazyAdam(config.optimiser, Schedule(config.schedule), extent, ranks.device)
        self.loss, self.owners, self.steps = config.loss, TileOwners(ranks), 0

    def step(self, keys: list[int], views: Views, update: bool, half: bool = False) -> dict[str, Any]:
        """Take one step, stage by stage as `blitzgs.pipeline` does; measure it."""
        table, options, ranks, clock = self.table, self.options, self.ranks, Clock(self.ranks.device)
        share, count, size = None, len(views), (views.width, views.height, options.tile_size)
        if ranks.world_size > 1:
            share = Share(ranks, self.owners.divide(keys, *size, LOSS_REACH), half)
        targets = torch.full(
            (count, views.height, views.width, 3), 128, dtype=torch.uint8, device=ranks.device
        )
        samples = torch.full((count,), 3.0 * views.height * views.width, device=ranks.device)
        batch = Batch(keys, targets, None, samples, share.ranges if share else None)
        ranks.barrier()
        clock.mark()
        rows = Rows(
            *ops.project_fwd(
                *table.parameters, views.viewmats, views.Ks, None, None, *size, options.sh_degree,
                options.near_plane, options.far_plane, options.eps2d, 0.0, False, True,
            )
        )  # fmt: skip
        clock.mark()
        ids = table["id"][rows.gaussian_ids]
        splats = Splats(
            rows.means2d, rows.conics, rows.opacities, rows.colors, rows.depths, rows.camera_ids, ids
        )
        route, isects, tiles = None, int(rows.counts[2]), (0, -1)
        visible = rows.counts[:1].expand(count).to(ranks.device)
        if share is not None:
            route = plan_route(splats, share.ranges, ranks, half)
            splats = send(splats, route, ranks)
            isects, tiles, visible = route.n_isects, share.composited, route.visible
        clock.mark()
        lists = ops.intersect(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, splats.ids,
            count, *size, *tiles, isects,
        )  # fmt: skip
        clock.mark()
        values = (splats.means2d, splats.conics, splats.opacities, splats.colors, None, *lists)
        frame = Frame(
            views, options, rows, splats, share, route, visible, None, *lists,
            *ops.rasterize_fwd(*values, count, *size, *tiles),
        )  # fmt: skip
        clock.mark()
        work = frame.tile_work.clone()
        if share is not None:
            self.owners.record(keys, frame.tile_work, share.ranges)
        terms = loss_terms(frame, batch, self.loss, 1.0)
        clock.mark()
        *gradients, _ = ops.rasterize_bwd(
            *values, frame.renders, frame.transmittances, frame.last_ids, frame.aux, terms.v_renders, None,
            count, *size, *(tiles if share is None else share.tiles), False, False,
        )  # fmt: skip
        clock.mark()
        if share is not None and route is not None:
            gradients = send_back(gradients, route, ranks)
        clock.mark()
        v_means2d, v_conics, v_opacities, v_colors = gradients
        *parameters, _ = ops.project_bwd(
            *table.parameters, views.viewmats, views.Ks, rows.camera_ids, rows.visible_ids, rows.row_offsets,
            views.width, views.height, options.sh_degree, options.eps2d, False, True, v_means2d, v_conics,
            None, v_opacities, v_colors, terms.scale_reg, False,
        )  # fmt: skip
        clock.mark()
        if update:
            self.steps += 1
            self.optimiser.step(table, tuple(parameters), rows.visible_ids, self.steps)
        clock.mark()
        return {
            "times": clock.milliseconds(),
            "rows": len(rows.gaussian_ids),
            "visible": len(rows.visible_ids),
            "sent": 0 if route is None else sum(route.sent) - route.sent[ranks.rank],
            "balance": _balance(work, share, ranks),
            "frame": frame,
            "gradients": parameters,
        }


def _bookkeeping(count: int) -> dict[str, Tensor]:
    return {
        "last_step": torch.zeros(count, dtype=torch.int32),
        "id": torch.arange(count),
        "parent": torch.full((count,), -1),
        "birth": torch.zeros(count, dtype=torch.int32),
        "level": torch.zeros(count, dtype=torch.uint8),
    }


def _balance(work: Tensor, share: Share | None, ranks: Ranks) -> float:
    if share is None:
        return 1.0
    begin, end = share.tiles
    work[:begin], work[end:] = 0, 0
    cost = ranks.all_reduce(work).double().cpu().numpy() + TILE_COST
    return cost_balance(cost, share.ranges.bounds)


def half_precision_error(load: Workload) -> dict[str, float]:
    """Compare a step with half-precision exchange to the exact one: image and gradients of the means."""
    keys, views = load.batches[0]
    exact, half = (load.step(keys, views, False, half) for half in (False, True))
    images = []
    for result in (exact, half):
        image, share = result["frame"].renders.clone(), result["frame"].share
        collect_images(image, share.ranges, load.ranks, 0)
        images.append(image)
    error = (images[0] - images[1]).abs()
    a, b = (result["gradients"][0] for result in (exact, half))
    sums = load.ranks.all_reduce(torch.stack(((a - b).square().sum(), a.square().sum())))
    return {
        "image max": error.max().item(),
        "image mean": error.mean().item(),
        "gradient": (sums[0] / sums[1]).sqrt().item(),
    }


def measure(args: argparse.Namespace) -> None:
    """Run on this process's rank; rank 0 prints one JSON line."""
    with Ranks.from_environment(args.device) as ranks:
        load = Workload(args, ranks)
        balances, times, totals = [[], []], [], torch.zeros(3, dtype=torch.int64, device=ranks.device)
        for visit in range(2):
            for keys, views in load.batches:
                result = load.step(keys, views, update=True)
                balances[visit].append(result["balance"])
                if visit == 1:
                    slowest = torch.tensor(result["times"], device=ranks.device)
                    times.append(ranks.all_reduce(slowest, "max").tolist())
                    counts = [result[name] for name in ("rows", "visible", "sent")]
                    totals += torch.tensor(counts, device=ranks.device)
        rows, visible, sent = (x / len(load.batches) for x in ranks.all_reduce(totals).tolist())
        report = {
            "ranks": ranks.world_size,
            "device": torch.cuda.get_device_name() if ranks.device.type == "cuda" else "cpu",
            "gaussians": load.total,
            "visible per step": visible,
            "rows per step": rows,
            "rows sent to other ranks": sent,
            "bytes per step": {"splats": 52 * sent, "gradients": 36 * sent},
            "balance": {
                name: max(values) for name, values in zip(("estimated", "measured"), balances, strict=True)
            },
            "ms": {s: statistics.median(t[i] for t in times) for i, s in enumerate(STAGES)},
        }
        report["bytes per visible gaussian"] = sum(report["bytes per step"].values()) / max(visible, 1)
        report["ms"]["step"] = statistics.median(sum(t) for t in times)
        if ranks.world_size > 1:
            report["half precision"] = half_precision_error(load)
        if ranks.rank == 0:
            print("REPORT " + json.dumps(report), flush=True)


def show(report: dict[str, Any]) -> None:
    """Print one number of ranks."""
    print(f"\n{report['ranks']} rank(s), {report['device']}, {report['gaussians']:,} Gaussians")
    print("  " + "  ".join(f"{stage} {ms:.2f}" for stage, ms in report["ms"].items()) + "  (ms)")
    exchange = report["ms"]["exchange"] + report["ms"]["exchange back"]
    if report["ranks"] > 1:
        parts = "  ".join(f"{name} {size / 1e6:.2f}" for name, size in report["bytes per step"].items())
        print(
            f"  MB between ranks per step: {parts}; "
            f"{report['bytes per visible gaussian']:.1f} bytes per visible Gaussian"
        )
        print(
            f"  {report['visible per step']:,.0f} visible Gaussians, {report['rows per step']:,.0f} rows, "
            f"{report['rows sent to other ranks']:,.0f} of them sent to another rank; "
            f"exchange {100 * exchange / report['ms']['step']:.1f} % of the step"
        )
        print(
            "  largest cost over the mean: " + "  ".join(f"{k} {v:.3f}" for k, v in report["balance"].items())
        )
        print("  half precision: " + "  ".join(f"{k} {v:.2e}" for k, v in report["half precision"].items()))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", help="a capture; its points become the Gaussians")
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the aerial scene (%(default)s)")
    parser.add_argument("--batch", type=int, default=4, help="views per step (%(default)s)")
    parser.add_argument("--batches", type=int, default=6, help="different batches (%(default)s)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="write the reports here")
    args = parser.parse_args()
    if "WORLD_SIZE" in os.environ:
        measure(args)
        return
    reports = []
    for count in args.ranks:
        torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
        done = subprocess.run(
            [sys.executable, *torchrun, *sys.argv], stdout=subprocess.PIPE, text=True, check=True
        )
        line = next(text for text in done.stdout.splitlines() if text.startswith("REPORT "))
        reports.append(json.loads(line.removeprefix("REPORT ")))
        show(reports[-1])
    if args.json:
        args.json.write_text(json.dumps(reports, indent=1))


if __name__ == "__main__":
    main()
