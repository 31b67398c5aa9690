# SPDX-License-Identifier: Apache-2.0
"""A whole training step on CUDA against gsplat with torch's fused Adam, stage by stage.

    python benchmarks/bm_step.py [--scenes aerial4 aerial16] [--views 1] [--json FILE]

SH degree 3, every parameter trained, gradients of L1 + SSIM. Ours is the trainer's own step
(`blitzgs.training.step`): find the active rows, catch them up (they are 0 to 39 steps behind), render,
compare, differentiate, step the visible rows, note the blocks that changed. gsplat: `rasterization` (not
packed) and autograd, the same loss kernel, `torch.optim.Adam(fused=True)` over every row. Both get the same
scene in Morton order, as the trainer keeps its table. Medians of CUDA event times, ms.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from bm_render import OPTIONS, CallRender
from harness import make_parser, stage_medians, write_json
from report_tables import step_lines
from scenes import BenchmarkScene, aerial, garden_like

from blitzgs.config.fields import LossConfig, OptimiserConfig, ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import Frame
from blitzgs.frame.transport.protocol import stage_ended, stages_told_to
from blitzgs.ops.photometric import photometric_fwd_bwd
from blitzgs.ops.projection_types import Views
from blitzgs.optim.table_adam import TableAdam
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import EXP_AVG_SQS, EXP_AVGS, GaussianTable
from blitzgs.training.batches import Batch
from blitzgs.training.step import Stepper

LOSS = LossConfig(ssim=0.2, scale=0)
STEP, RATE, BEHIND = 2000, 1e-6, 40
GAUSSIANS = {"aerial1": 1_000_000, "aerial4": 4_000_000, "aerial16": 16_000_000}
DRAWN_ROWS = 1 << 20  # rows whose moments are drawn at a time, so that a large table leaves room for them


def make_scene(name: str, views: int) -> BenchmarkScene:
    """Return a scene of `GAUSSIANS` or "garden", with its rows in Morton order."""
    if name == "garden":
        scene = garden_like(device="cuda", views=views)
    else:
        scene = aerial(GAUSSIANS[name], "cuda", views=views)
    return scene.rows(morton_order(scene.means))


def random_photographs(views: Views) -> Batch:
    """Return a batch of random photographs of views."""
    shape, device = (len(views), views.height, views.width, 3), views.Ks.device
    targets = torch.randint(0, 256, shape, dtype=torch.uint8, device=device)
    samples = torch.full((len(views),), float(targets[0].numel()), device=device)
    return Batch(list(range(len(views))), views, targets, None, samples, None)


def make_table(scene: BenchmarkScene, rows: torch.Tensor | None = None) -> GaussianTable:
    """Return the scene, or some of its rows, as a table amidst a training: with moments, at step 0."""
    columns = scene.raw()
    if rows is not None:
        columns = {name: column[rows] for name, column in columns.items()} | {"id": rows}
    table = GaussianTable.create(columns)
    # Gradients of this loss are around 1e-7; their sizes spread over some orders of magnitude.
    for names in zip(EXP_AVGS, EXP_AVG_SQS, strict=True):
        for first, second in zip(*(table[name].split(DRAWN_ROWS) for name in names), strict=True):
            size = 1e-7 * torch.exp(2 * torch.randn_like(first))
            first.copy_(torch.randn_like(size)).mul_(size)
            second.copy_(size).square_()
    return table


def make_optimiser(schedule: Schedule, device: torch.device | str) -> TableAdam:
    """Return an optimiser whose steps hardly change the image."""
    return TableAdam(OptimiserConfig(*[RATE] * 5), schedule, 1.0, device)


def put_behind(stepper: Stepper, step: int) -> None:
    """Let the rows have missed 0 to `BEHIND` - 1 steps when step number `step` begins."""
    table = stepper.table
    last = step - 1 - (table["id"] % BEHIND).int()
    for name in ("last_step", "moment_step"):
        table[name].copy_(last)
    stepper.reindex()


def take_step(stepper: Stepper, step: int, batch: Batch) -> Frame:
    """Take a step of a training."""
    frame, terms, _ = stepper.forward(step, OPTIONS, batch)
    stepper.backward(step, frame, terms)
    return frame


class OurStep:
    """The trainer's step."""

    def __init__(self, scene: BenchmarkScene) -> None:
        self.batch, self.step = random_photographs(scene.views), STEP
        optimiser = make_optimiser(Schedule(ScheduleConfig(batch_size=len(self.batch.views))), "cuda")
        owners = TileOwners(Ranks(device=torch.device("cuda", torch.cuda.current_device())))
        self.stepper = Stepper(make_table(scene), optimiser, owners, LOSS, 1.0)

    def prepare(self) -> None:
        """Set pending steps for every row, outside the timed stages."""
        self.step += 1
        put_behind(self.stepper, self.step)

    def take(self) -> None:
        """Take one step."""
        self.visible = len(take_step(self.stepper, self.step, self.batch).projected.visible_ids)


