# SPDX-License-Identifier: Apache-2.0
"""Render forward and backward on CUDA, against gsplat in the same run when it is installed.

    python benchmarks/bm_render.py [--scenes aerial1 aerial4 aerial16 garden] [--repeats 30] [--json FILE]

Gradients for every parameter; SH degree 3, float32. Ours: the ops of the training step in order (project,
intersect, rasterize and their gradients, in compact splats), and the same through `blitzgs.rasterization` and
autograd: with dense gradients, with sparse ones, and with every entry of meta read. gsplat: `rasterization`
and autograd, packed and not. Torch's autograd hands the backward pass of CUDA tensors to a thread of its own
and waits for it; "1 thread" is without that (`torch.autograd.set_multithreading_enabled(False)`). Each figure
is a median over repeats of CUDA event times; memory is the peak above the inputs.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from harness import make_parser, write_json
from scenes import BenchmarkScene, aerial, garden_like
from torch import Tensor

from blitzgs import rasterization
from blitzgs.ops.projection import ProjectionInputs, ProjectionOptions, project_splats
from blitzgs.ops.rasterize import RasterizeForward, rasterize_fwd

try:
    import gsplat
except ImportError:
    gsplat = None

ops = torch.ops.blitzgs
TILE_SIZE = 16
SCENES: dict[str, Callable[[], BenchmarkScene]] = {
    "aerial1": lambda: aerial(1_000_000, "cuda"),
    "aerial4": lambda: aerial(4_000_000, "cuda"),
    "aerial16": lambda: aerial(16_000_000, "cuda"),
    "garden": lambda: garden_like(device="cuda"),
}


class OurRender:
    """The ops of a training step between parameters and image, by stage."""

    def __init__(self, scene: BenchmarkScene) -> None:
        raw = scene.raw()
        self.scene = scene
        self.parameters = [raw[k].contiguous() for k in ("means", "quats", "scales", "opacities", "sh")]
        self.cameras = [scene.viewmats, scene.Ks]
        self.options = ProjectionOptions(scene.width, scene.height, TILE_SIZE, sh_degree=3)
        self.grid = [len(scene.viewmats), scene.width, scene.height, TILE_SIZE, 0, -1]

    def project(self) -> None:
        """Run the projection."""
        self.projected = project_splats(ProjectionInputs(self.parameters, self.cameras, self.options))

    def intersect(self) -> None:
        """List the splats of each tile."""
        r = self.projected
        count = int(r.counts[2])
        self.lists = ops.intersect(r[4], r[5], r[7], r[6], r[1], None, self.grid, count, None, True)

    def rasterize(self) -> None:
        """Composite the tiles."""
        r = self.projected
        self.splats = (r[4], r[5], r[7], r[8], None, *self.lists)
        self.saved = rasterize_fwd(*self.splats, self.grid, None, True, True)

    def rasterize_backward(self, v_renders: Tensor) -> None:
        """Differentiate the compositing."""
        *splats, backgrounds, isect_splats, tile_offsets = self.splats
        _, rest, last, _, packed_splats, tile_order, packed = self.saved
        forward_pass = RasterizeForward(
            splats, backgrounds, [isect_splats, tile_offsets], [rest, last, packed_splats, tile_order]
        )
        ops.rasterize_bwd_packed_(*forward_pass, v_renders, self.grid, False, packed)
        self.v_splats = [packed]

    def project_backward(self) -> None:
        """Differentiate the projection, to compact splats."""
        r = self.projected
        self.gradients = ops.project_bwd(
            self.parameters, self.cameras, [r[1], r[2], r[3]], self.options.ints, self.options.floats,
            self.v_splats, None, False,
        )  # fmt: skip

    def forward(self) -> Tensor:
        """Return the image [B, H, W, 3]."""
        self.project()
        self.intersect()
        self.rasterize()
        return self.saved[0]

    def backward(self, v_renders: Tensor) -> None:
        """Differentiate, dropping what the forward pass kept as soon as it is used."""
        self.rasterize_backward(v_renders)
        del self.saved, self.splats, self.lists
        self.project_backward()
        del self.projected, self.v_splats, self.gradients


class CallRender:
    """The same work by one call, `rasterization` of gsplat or of BlitzGS, and autograd."""

    def __init__(
        self,
        scene: BenchmarkScene,
        rasterization: Callable[..., Any],
        one_thread: bool = False,
        read_meta: bool = False,
    ) -> None:
        self.rasterization, self.scene = rasterization, scene
        self.one_thread, self.read_meta = one_thread, read_meta
        s = scene
        self.parameters = [
            t.detach().clone().requires_grad_() for t in (s.means, s.quats, s.scales, s.opacities, s.sh)
        ]

    def forward(self) -> Tensor:
        """Return the image [B, H, W, 3]."""
        s = self.scene
        self.image, _, meta = self.rasterization(
            *self.parameters, s.viewmats, s.Ks, s.width, s.height, sh_degree=3
        )
        self.meta = list(meta.values()) if self.read_meta else meta
        return self.image

    def backward(self, v_renders: Tensor) -> None:
        """Differentiate through autograd."""
        with torch.autograd.set_multithreading_enabled(not self.one_thread):
            torch.autograd.grad(self.image, self.parameters, v_renders)
        del self.image, self.meta


def event_times(steps: list[Callable[[], Any]], repeats: int, warmup: int = 5) -> list[float]:
    """Return the median ms of each step when they run in order."""
    samples: list[list[float]] = [[] for _ in steps]
    for repeat in range(warmup + repeats):
        events = [torch.cuda.Event(enable_timing=True) for _ in range(len(steps) + 1)]
        events[0].record()
        for step, event in zip(steps, events[1:], strict=True):
            step()
            event.record()
        torch.cuda.synchronize()
        if repeat >= warmup:
            for sample, begin, end in zip(samples, events, events[1:], strict=False):
                sample.append(begin.elapsed_time(end))
    return [statistics.median(sample) for sample in samples]


def measure(render: OurRender | CallRender, v_renders: Tensor, repeats: int) -> dict[str, float]:
    """Return ms of forward, backward and both, and peak GB above what is allocated now."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    forward, backward = event_times([render.forward, lambda: render.backward(v_renders)], repeats)
    peak = (torch.cuda.max_memory_allocated() - before) / 1e9
    return {"forward": forward, "backward": backward, "total": forward + backward, "peak_gb": peak}


