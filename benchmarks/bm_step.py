# SPDX-License-Identifier: Apache-2.0
"""A whole training step on CUDA: render, L1 + SSIM, backward, optimiser; against gsplat with torch's Adam.

    python benchmarks/bm_step.py [--scenes aerial4 aerial16] [--repeats 20]

One view of the scene, SH degree 3, every parameter trained. Ours: the ops of the training step; the optimiser
is the lazy Adam (dense Adam's state, paid for the visible rows alone), whose rows are 0 to 39 steps behind.
gsplat: `rasterization` (not packed) and autograd, the same loss kernel, `torch.optim.Adam(fused=True)` over
every row. Medians of CUDA event times, ms.
"""

from __future__ import annotations

import argparse

import torch
from bm_render import SCENES, GsplatRender, OurRender, event_times
from torch import Tensor

from blitzgs.ops.lazy_adam import lazy_adam_step_
from blitzgs.ops.photometric import photometric_fwd_bwd

SSIM_WEIGHT, STEP, RATE = 0.2, 2000, 1e-6


class Loss:
    """(1 - w) L1 + w (1 - SSIM) against a fixed random photo, and its gradient."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.target = torch.randint(0, 256, shape, dtype=torch.uint8, device="cuda")
        values = self.target[0].numel()
        self.weights = [
            torch.full((shape[0],), w / values, device="cuda") for w in (1 - SSIM_WEIGHT, -SSIM_WEIGHT)
        ]

    def gradient(self, image: Tensor) -> Tensor:
        """Return the gradient of the image [B, H, W, 3]."""
        return photometric_fwd_bwd(image, self.target, None, *self.weights)[2]


class OurStep:
    """Render, loss, gradients in compact rows, lazy Adam over the visible rows."""

    def __init__(self, render: OurRender) -> None:
        self.render = render
        n = len(render.parameters[0])
        self.loss = Loss((render.grid[0], render.scene.height, render.scene.width, 3))
        first = [1e-6 * torch.randn_like(p) for p in render.parameters]
        self.moments = [first, [torch.full_like(m, 1e-12) for m in first]]
        self.rates = torch.full((STEP + 1000, 6), RATE, device="cuda")
        self.behind = (STEP - 40 + torch.arange(n, device="cuda") % 40).int()
        self.last_step = self.behind.clone()
        self.step_number = STEP

    def forward(self) -> None:
        """Render."""
        self.image = self.render.forward()

    def differentiate_loss(self) -> None:
        """Compare with the photo."""
        self.v_image = self.loss.gradient(self.image)

    def backward(self) -> None:
        """Differentiate the render."""
        r = self.render
        r.rasterize_backward(self.v_image)
        r.project_backward()

    def optimize(self) -> None:
        """Take the optimiser's step for the rows seen."""
        lazy_adam_step_(
            self.render.parameters, *self.moments, self.render.gradients[:5], self.render.rows[2],
            self.last_step, self.rates, self.step_number, 0.9, 0.999, 1e-15,
        )  # fmt: skip
        self.step_number += 1

    def rewind(self) -> None:
        """Put every row behind again, outside the timed stages."""
        self.last_step.copy_(self.behind + (self.step_number - STEP))


class GsplatStep:
    """The same step by gsplat and torch."""

    def __init__(self, render: GsplatRender) -> None:
        self.render = render
        scene = render.scene
        self.loss = Loss((len(scene.viewmats), scene.height, scene.width, 3))
        self.optimizer = torch.optim.Adam(render.parameters, lr=RATE, eps=1e-15, fused=True)

    def forward(self) -> None:
        """Render."""
        self.image = self.render.forward()

    def differentiate_loss(self) -> None:
        """Compare with the photo."""
        self.v_image = self.loss.gradient(self.image.detach())

    def backward(self) -> None:
        """Differentiate the render."""
        self.optimizer.zero_grad(set_to_none=True)
        self.image.backward(self.v_image)

    def optimize(self) -> None:
        """Take the optimiser's step for every row."""
        self.optimizer.step()

    def rewind(self) -> None:
        """Nothing to put back."""


def measure(step: OurStep | GsplatStep, repeats: int) -> list[float]:
    """Return median ms of forward, loss, backward, optimiser."""
    stages = [step.rewind, step.forward, step.differentiate_loss, step.backward, step.optimize]
    return event_times(stages, repeats)[1:]


def main() -> None:
    """Measure the scenes asked for and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=["aerial4", "aerial16"], choices=list(SCENES))
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    print(f"{'':28s} forward     loss backward optimise    total  peak GB")
    for name in args.scenes:
        totals = []
        for label in ("blitzgs", "gsplat + fused Adam"):
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            scene = SCENES[name]()
            try:
                step = (
                    OurStep(OurRender(scene))
                    if label == "blitzgs"
                    else GsplatStep(GsplatRender(scene, False))
                )
            except ImportError:
                continue
            times = measure(step, args.repeats)
            totals.append(sum(times))
            row = " ".join(f"{t:8.3f}" for t in (*times, sum(times)))
            print(f"{name:8s}{label:20s}{row} {torch.cuda.max_memory_allocated() / 1e9:8.2f}", flush=True)
            del step, scene
        if len(totals) == 2:
            print(f"{name:8s}ratio {totals[1] / totals[0]:.2f}")


if __name__ == "__main__":
    main()