class GsplatStep:
    """The same step by gsplat and torch."""

    def __init__(self, scene: BenchmarkScene) -> None:
        from gsplat import rasterization

        self.render = CallRender(scene, partial(rasterization, packed=False))
        self.batch = random_photographs(scene.views)
        weights = ((1 - LOSS.ssim) / self.batch.samples, -LOSS.ssim / self.batch.samples)
        self.weights = [weight / len(scene.viewmats) for weight in weights]
        self.optimiser = torch.optim.Adam(self.render.parameters, lr=RATE, eps=1e-15, fused=True)

    def prepare(self) -> None:
        """Do nothing; there is nothing to prepare."""

    def take(self) -> None:
        """Take one step."""
        image = self.render.forward()
        stage_ended("render")
        v_image = photometric_fwd_bwd(image.detach(), self.batch.targets, None, *self.weights)[1]
        stage_ended("loss")
        self.optimiser.zero_grad(set_to_none=True)
        image.backward(v_image)
        stage_ended("render back")
        self.optimiser.step()
        stage_ended("optimiser")


def measure(step: OurStep | GsplatStep, repeats: int) -> list[tuple[str, float]]:
    """Return name and median ms of each stage in order, last of the whole step."""

    def take(mark: Callable[[str], None]) -> None:
        with stages_told_to(mark):
            step.take()

    return stage_medians(take, repeats, step.prepare)


def run(name: str, views: int, repeats: int) -> dict[str, Any]:
    """Measure both steps on one scene."""
    result: dict[str, Any] = {"views": views}
    for label, kind in (("blitzgs", OurStep), ("gsplat + fused Adam", GsplatStep)):
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        scene = make_scene(name, views)
        result["scene"] = scene.name
        try:
            step = kind(scene)
        except ImportError:
            continue
        times = measure(step, repeats)
        # Stages of one name, at both ends of a step, count together.
        stages: dict[str, float] = {}
        for stage, ms in times:
            stages[stage] = stages.get(stage, 0.0) + ms
        result[label] = {"ms": stages, "peak_gb": torch.cuda.max_memory_allocated() / 1e9}
        if isinstance(step, OurStep):
            result["visible"] = step.visible
        del step, scene
    return result


def main() -> None:
    parser = make_parser(__doc__, device=None, repeats=20)
    parser.add_argument(
        "--scenes", nargs="+", default=["aerial4", "aerial16"], choices=[*GAUSSIANS, "garden"]
    )
    parser.add_argument("--views", type=int, default=1, help="views in a batch")
    args = parser.parse_args()
    results = []
    for name in args.scenes:
        results.append(run(name, args.views, args.repeats))
        print("\n".join(step_lines({"results": results[-1:]})) + "\n", flush=True)
    write_json(args.json, "cuda", results=results)


if __name__ == "__main__":
    main()
