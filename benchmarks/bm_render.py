# SPDX-License-Identifier: Apache-2.0
"""Render forward and backward on CUDA, against gsplat in the same run when it is installed.

    python benchmarks/bm_render.py [--scenes aerial1 aerial4 aerial16 garden] [--repeats 30] [--json FILE]

Gradients for every parameter; SH degree 3, float32. Ours: the training step's own render (`blitzgs.frame`,
whose host does not wait between projection and compositing) and the gradients of its projection, in compact
splats. Then the same through `blitzgs.rasterization` and autograd: with dense gradients, with sparse ones,
and with every entry of meta read. gsplat: `rasterization` and autograd, packed and not. Torch's autograd
hands the backward pass of CUDA tensors to a thread of its own and waits for it; "1 thread" is without that
(`torch.autograd.set_multithreading_enabled(False)`). Each figure is a median over repeats of CUDA event
times; memory is the peak above the inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from harness import make_parser, stage_medians, write_json
from report_tables import call_lines, render_lines, stage_lines
from scenes import BenchmarkScene, aerial, garden_like
from torch import Tensor

from blitzgs import rasterization
from blitzgs.frame.render import RenderOptions, backward_splats, inputs_of, render_frame, stage_ended
from blitzgs.frame.transport.protocol import LocalTransport, stages_told_to
from blitzgs.table.table import GaussianTable

try:
    import gsplat
except ImportError:
    gsplat = None

ops = torch.ops.blitzgs
OPTIONS = RenderOptions(sh_degree=3, near_plane=0.01, far_plane=1e10)
# The stages by their marks in `blitzgs.frame.render`; the exchange of a single rank does nothing.
STAGES = {
    "project": "project", "sort": "intersect", "raster": "rasterize", "raster back": "rasterize_backward",
    "project back": "project_backward",
}  # fmt: skip
SCENES: dict[str, Callable[[], BenchmarkScene]] = {
    "aerial1": lambda: aerial(1_000_000, "cuda"),
    "aerial4": lambda: aerial(4_000_000, "cuda"),
    "aerial16": lambda: aerial(16_000_000, "cuda"),
    "garden": lambda: garden_like(device="cuda"),
}


class OurRender:
    """The training step's own render, `blitzgs.frame.render`, and the gradients of the projection, by stage.

    From the second call on, the host queues all stages of the forward pass with the sizes of earlier calls,
    and reads the true sizes while the device composites.
    """

    def __init__(self, scene: BenchmarkScene) -> None:
        self.table = GaussianTable.create(scene.raw())
        self.views = scene.views
        self.transport = LocalTransport()

    def forward(self) -> Tensor:
        """Return the image [B, H, W, 3]."""
        self.frame = render_frame(
            self.table, self.views, OPTIONS, transport=self.transport, backward_follows=True
        )
        return self.frame.renders

    def backward(self, v_renders: Tensor) -> None:
        """Differentiate, to compact splats, dropping what the forward pass kept as soon as it is used."""
        v_splats = backward_splats(self.frame, v_renders).parts
        splats = self.frame.projected
        columns = [splats.camera_ids, splats.visible_ids, splats.splat_offsets]
        del self.frame, splats
        inputs = inputs_of(self.table, self.views, OPTIONS)
        ops.project_bwd(
            list(inputs.gaussians), *inputs.cameras, None, None, *columns, None, *inputs.options,
            v_splats, None, False,
        )  # fmt: skip
        stage_ended("project back")


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


def measure(render: OurRender | CallRender, v_renders: Tensor, repeats: int) -> dict[str, float]:
    """Return ms of forward, backward and both, and peak GB above what is allocated now."""
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()

    def both(mark: Callable[[str], None]) -> None:
        render.forward()
        mark("forward")
        render.backward(v_renders)
        mark("backward")

    (_, forward), (_, backward), _ = stage_medians(both, repeats)
    peak = (torch.cuda.max_memory_allocated() - before) / 1e9
    return {"forward": forward, "backward": backward, "total": forward + backward, "peak_gb": peak}


def stages(render: OurRender, v_renders: Tensor, repeats: int) -> dict[str, float]:
    """Return ms of each stage. The host waits for the device only as a training step does."""

    def both(mark: Callable[[str], None]) -> None:
        with stages_told_to(mark):
            render.forward()
            render.backward(v_renders)

    return {STAGES[stage]: ms for stage, ms in stage_medians(both, repeats) if stage in STAGES}


def run(name: str, repeats: int) -> dict[str, Any]:
    """Measure one scene."""
    scene = SCENES[name]()
    g = torch.Generator(device="cuda").manual_seed(1)
    v = torch.randn(len(scene.viewmats), scene.height, scene.width, 3, generator=g, device="cuda") * 1e-3
    ours = OurRender(scene)
    result: dict[str, Any] = {"scene": scene.name, "blitzgs": measure(ours, v, repeats)}
    image = ours.forward()
    result["visible"], result["rows"], result["intersections"] = ours.frame.projected.counts.tolist()
    result["stages"] = stages(ours, v, repeats)
    sparse = partial(rasterization, sparse_grad=True)
    calls: dict[str, Callable[[], CallRender]] = {
        "rasterization": lambda: CallRender(scene, rasterization),
        "rasterization, 1 thread": lambda: CallRender(scene, rasterization, one_thread=True),
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
    parser = make_parser(__doc__, device=None, repeats=30)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    args = parser.parse_args()
    results = []
    for name in args.scenes:
        results.append(run(name, args.repeats))
        for lines in (render_lines, stage_lines, call_lines):
            print("\n".join(lines({"results": results[-1:]})) + "\n", flush=True)
        torch.cuda.empty_cache()
    write_json(args.json, "cuda", results=results)


if __name__ == "__main__":
    main()
