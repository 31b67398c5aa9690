# SPDX-License-Identifier: Apache-2.0
"""Measures training beyond the memory of a GPU: steps with all Gaussians on the device, and with a pool.

    python benchmarks/bm_offload.py [--gaussians 16000000] [--ratios 1 2 4] [--steps 40] [--json FILE]

The scene is `scenes.aerial` with SH degree 3 under a survey: cameras on parallel lines over the whole square
kilometre, 150 m high, which look 60 degrees down, each at a few percent of the Gaussians. The trainer's own
steps run with all Gaussians on the device ("resident"), then with a pool for 1 / ratio of them ("4x": a
quarter; `blitzgs.training.offload`). The views come in random order, along the sampler's tour as in a
training with a pool, or along the flight lines. Measured are: the mean wall time of a step, after as many
steps to warm up; the bytes moved between host and device in a step; the share of visible blocks that were
there and not loaded for it; and "sweep", the time to move the whole table through the pool and back, as
events of the schedule do.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from bm_step import LOSS, make_optimiser, make_table, random_photographs, take_step
from harness import make_parser, seconds_of, write_json
from report_tables import offload_lines
from scenes import BenchmarkScene, aerial, look_at

from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.cameras import RunCamera
from blitzgs.table.blocks import morton_order
from blitzgs.table.host_table import HostTable
from blitzgs.table.pool import Pool, PoolError
from blitzgs.table.table import GaussianTable
from blitzgs.training.offload import OffloadingStepper, UpcomingCameras
from blitzgs.training.sampler import BatchSampler, tour_of
from blitzgs.training.step import Stepper
from blitzgs.view.views import Space, ViewSet

LINES, VIEWS_A_LINE = 12, 20
HEIGHT, LOOKS_DOWN = 150.0, math.radians(60)
REACH = 400.0  # metres from the middle to the outermost points that cameras look at


def survey(scene: BenchmarkScene) -> list[RunCamera]:
    """Return cameras with the scene's intrinsics at all places of the survey, line by line."""
    K = scene.Ks[0].double().cpu().numpy()
    cameras = []
    for line, x in enumerate(np.linspace(-REACH, REACH, LINES)):
        places = np.linspace(-REACH, REACH, VIEWS_A_LINE)
        for y in places if line % 2 == 0 else places[::-1]:
            pose = look_at((x, y - HEIGHT / math.tan(LOOKS_DOWN), HEIGHT), (x, y, 0.0)).double().numpy()
            cameras.append(RunCamera(f"{len(cameras):03}", scene.width, scene.height, K, pose))
    return cameras


class FlightOrder(BatchSampler):
    """Chooses views in the order of the flight."""

    def batch(self, step: int) -> list[int]:
        """Return the next view."""
        return [step % (LINES * VIEWS_A_LINE)]


