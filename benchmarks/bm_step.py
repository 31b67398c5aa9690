# SPDX-License-Identifier: Apache-2.0
"""A whole training step on CUDA against gsplat with torch's fused Adam, stage by stage.

    python benchmarks/bm_step.py [--scenes aerial4 aerial16] [--views 1] [--order morton] [--repeats 20]

SH degree 3, every parameter trained, gradients of L1 + SSIM. Ours is the trainer's step: find the active
rows, catch them up (they are 0 to 39 steps behind), render, compare, differentiate, step the visible rows,
note the blocks that changed. gsplat: `rasterization` (not packed) and autograd, the same loss kernel,
`torch.optim.Adam(fused=True)` over every row. Both get the same scene, by default in Morton order, as the
trainer keeps its table. Medians of CUDA event times, ms.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import torch
from bm_render import CallRender, event_times
from scenes import BenchmarkScene, aerial, garden_like
from torch import Tensor

from blitzgs import pipeline
from blitzgs.model import EXP_AVG_SQS, EXP_AVGS, PARAMETERS, GaussianTable
from blitzgs.ops.photometric import photometric_fwd_bwd
from blitzgs.pipeline import Active, RenderOptions, Views
from blitzgs.training.config import OptimiserConfig, ScheduleConfig
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.schedule import Schedule
from blitzgs.view.blocks import BlockIndex, morton_order

SSIM_WEIGHT, STEP, RATE, BEHIND = 0.2, 2000, 1e-6, 40
GAUSSIANS = {"aerial1": 1_000_000, "aerial4": 4_000_000, "aerial16": 16_000_000}
OPTIONS = RenderOptions(sh_degree=3, near_plane=0.01, far_plane=1e10)


def make_scene(name: str, views: int, order: str) -> BenchmarkScene:
    """Return a scene of `GAUSSIANS` or "garden", its rows in the order asked for."""
    if name == "garden":
        scene = garden_like(device="cuda", views=views)
    else:
        scene = aerial(GAUSSIANS[name], "cuda", views=views)
    if order == "random":  # as it was drawn
        return scene
    rows = morton_order(scene.means)
    columns = ("means", "quats", "scales", "opacities", "sh")
    return replace(scene, **{column: getattr(scene, column)[rows] for column in columns})


class Loss:
    """(1 - w) L1 + w (1 - SSIM) against a fixed random photo, and its gradient."""

    def __init__(self, scene: BenchmarkScene) -> None:
        shape = (len(scene.viewmats), scene.height, scene.width, 3)
        self.target = torch.randint(0, 256, shape, dtype=torch.uint8, device="cuda")
        samples = self.target.numel()
        self.weights = [
            torch.full((shape[0],), w / samples, device="cuda") for w in (1 - SSIM_WEIGHT, -SSIM_WEIGHT)
        ]

    def gradient(self, image: Tensor) -> Tensor:
        """Return the gradient of the image [B, H, W, 3]."""
        return photometric_fwd_bwd(image, self.target, None, *self.weights)[2]


class OurStep:
    """What `blitzgs.training.trainer` does with a batch."""

    names = ("cull", "catch-up", "forward", "loss", "backward", "adam", "bounds")

    def __init__(self, scene: BenchmarkScene) -> None:
        n, raw = len(scene.means), scene.raw()
        nothing = torch.zeros(n, dtype=torch.int32, device="cuda")
        self.table = GaussianTable.create(
            {name: raw[name] for name in PARAMETERS}
            | {"last_step": nothing, "birth": nothing, "level": nothing.to(torch.uint8)}
            | {"id": torch.arange(n, device="cuda"), "parent": torch.full((n,), -1, device="cuda")}
        )
        # Gradients of this loss are around 1e-7; their sizes spread over some orders of magnitude.
        for first, second in zip(EXP_AVGS, EXP_AVG_SQS, strict=True):
            size = 1e-7 * torch.exp(2 * torch.randn_like(self.table[first]))
            self.table[first].copy_(torch.randn_like(size)).mul_(size)
            self.table[second].copy_(size).square_()
        self.views = Views(scene.viewmats, scene.Ks, scene.width, scene.height)
        self.loss = Loss(scene)
        rates = OptimiserConfig(RATE, RATE, RATE, RATE, RATE, RATE, RATE)
        schedule = Schedule(ScheduleConfig(batch_size=len(self.views)))
        self.optimiser = LazyAdam(rates, schedule, 1.0, "cuda")
        self.behind = torch.arange(n, device="cuda", dtype=torch.int32) % BEHIND
        self.step = STEP
        self.rewind()

    def rewind(self) -> None:
        """Put every row behind, outside the timed stages."""
        self.step += 1
        for name in ("last_step", "moment_step"):
            self.table[name].copy_(self.step - 1 - self.behind)
        self.blocks = BlockIndex(self.table, self.optimiser.pending_table)

    def cull(self) -> None:
        """Find the rows that the views may see."""
        v, o = self.views, OPTIONS
        self.active = Active(
            *self.blocks.active(
                self.table, v.viewmats, v.Ks, v.width, v.height, o.near_plane, o.far_plane, o.eps2d
            )
        )

    def catch_up(self) -> None:
        """Give these rows the optimiser steps that they missed."""
        self.optimiser.catch_up(self.table, self.active.ids, self.step - 1)

    def forward(self) -> None:
        """Render."""
        self.frame = pipeline.forward(self.table, self.views, OPTIONS, self.active)

    def differentiate_loss(self) -> None:
        """Compare with the photo."""
        self.v_image = self.loss.gradient(self.frame.renders)

    def backward(self) -> None:
        """Differentiate the render."""
        self.gradients = pipeline.backward(self.table, self.frame, self.v_image)

    def optimise(self) -> None:
        """Take the optimiser's step for the rows seen."""
        ids = self.frame.rows.visible_ids
        self.optimiser.step(self.table, self.gradients.parameters, ids, self.step)

    def note(self) -> None:
        """Bound the blocks that changed."""
        self.blocks.update(self.table, self.frame.rows.visible_ids)
        self.counts = len(self.active.ids), len(self.frame.rows.visible_ids)
        del self.frame, self.gradients

    def times(self, repeats: int) -> list[float]:
        """Return median ms by stage."""
        stages = [
            self.rewind, self.cull, self.catch_up, self.forward, self.differentiate_loss, self.backward,
            self.optimise, self.note,
        ]  # fmt: skip
        return event_times(stages, repeats)[1:]


