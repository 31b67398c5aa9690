# SPDX-License-Identifier: Apache-2.0
"""Compares the importance sweep with forward renders of the same views, in one run.

    python benchmarks/bm_importance.py [--gaussians 4000000] [--views 32] [--visits 8] [--batch 4]
        [--json FILE]

The views advance over one synthetic square kilometre (`scenes.aerial`), whose Gaussians are in Morton order,
as the trainer keeps them. They are visited several times, as if there were as many views, because a capture
has hundreds of views. "renders": `pipeline.forward` of all views in batches, with colours of degree 3;
"renders of what is visible": the same, but blocks of Gaussians outside the views are not read, as in an
evaluation; "survey": the contribution of each Gaussian to the views; "sweep": the survey, the exact 99 % cut
of each view, scores, phi and the cull matrix. Survey and sweep do not read blocks outside the views either.
"density" and "energy" are the scores; only "energy" needs the sums of squares. The last rows are the
compositing kernels alone, for the first batch. Times are medians of wall time with the device idle before and
after; the sweep should take no longer than the renders.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from harness import make_parser, report
from scenes import BenchmarkScene, aerial

from blitzgs.config.fields import ScoreRule
from blitzgs.distributed.group import Ranks
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.frame.survey import survey
from blitzgs.frame.transport import LocalTransport
from blitzgs.population.importance import ViewBatch, sweep
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.view.visible import VisibleFinder

OPTIONS = RenderOptions(sh_degree=3, near_plane=0.01, far_plane=1e6)


def batches_of(scene: BenchmarkScene, length: int, visits: int) -> list[ViewBatch]:
    """Return the scene's views, `length` at a time, `visits` times with columns of their own."""
    count = len(scene.viewmats)
    return [
        ViewBatch(
            list(range(visit * count + begin, visit * count + min(begin + length, count))),
            Views(
                scene.viewmats[begin : begin + length],
                scene.Ks[begin : begin + length],
                scene.width,
                scene.height,
            ),
        )
        for visit in range(visits)
        for begin in range(0, count, length)
    ]


def median_ms(work: Callable[[], Any], repeats: int, device: torch.device) -> float:
    """Return the median wall time of some work, milliseconds, after one round that is not counted."""
    times = []
    for _ in range(repeats + 1):
        _wait(device)
        begin = time.perf_counter()
        work()
        _wait(device)
        times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times[1:])


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def measure(scene: BenchmarkScene, length: int, visits: int, repeats: int) -> list[dict[str, Any]]:
    """Time renders, survey and sweep of all views, and the compositing of the first batch."""
    table, batches = GaussianTable.create(scene.raw()), batches_of(scene, length, visits)
    table.permute(morton_order(table["means"]))
    ranks, transport = Ranks(device=table.device), LocalTransport()
    n_views = visits * len(scene.viewmats)

    def renders() -> None:
        for batch in batches:
            pipeline.forward(table, batch.views, OPTIONS, transport=transport)

    def renders_of_visible() -> None:
        finder = VisibleFinder(table)
        for batch in batches:
            active = finder.find(*batch.views.as_arguments(), OPTIONS.limits).active
            pipeline.forward(table, batch.views, OPTIONS, active, transport=transport)

    def surveys() -> None:
        finder = VisibleFinder(table)
        for batch in batches:
            active = finder.find(*batch.views.as_arguments(), OPTIONS.limits).active
            survey(table, batch.views, OPTIONS, transport=transport, active=active)

    def sweeps(rule: ScoreRule) -> None:
        sweep(table, batches, n_views, OPTIONS, ranks, rule=rule)

    frame = pipeline.forward(table, batches[0].views, OPTIONS, transport=transport)
    splats = frame.splats
    grid = pipeline.tile_grid(batches[0].views, OPTIONS, None)
    shapes = (splats.means2d, splats.conics, splats.opacities)
    lists = frame.saved.lists

    def composite() -> None:
        torch.ops.blitzgs.rasterize_fwd(*shapes, splats.colors, None, *lists, grid, False, False, None)

    def contribute(squares: bool) -> None:
        torch.ops.blitzgs.contributions(*shapes, *lists, grid, None, squares)

    works = {
        "renders": renders,
        "renders of what is visible": renders_of_visible,
        "survey": surveys,
        "sweep, density": partial(sweeps, "density"),
        "sweep, energy": partial(sweeps, "energy"),
    }
    kernels = {
        "rasterize_fwd, one batch": composite,
        "contributions, one batch": partial(contribute, False),
        "contributions with squares, one batch": partial(contribute, True),
    }
    times = {name: median_ms(work, repeats, table.device) for name, work in (works | kernels).items()}
    rows = []
    for name, ms in times.items():
        views = n_views if name in works else len(batches[0].columns)
        against = times["renders"] if name in works else times["rasterize_fwd, one batch"]
        rows.append({"work": name, "ms": ms, "ms per view": ms / views, "relative": ms / against})
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__, repeats=5)
    parser.add_argument("--gaussians", type=int, default=4_000_000)
    parser.add_argument("--views", type=int, default=32, help="different views (%(default)s)")
    parser.add_argument("--visits", type=int, default=8, help="of each view (%(default)s)")
    parser.add_argument("--batch", type=int, default=4, help="views at a time")
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1064), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args(arguments)
    width, height = options.size
    scene = aerial(options.gaussians, options.device, views=options.views, width=width, height=height)
    with torch.no_grad():
        rows = measure(scene, options.batch, options.visits, options.repeats)
    title = (
        f"Importance sweep: {scene.name}, {options.views * options.visits} views of {width} x {height}, "
        f"{options.views} of them different"
    )
    report(title, rows, options.json, options.device)


if __name__ == "__main__":
    main()