class Survey:
    """The parts that the steps of all arms use."""

    def __init__(self, scene: BenchmarkScene, device: torch.device) -> None:
        cameras = survey(scene)
        self.ranks = Ranks(device=device)
        self.views = ViewSet(cameras, Space((0.0, 0.0, 0.0), 1.0, 1.0), device)
        points = scene.means[:: max(1, len(scene.means) // 100_000)].double().cpu().numpy()
        sizes, tour = [0] * len(cameras), tour_of(cameras, points)
        self.orders = {
            "random": BatchSampler(sizes, 1, seed=0),
            "tour": BatchSampler(sizes, 1, seed=0, tour=tour),
            "flight": FlightOrder(sizes, 1, seed=0),
        }
        self.photographs = random_photographs(self.views.pick([0]))
        self.optimiser = make_optimiser(Schedule(ScheduleConfig(batch_size=1)), device)

    def steps(self, stepper: Stepper, order: BatchSampler, first: int, count: int) -> float:
        """Take steps; return the seconds of one."""

        def take() -> None:
            for step in range(first, first + count):
                indices = order.batch(step - 1)
                batch = replace(self.photographs, indices=indices, views=self.views.pick(indices))
                take_step(stepper, step, batch)

        return seconds_of(self.ranks.device, take) / count


def table_bytes(table: GaussianTable) -> int:
    return sum(table[name].nbytes for name in table)


def measure_resident(table: GaussianTable, over: Survey, steps: int) -> list[dict[str, Any]]:
    """Measure steps with all Gaussians on the device."""
    results, at = [], 1
    stepper = Stepper(table, over.optimiser, TileOwners(over.ranks), LOSS, 1.0)
    for name, order in over.orders.items():
        over.steps(stepper, order, at, steps)
        seconds = over.steps(stepper, order, at + steps, steps)
        at += 2 * steps
        results.append({"arm": "resident", "order": name, "step_ms": 1e3 * seconds})
    stepper.catch_up(at - 1)
    return results


def measure_pool(table: HostTable, ratio: float, over: Survey, steps: int, at: int) -> list[dict[str, Any]]:
    """Measure steps with a pool; `at` is the first step."""
    results = []
    budget = int(table_bytes(table) / ratio)
    pool = Pool(table, over.ranks.device, budget, over.optimiser.pending_table)
    for name, order in over.orders.items():
        upcoming = UpcomingCameras(order, list(range(LINES * VIEWS_A_LINE)), over.views)
        stepper = OffloadingStepper(pool, upcoming, over.optimiser, TileOwners(over.ranks), LOSS, 1.0)
        result: dict[str, Any] = {"arm": f"{ratio:g}x", "order": name, "pool_gb": budget / 1e9}
        results.append(result)
        try:
            over.steps(stepper, order, at, steps)
        except PoolError as error:
            result["failed"] = str(error)
            at += 2 * steps
            continue
        before = pool.moved
        seconds = over.steps(stepper, order, at + steps, steps)
        moved = pool.moved.since(before)
        at += 2 * steps
        result |= {"step_ms": 1e3 * seconds} | moved.values()
        result |= {
            "in_gb_per_s": moved.bytes_in / 1e9 / (seconds * steps),
            "out_gb_per_s": moved.bytes_out / 1e9 / (seconds * steps),
            "blocks_in_view": moved.needed / steps,
        }
        result["sweep_s"] = seconds_of(over.ranks.device, partial(stepper.catch_up, at - 1))
    return results


def run(gaussians: int, ratios: list[float], steps: int, device: torch.device) -> Iterator[dict[str, Any]]:
    """Measure all arms on one scene; yield the results so far after each pool."""
    scene = aerial(gaussians, device)
    scene = scene.rows(morton_order(scene.means))
    over = Survey(scene, device)
    table = make_table(scene)
    about = {"scene": scene.name, "table_gb": table_bytes(table) / 1e9}
    del scene
    results = measure_resident(table, over, steps)
    by_order = {result["order"]: result["step_ms"] for result in results}
    yield about | {"results": with_cost(results, by_order)}
    at = 1 + 2 * steps * len(over.orders)
    host = {}
    for name in list(table.columns):
        host[name] = table.columns.pop(name).cpu()
    begin = time.perf_counter()
    home = HostTable(host, pinned=device.type == "cuda")
    about["pin_s"] = time.perf_counter() - begin
    for ratio in ratios:
        results += measure_pool(home, ratio, over, steps, at)
        at += 2 * steps * len(over.orders)
        yield about | {"results": with_cost(results, by_order)}


def with_cost(results: list[dict[str, Any]], resident: dict[str, float]) -> list[dict[str, Any]]:
    """Add to each arm that ran the time of its step over that of the resident one in the same order."""
    return [
        result | {"cost": result["step_ms"] / resident[result["order"]]} if "step_ms" in result else result
        for result in results
    ]


def main() -> None:
    """Measure, and print a table; the JSON file is written again after each pool."""
    parser = make_parser(__doc__)
    parser.add_argument("--gaussians", type=int, default=16_000_000)
    parser.add_argument("--ratios", type=float, nargs="+", default=[1, 2, 4])
    parser.add_argument("--steps", type=int, default=40)
    args = parser.parse_args()
    with torch.no_grad():
        device = torch.device(args.device)
        for found in run(args.gaussians, args.ratios, args.steps, device):
            write_json(args.json, args.device, **found)
    print(f"{found['scene']}, table {found['table_gb']:.2f} GB")
    print("\n".join(offload_lines(found)))
    for row in found["results"]:
        if "failed" in row:
            print(f"{row['arm']}, {row['order']}: {row['failed']}")


if __name__ == "__main__":
    main()
