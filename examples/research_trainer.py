# SPDX-License-Identifier: Apache-2.0
"""A trainer to start research from: every part that papers replace is a function or a hook of a few lines.

    python examples/research_trainer.py --data CAPTURE --out model.ply [--strategy default] [--device cuda]

`loss_of` has the loss, `Trainer.pose` and `Trainer.look` are hooks of pose and appearance optimisation, and
the strategy is 3DGS-MCMC (at `--most` Gaussians, relocation goes on) or the original density control with
opacity resets. It reads what `blitzgs train` reads, without masks, and writes a PLY file.
"""

from __future__ import annotations

import argparse
import math
import random

import numpy as np
import torch
from torch import Tensor

import blitzgs
from blitzgs.capture.capture import Capture, load_capture
from blitzgs.capture.images import ImageStore
from blitzgs.compat.gsplat import DefaultStrategy, MCMCStrategy
from blitzgs.formats.ply import write_ply
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.optim import LazyAdam

RATES = {"quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
MEANS_RATE, MEANS_DECAY = 1.6e-4, 0.01  # relative to the extent; factor at the end of the training
SH_DEGREE, SH0 = 3, 0.28209479177387814


def loss_of(image: Tensor, photograph: Tensor, params: dict[str, Tensor], visible: Tensor) -> Tensor:
    """Return the loss of a view. The second term stands for one of your own; its gradient stays sparse."""
    logits = torch.gather(params["opacities"], 0, visible, sparse_grad=True)
    return blitzgs.l1_ssim(image, photograph) + 0.01 * logits.sigmoid().mean()


class Trainer:
    """The Gaussians, their optimisers and strategy, and what is optimised for each photograph."""

    def __init__(self, capture: Capture, options: argparse.Namespace) -> None:
        device, self.extent, self.steps = options.device, capture.extent, options.steps
        points, colors = (torch.from_numpy(t).float().to(device) for t in (capture.points, capture.colors))
        spacing = knn_distances(points, 3).square().mean(dim=1).sqrt().clamp(1e-7, self.extent / 10)
        start = {
            "means": points,
            "quats": torch.tensor([1.0, 0, 0, 0], device=device).repeat(len(points), 1),
            "scales": spacing.log()[:, None].repeat(1, 3),
            "opacities": torch.full_like(spacing, 0.1).logit(),
            "sh0": ((colors / 255 - 0.5) / SH0)[:, None],
            "shN": torch.zeros(len(points), (SH_DEGREE + 1) ** 2 - 1, 3, device=device),
        }
        self.params = {name: torch.nn.Parameter(value) for name, value in start.items()}
        self.optimizers = {
            name: LazyAdam([{"params": [p], "lr": RATES.get(name, 0.0), "name": name}], eps=1e-15)
            for name, p in self.params.items()
        }
        start, stop = self.steps // 60, self.steps * 5 // 6
        if options.strategy == "mcmc":
            self.strategy = MCMCStrategy(options.most, refine_start_iter=start, refine_stop_iter=stop)
            self.state = self.strategy.initialize_state()
        else:
            self.strategy = DefaultStrategy(refine_start_iter=start, reset_every=max(1, self.steps // 10))
            self.strategy.refine_stop_iter = self.steps // 2
            self.state = self.strategy.initialize_state(scene_scale=self.extent)
        self.strategy.check_sanity(self.params, self.optimizers)
        self.motions = torch.nn.Parameter(torch.zeros(len(capture.cameras), 6, device=device))
        self.looks = torch.nn.Parameter(torch.zeros(len(capture.cameras), 2, 3, device=device))
        groups = [{"params": [self.motions], "lr": 1e-5}, {"params": [self.looks], "lr": 1e-3}]
        self.of_views = torch.optim.Adam(groups)

    def pose(self, index: int, viewmat: Tensor) -> Tensor:
        """Hook of pose optimisation: turn a view's pose [4, 4], and move it in units of the extent."""
        turn, move = self.motions[index].view(2, 3)
        twist = torch.linalg.cross(turn.expand(3, 3), torch.eye(3, device=turn.device)).T
        moved = torch.cat([torch.matrix_exp(twist) @ viewmat[:3], viewmat[3:]])
        return moved + torch.nn.functional.pad(self.extent * move[:, None], (3, 0, 0, 1))

    def look(self, index: int, image: Tensor) -> Tensor:
        """Hook of appearance optimisation: a gain and a bias for each channel of a photograph."""
        gain, bias = self.looks[index]
        return image * gain.exp() + bias

    def render(self, viewmat: Tensor, K: Tensor, size: tuple[int, int], degree: int) -> tuple[Tensor, dict]:
        """Return an image [1, H, W, 3] and the renderer's `meta`."""
        p = self.params
        image, _, meta = blitzgs.raw_rasterization(
            p["means"], p["quats"], p["scales"], p["opacities"], p["sh0"], p["shN"], viewmat[None], K[None],
            size[1], size[0], sh_degree=degree, optimizers=self.optimizers,
        )  # fmt: skip
        return image, meta

    def step(self, step: int, index: int, view: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Take a training step on one photograph, and return its loss."""
        photograph, viewmat, K = view
        rate = MEANS_RATE * self.extent * MEANS_DECAY ** (step / self.steps)
        self.optimizers["means"].param_groups[0]["lr"] = rate
        degree = min(SH_DEGREE, step * 10 // self.steps)
        image, meta = self.render(self.pose(index, viewmat), K, tuple(photograph.shape[1:3]), degree)
        self.strategy.step_pre_backward(self.params, self.optimizers, self.state, step, meta)
        loss = loss_of(self.look(index, image), photograph, self.params, meta["gaussian_ids"])
        loss.backward()
        for optimizer in (*self.optimizers.values(), self.of_views):
            optimizer.step()
            optimizer.zero_grad()
        last = {"lr": rate} if isinstance(self.strategy, MCMCStrategy) else {"packed": True}
        self.strategy.step_post_backward(self.params, self.optimizers, self.state, step, meta, **last)
        return loss.detach()


def main(arguments: list[str] | None = None) -> Trainer:
    """Train, measure and write a model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", required=True, help="folder with images/ and a COLMAP model")
    parser.add_argument("--out", required=True, help="PLY file to write")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--strategy", choices=["mcmc", "default"], default="mcmc")
    parser.add_argument("--most", type=int, default=1_000_000, help="largest number of Gaussians of mcmc")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args(arguments)
    capture, chance = load_capture(options.data), random.Random(0)
    images, trainer = ImageStore(capture), Trainer(capture, options)

    def view_of(index: int) -> tuple[Tensor, Tensor, Tensor]:
        camera = capture.cameras[index]
        pose, K = (torch.from_numpy(np.float32(m)) for m in (camera.world_to_camera, camera.K))
        return tuple(t.to(options.device) for t in (images.get(index)[None], pose, K))

    for step in range(1, options.steps + 1):
        index = chance.choice(capture.train)
        loss = trainer.step(step, index, view_of(index))
        if step % 100 == 0:
            print(f"step {step}: loss {loss:.4f}, {len(trainer.params['means'])} Gaussians", flush=True)
    found, p = [], {}
    for photograph, pose, K in map(view_of, capture.test):
        image = trainer.render(pose, K, tuple(photograph.shape[1:3]), SH_DEGREE)[0].detach().clamp(0, 1)
        found.append(-10 * math.log10((image - photograph / 255).square().mean()))
    print(f"PSNR of {len(found)} held-out views: {sum(found) / max(1, len(found)):.2f} dB")
    images.close()
    for name, optimizer in trainer.optimizers.items():
        optimizer.catch_up()
        p[name] = trainer.params[name].detach()
    write_ply(options.out, sh=torch.cat([p.pop("sh0"), p.pop("shN")], dim=1), **p, offset=capture.offset)
    return trainer


if __name__ == "__main__":
    main()
