# SPDX-License-Identifier: Apache-2.0
"""Compares the time of projection, forward and backward, with the bytes that it must move.

The scene's Gaussians are in random order; the last lines are for a table in Morton order with given active
rows, as in training.

python benchmarks/bm_project.py [--device cuda] [--gaussians 4000000] [--views 1 4]
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from harness import make_parser, write_json
from scenes import BenchmarkScene, aerial
from timing import copy_bandwidth, median_ms
from torch import Tensor

from blitzgs.ops.blocks import BLOCK_ROWS, cull_blocks, update_block_bounds_
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs, ProjectionOptions
from blitzgs.table.blocks import morton_order

COLUMNS = ("means", "quats", "scales", "opacities", "sh")
CULL_BYTES = 4 * (3 + 3 + 1)  # bytes of mean, scales and opacity, read for every Gaussian
VISIBLE_BYTES = 4 * (4 + 48)  # bytes of quaternion and SH, read for visible Gaussians
SPLAT_BYTES = 4 * (1 + 1 + 2 + 3 + 1 + 1 + 3 + 2 + 1)  # written
SPLAT_GRADIENT_BYTES = 4 * (2 + 3 + 1 + 3)  # read backward
GRADIENT_BYTES = 4 * 59  # parameters read and gradients written backward, each


def inputs_of(scene: BenchmarkScene, *active: Tensor) -> ProjectionInputs:
    options = ProjectionOptions(scene.width, scene.height, sh_degree=3)
    return ProjectionInputs(list(scene.raw().values()), (scene.viewmats, scene.Ks), options, active)


def in_morton_order(scene: BenchmarkScene) -> BenchmarkScene:
    order = morton_order(scene.means)
    sorted_columns = {name: getattr(scene, name)[order].contiguous() for name in COLUMNS}
    return dataclasses.replace(scene, **sorted_columns)


def active_rows(scene: BenchmarkScene) -> tuple[Tensor, Tensor]:
    raw = scene.raw()
    bounds = torch.empty(-(-len(scene.means) // BLOCK_ROWS), 8, device=scene.means.device)
    update_block_bounds_(bounds, None, raw["means"], raw["scales"])
    return cull_blocks(
        bounds, raw["means"], raw["scales"], scene.viewmats, scene.Ks, scene.width, scene.height, 0.01, 1e10
    ).listed()


def backward_arguments(scene: BenchmarkScene, splats: ProjectedSplats) -> tuple[Any, ...]:
    v = [torch.randn_like(getattr(splats, name)) for name in ("means2d", "conics", "opacities", "colors")]
    inputs = inputs_of(scene)
    return (
        inputs.gaussians, list(inputs.cameras), [splats.camera_ids, splats.visible_ids, splats.splat_offsets],
        inputs.options.ints, inputs.options.floats, v, None, False,
    )  # fmt: skip


def main() -> None:
    parser = make_parser(__doc__, repeats=10)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, nargs="+", default=[1, 4])
    args = parser.parse_args()
    bandwidth = copy_bandwidth(args.device, 2048 if args.device == "cuda" else 256)
    print(f"{args.gaussians} Gaussians, {args.device}, copy {bandwidth:.0f} GB/s")
    results: list[dict[str, object]] = []
    for views in args.views:
        scene = aerial(args.gaussians, args.device, views=views)
        forward = inputs_of(scene)
        splats = project_splats(forward)
        visible, n_splats, _ = splats.counts.tolist()

        def report(
            name: str, milliseconds: float, megabytes: float, n_splats: int = n_splats, views: int = views
        ) -> None:
            floor = megabytes / bandwidth
            results.append(
                {"views": views, "work": name, "splats": n_splats, "ms": milliseconds, "floor_ms": floor}
            )
            each = 1e6 * milliseconds / max(n_splats, 1)
            print(f"  {name:32s} {milliseconds:9.3f} ms  {each:7.1f} ns a splat  byte floor {floor:.3f} ms")

        print(f"{views} view(s): {visible} visible, {n_splats} splats")
        moved = VISIBLE_BYTES * visible + SPLAT_BYTES * n_splats
        time = median_ms(project_splats, [(forward,)], args.repeats)
        report("forward, all candidates", time, (CULL_BYTES * args.gaussians + moved) / 1e6)
        time = median_ms(project_splats, [(inputs_of(scene, splats.visible_ids),)], args.repeats)
        report("forward, the visible given", time, (CULL_BYTES * visible + moved) / 1e6)
        back = (2 * GRADIENT_BYTES * visible + SPLAT_GRADIENT_BYTES * n_splats) / 1e6
        time = median_ms(torch.ops.blitzgs.project_bwd, [backward_arguments(scene, splats)], args.repeats)
        report("backward", time, back)
        del splats, forward
        scene = in_morton_order(scene)
        active = active_rows(scene)
        forward = inputs_of(scene, *active)
        splats = project_splats(forward)
        time = median_ms(project_splats, [(forward,)], args.repeats)
        report(f"Morton order, {len(active[0])} active", time, (CULL_BYTES * len(active[0]) + moved) / 1e6)
        time = median_ms(torch.ops.blitzgs.project_bwd, [backward_arguments(scene, splats)], args.repeats)
        report("Morton order, backward", time, back)
    if args.json:
        write_json(args.json, args.device, gaussians=args.gaussians, results=results)


if __name__ == "__main__":
    main()
