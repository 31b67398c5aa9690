# SPDX-License-Identifier: Apache-2.0
"""A training step that sees the same in ever larger tables: its time, and the memory it needs for a while.

    python benchmarks/bm_scratch.py [--millions 4 16 64] [--views 1] [--repeats 20] [--json FILE]

The first 4 M Gaussians are `bm_step.py`'s aerial scene; the others are copies of it, 5 km apart behind the
cameras. The step is that of `bm_step.py`: every row is 0 to 39 steps behind. Time is the median over steps of
the sum of their stages by CUDA events; scratch is the most memory that a step asks for at a time, beyond the
table and what stays from step to step. Torch hands out more than that: it rounds, and for more than 1 MiB it
takes a free block whole where 1 MiB or less of it would be left. Beside the two, all that a step asks for in
turn, in pieces of up to 1 MiB and in larger ones, and how many pieces these are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from bm_step import OurStep, measure
from harness import make_parser, report
from scenes import BenchmarkScene, aerial

from blitzgs.table.blocks import morton_order

SEEN, APART = 4_000_000, 5000.0
COLUMNS = ("means", "quats", "scales", "opacities", "sh")


def make_scene(gaussians: int, views: int) -> BenchmarkScene:
    """Return the aerial scene with copies of it behind the cameras, in Morton order."""
    scene = aerial(SEEN, "cuda", views=views)
    copies = -(-gaussians // SEEN)
    columns = {name: torch.cat([getattr(scene, name)] * copies)[:gaussians] for name in COLUMNS if copies > 1}
    if columns:
        columns["means"][:, 1] -= APART * (torch.arange(gaussians, device="cuda") // SEEN)
        scene = replace(scene, **columns)
    order = morton_order(scene.means)
    for name in COLUMNS:
        scene = replace(scene, **{name: getattr(scene, name)[order]})
    return scene


def scratch_of(step: OurStep) -> dict[str, float]:
    """Return what a step allocates beyond what is allocated before it."""
    step.prepare()
    torch.cuda.synchronize()
    before = torch.cuda.memory_stats()
    torch.cuda.reset_peak_memory_stats()
    step.take(lambda _: None)
    torch.cuda.synchronize()
    after = torch.cuda.memory_stats()

    def most(what: str) -> int:
        return int(after[f"{what}.all.peak"] - before[f"{what}.all.current"])

    def sum_of(what: str, pool: str) -> int:
        return int(after[f"{what}.{pool}.allocated"] - before[f"{what}.{pool}.allocated"])

    return {
        "scratch MB": most("requested_bytes") / 1e6,
        "handed out MB": most("allocated_bytes") / 1e6,
        "small in all MB": sum_of("requested_bytes", "small_pool") / 1e6,
        "small pieces": sum_of("allocation", "small_pool"),
        "large in all MB": sum_of("requested_bytes", "large_pool") / 1e6,
        "large pieces": sum_of("allocation", "large_pool"),
    }


def run(millions: float, views: int, repeats: int) -> dict[str, Any]:
    """Measure one table."""
    gaussians = round(1e6 * millions)
    step = OurStep(make_scene(gaussians, views))
    torch.cuda.empty_cache()
    stages = measure(step, repeats)
    scratch = sorted((scratch_of(step) for _ in range(5)), key=lambda sizes: sizes["scratch MB"])[2]
    return {
        "gaussians": gaussians,
        "views": views,
        "visible": step.visible,
        "ms": stages[-1][1],
        **scratch,
        "scratch B a Gaussian": 1e6 * scratch["scratch MB"] / gaussians,
    }


def main() -> None:
    parser = make_parser(__doc__, device=None, repeats=20)
    parser.add_argument("--millions", nargs="+", type=float, default=[4, 16, 64], help="Gaussians, 1e6")
    parser.add_argument("--views", type=int, default=1, help="views in a batch")
    args = parser.parse_args()
    rows = []
    for millions in args.millions:
        rows.append(run(millions, args.views, args.repeats))
        torch.cuda.empty_cache()
    for row in rows:
        row["ms to the first"] = row["ms"] / rows[0]["ms"]
        row["scratch to the first"] = row["scratch MB"] / rows[0]["scratch MB"]
    report("A step that sees the same in larger tables", rows, args.json, "cuda")


if __name__ == "__main__":
    main()