class GsplatStep:
    """The same step by gsplat and torch."""

    names = ("forward", "loss", "backward", "adam")

    def __init__(self, scene: BenchmarkScene) -> None:
        from gsplat import rasterization

        self.render = CallRender(scene, rasterization, packed=False)
        self.loss = Loss(scene)
        self.optimiser = torch.optim.Adam(self.render.parameters, lr=RATE, eps=1e-15, fused=True)

    def forward(self) -> None:
        """Render."""
        self.image = self.render.forward()

    def differentiate_loss(self) -> None:
        """Compare with the photo."""
        self.v_image = self.loss.gradient(self.image.detach())

    def backward(self) -> None:
        """Differentiate the render."""
        self.optimiser.zero_grad(set_to_none=True)
        self.image.backward(self.v_image)

    def times(self, repeats: int) -> list[float]:
        """Return median ms by stage."""
        return event_times(
            [self.forward, self.differentiate_loss, self.backward, self.optimiser.step], repeats
        )


def main() -> None:
    """Measure the scenes asked for and print the stages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", nargs="+", default=["aerial4", "aerial16"], choices=[*GAUSSIANS, "garden"]
    )
    parser.add_argument("--views", type=int, default=1, help="views in a batch")
    parser.add_argument("--order", default="morton", choices=["morton", "random"], help="of the rows")
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    for name in args.scenes:
        totals = []
        for label, kind in (("blitzgs", OurStep), ("gsplat + fused Adam", GsplatStep)):
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            scene = make_scene(name, args.views, args.order)
            try:
                step = kind(scene)
            except ImportError:
                continue
            times = step.times(args.repeats)
            totals.append(sum(times))
            stages = "  ".join(f"{stage} {ms:.3f}" for stage, ms in zip(step.names, times, strict=True))
            peak = torch.cuda.max_memory_allocated() / 1e9
            print(f"{scene.name}, {args.views} view(s), {args.order} order: {label}")
            print(f"  {stages}  total {sum(times):.3f} ms  peak {peak:.2f} GB", flush=True)
            if isinstance(step, OurStep):
                print("  {} active, {} visible".format(*step.counts))
            del step, scene
        if len(totals) == 2:
            print(f"  ratio {totals[1] / totals[0]:.2f}", flush=True)


if __name__ == "__main__":
    main()
