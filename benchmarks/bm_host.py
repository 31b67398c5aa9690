# SPDX-License-Identifier: Apache-2.0
"""Host time of one call, and of a trainer's step, on a scene so small that only the host's time counts.

    python benchmarks/bm_host.py [--device cpu] [--repeats 500] [--json FILE]

50 Gaussians with SH of degree 1 in an image of 32 x 32 px; gradients for every parameter; autograd in one
thread. The first table has `blitzgs.rasterization`, forward and backward. On the CPU each of its figures
includes the kernels. On CUDA each pass ends with a synchronisation, so a figure is the longer of host and
device. Each figure is a median over repeats.

The second table has the steps of a trainer made of `raw_rasterization`, `l1_ssim` and a `LazyAdam` for each
parameter, or one for all, by part, without synchronisations; each figure is a mean over repeats.

The third table has the steps of `blitzgs train` on eight photographs of 48 x 32 px with 400 Gaussians:
medians of the time between two steps and of their parts, without synchronisations.

To compare with another version of the package, put its folder into PYTHONPATH.
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from harness import Clock, make_parser, report, synchronize, write_json
from scenes import aerial

from blitzgs import l1_ssim, rasterization, raw_rasterization
from blitzgs.distributed.group import Ranks
from blitzgs.optim import LazyAdam
from blitzgs.training.trainer import Trainer as Training
from tests.training.tiny import tiny_config, tiny_scene

GAUSSIANS, WIDTH, HEIGHT = 50, 32, 32
CALLS: dict[str, dict[str, Any]] = {
    "dense": {}, "sparse": {"sparse_grad": True}, "not packed": {"packed": False}, "2 views": {"views": 2},
    "values": {"sh_degree": None}, "sparse, meta": {"sparse_grad": True, "read_meta": True},
}  # fmt: skip


def measure(
    device: str, repeats: int, views: int = 1, read_meta: bool = False, **options: Any
) -> list[float]:
    """Return the median microseconds of the forward pass, with all of `meta` if it is read, and the backward.

    `options`: further arguments of `rasterization`.
    """
    scene = aerial(GAUSSIANS, device, views=views, width=WIDTH, height=HEIGHT)
    options = {"sh_degree": 1, **options}
    colors = scene.sh if options["sh_degree"] is not None else scene.sh[:, 0]
    given = (scene.means, scene.quats, scene.scales, scene.opacities, colors)
    parameters = [t.detach().clone().requires_grad_() for t in given]
    v_renders = torch.ones(views, HEIGHT, WIDTH, 3, device=device)
    samples = []
    for _ in range(repeats // 10 + repeats):
        begin = time.perf_counter()
        renders, _, meta = rasterization(*parameters, scene.viewmats, scene.Ks, WIDTH, HEIGHT, **options)
        if read_meta:
            list(meta.values())
        synchronize(device)
        middle = time.perf_counter()
        torch.autograd.grad(renders, parameters, v_renders)
        synchronize(device)
        samples.append((middle - begin, time.perf_counter() - middle))
    return [1e6 * statistics.median(times) for times in zip(*samples[repeats // 10 :], strict=True)]


class Trainer:
    """A trainer of one view, as small as its host time allows."""

    def __init__(self, device: str, in_one: bool = False) -> None:
        """Take the Gaussians and the view of the benchmark's scene; `in_one`: one optimiser for all."""
        self._scene = scene = aerial(GAUSSIANS, device, width=WIDTH, height=HEIGHT)
        values = scene.raw()
        sh = values.pop("sh")
        values |= {"sh0": sh[:, :1].contiguous(), "shN": sh[:, 1:].contiguous()}
        self.params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        groups = [{"params": [param], "name": name} for name, param in self.params.items()]
        self._optimizers = [LazyAdam(groups)] if in_one else [LazyAdam([group]) for group in groups]
        self._target = torch.full((1, HEIGHT, WIDTH, 3), 0.5, device=device)

    def step(self, end: Callable[[str], None] = lambda part: None) -> None:
        """Take a step; `end` is called at the end of each part."""
        scene = self._scene
        image, _, _ = raw_rasterization(
            *self.params.values(), scene.viewmats, scene.Ks, WIDTH, HEIGHT, sh_degree=1,
            optimizers=self._optimizers,
        )  # fmt: skip
        end("render")
        loss = l1_ssim(image, self._target)
        end("loss")
        loss.backward()
        end("backward")
        for optimizer in self._optimizers:
            optimizer.step()
            optimizer.zero_grad()
        end("optimisers")


def measure_trainer(device: str, repeats: int, in_one: bool) -> dict[str, float]:
    """Return the host's microseconds for each part of a trainer's step."""
    trainer, found = Trainer(device, in_one), defaultdict(float)
    for _ in range(repeats // 10 + 1):
        trainer.step()
    clock = Clock("cpu")
    for _ in range(repeats):
        trainer.step(clock.mark)
    for part, ms in clock.stages():
        found[part] += 1e3 * ms / repeats
    return found | {"all": sum(found.values())}


def measure_training(device: str, repeats: int) -> list[dict[str, Any]]:
    """Return the host's microseconds for a training's step and for each of its parts."""
    parts, warm_up = defaultdict(list), repeats // 10 + 5
    last = float("nan")

    def timed(owner: Any, name: str, part: str) -> None:
        method = getattr(owner, name)

        @wraps(method)
        def call(*arguments: Any, **options: Any) -> Any:
            begin = time.perf_counter()
            result = method(*arguments, **options)
            parts[part].append(1e6 * (time.perf_counter() - begin))
            return result

        setattr(owner, name, call)

    chosen = (f"schedule.iterations={warm_up + repeats}", "schedule.batch_size=1")
    never = (f"{name}={10 * (warm_up + repeats)}" for name in ("schedule.densify_from", "log.every"))
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(None):
        config = tiny_config(*chosen, *never)
        training = Training(config, *tiny_scene(), Path(folder) / "run", Ranks(device=torch.device(device)))
        timed(training.loader, "get", "batch")
        timed(training.state.stepper, "forward", "forward")
        timed(training._guard, "check", "check of the loss")
        timed(training.state.stepper, "backward", "backward")
        take = training.step

        def step(number: int) -> None:
            nonlocal last
            parts["from step to step"].append(1e6 * (time.perf_counter() - last))
            last = time.perf_counter()
            take(number)

        training.step = step  # type: ignore[method-assign]
        training.train()
    return [
        {"part": part, "median us": statistics.median(times[warm_up:]),
         "tenth us": statistics.quantiles(times[warm_up:], n=10)[0]}
        for part, times in parts.items()
    ]  # fmt: skip


def main() -> None:
    args = make_parser(__doc__, repeats=500).parse_args()
    rows = []
    with torch.autograd.set_multithreading_enabled(False):
        for name, options in CALLS.items():
            forward, backward = measure(args.device, args.repeats, **options)
            rows.append({"call": name, "forward us": forward, "backward us": backward,
                         "total us": forward + backward})  # fmt: skip
        report("Host time of a call", rows, None, args.device)
        apart, in_one = (measure_trainer(args.device, args.repeats, in_one) for in_one in (False, True))
    steps = [
        {"part": part, "host us": figure, "one optimiser, host us": in_one[part]}
        for part, figure in apart.items()
    ]
    report("Host time of a trainer's step", steps, None, args.device)
    training = measure_training(args.device, args.repeats)
    report("Host time of a training's step", training, None, args.device)
    write_json(args.json, args.device, rows=rows, steps=steps, training=training)


if __name__ == "__main__":
    main()