def stages(render: OurRender, v_renders: Tensor, repeats: int) -> dict[str, float]:
    """Return ms of each stage."""
    names = ["project", "intersect", "rasterize", "rasterize_backward", "project_backward"]
    steps = [getattr(render, n) if n != "rasterize_backward" else lambda: render.rasterize_backward(v_renders)
             for n in names]  # fmt: skip
    return dict(zip(names, event_times(steps, repeats), strict=True))


def run(name: str, repeats: int) -> dict[str, Any]:
    """Measure one scene; prints as it goes."""
    scene = SCENES[name]()
    g = torch.Generator(device="cuda").manual_seed(1)
    v = torch.randn(len(scene.viewmats), scene.height, scene.width, 3, generator=g, device="cuda") * 1e-3
    ours = OurRender(scene)
    result: dict[str, Any] = {"scene": scene.name, "blitzgs": measure(ours, v, repeats)}
    image = ours.forward()
    result["visible"], result["rows"], result["intersections"] = ours.projected.counts.tolist()
    result["stages"] = stages(ours, v, repeats)
    del ours.saved, ours.splats, ours.lists, ours.projected, ours.v_splats, ours.gradients
    sparse = partial(rasterization, sparse_grad=True)
    calls: dict[str, Callable[[], CallRender]] = {
        "rasterization": lambda: CallRender(scene, rasterization),
        "sparse": lambda: CallRender(scene, sparse),
        "sparse, meta": lambda: CallRender(scene, sparse, read_meta=True),
        "sparse, 1 thread": lambda: CallRender(scene, sparse, one_thread=True),
    }
    if gsplat is not None:
        dense, packed = (partial(gsplat.rasterization, packed=flag) for flag in (False, True))
        calls |= {
            "gsplat": lambda: CallRender(scene, dense),
            "gsplat packed": lambda: CallRender(scene, packed),
            "gsplat, 1 thread": lambda: CallRender(scene, dense, one_thread=True),
        }
    for label, call in calls.items():
        theirs = call()
        result[label] = measure(theirs, v, repeats)
        result[label]["image_difference"] = float((theirs.forward().detach() - image).abs().mean())
        del theirs
    return result


def main() -> None:
    """Measure the scenes asked for, print a table, optionally write JSON."""
    parser = make_parser(__doc__, device=None, repeats=30)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    args = parser.parse_args()
    results = []
    for name in args.scenes:
        result = run(name, args.repeats)
        results.append(result)
        n_splats, entries = result["rows"], result["intersections"]
        print(f"{result['scene']}: {result['visible']} visible, {n_splats} splats, {entries} intersections")
        print("  " + "  ".join(f"{k} {v:.3f}" for k, v in result["stages"].items()))
        for label, r in result.items():
            if label not in ("scene", "visible", "rows", "intersections", "stages"):
                print(f"  {label:16s} forward {r['forward']:7.3f}  backward {r['backward']:7.3f}  "
                      f"total {r['total']:7.3f} ms  peak {r['peak_gb']:.2f} GB  "
                      f"x{r['total'] / result['blitzgs']['total']:.2f}", flush=True)  # fmt: skip
        torch.cuda.empty_cache()
    if args.json:
        write_json(args.json, "cuda", results=results)


if __name__ == "__main__":
    main()
