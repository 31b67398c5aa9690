# SPDX-License-Identifier: Apache-2.0
"""Measures the log of births and deaths: density events with and without it, and its check at a checkpoint.

    python benchmarks/bm_lineage.py [--gaussians 2000000] [--candidates 0.02] [--json FILE]

Every event clones or splits a share of the Gaussians and prunes about as many. Times are medians of wall time
with the device idle before and after. "check" writes the rows of all events to disk and compares births less
deaths with the population. A run has an event every 100 images and this check at each checkpoint.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import torch
from harness import make_parser, report
from scenes import aerial

from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.population.density import DensityRules, densify
from blitzgs.population.lineage import Ledger, Lineage, initial_births

RULES = DensityRules(grad_threshold=0.5, clone_scale=1.0, min_opacity=0.005)


def shake(table: GaussianTable, share: float, event: int) -> None:
    """Give a share of the rows large gradients, and an equal share opacities that are pruned."""
    generator = torch.Generator(table.device).manual_seed(event)
    draws = torch.rand(len(table), generator=generator, device=table.device)
    table["grad_count"].fill_(1)
    table["grad_sum"].copy_((draws < share).float())
    table["opacities"].masked_fill_(draws > 1 - share, -9.0)


def events(table: GaussianTable, share: float, count: int, lineage: Lineage | None) -> list[float]:
    """Return the seconds of each of several density events."""
    ranks, seconds = Ranks(device=table.device), []
    for event in range(count):
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


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__)
    parser.add_argument("--gaussians", type=int, default=2_000_000)
    parser.add_argument("--candidates", type=float, default=0.02, help="share that grows at an event")
    parser.add_argument("--events", type=int, default=20)
    options = parser.parse_args(arguments)
    scene = aerial(options.gaussians, options.device)
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        plain = events(GaussianTable.create(scene.raw()), options.candidates, options.events, None)
        table = GaussianTable.create(scene.raw())
        lineage = Lineage(Path(folder), Ranks(device=table.device), 0, Ledger())
        lineage.born(initial_births(table["id"], table["parent"], table["means"]), 0)
        logged = events(table, options.candidates, options.events, lineage)
        begin = now(table.device)
        lineage.flush_and_check(table["id"], options.events)
        check = now(table.device) - begin
        lineage.close()
        megabytes = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
    times = {"event": plain, "event, logged": logged, "check": [check]}
    rows = [{"work": name, "ms": 1e3 * statistics.median(values)} for name, values in times.items()]
    title = (
        f"Lineage: {options.events} events on {scene.name}, {options.candidates:.0%} grow; {megabytes:.0f} MB"
    )
    report(title, rows, options.json, options.device)


if __name__ == "__main__":
    main()
