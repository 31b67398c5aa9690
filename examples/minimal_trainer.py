# SPDX-License-Identifier: Apache-2.0
"""A trainer of 3D Gaussians in 150 lines, from the public parts of BlitzGS: reads COLMAP, writes PLY.

    python examples/minimal_trainer.py --data CAPTURE --out model.ply [--steps 7000] [--device cuda]

It trains like the original 3DGS (Kerbl et al. 2023): with L1 + SSIM and Adam, it clones and splits Gaussians
whose image gradient is large, and prunes transparent ones. It runs on the CPU and on one GPU.
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
from blitzgs.formats.ply import write_ply
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.optim import LazyAdam

RATES = {"quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
MEANS_RATE, MEANS_DECAY = 1.6e-4, 0.01  # relative to the extent; factor at the end of the training
SH_DEGREE, SH0 = 3, 0.28209479177387814


class Model:
    """The trained Gaussians, their optimiser, and the statistics that decide which are cloned or split."""

    def __init__(self, capture: Capture, device: torch.device) -> None:
        points, colors = (torch.from_numpy(t).float().to(device) for t in (capture.points, capture.colors))
        spacing = knn_distances(points, 3).square().mean(dim=1).sqrt().clamp(1e-7, capture.extent / 10)
        start = {
            "means": points,
            "quats": torch.tensor([1.0, 0, 0, 0], device=device).repeat(len(points), 1),
            "scales": spacing.log()[:, None].repeat(1, 3),
            "opacities": torch.full_like(spacing, 0.1).logit(),
            "sh0": ((colors / 255 - 0.5) / SH0)[:, None],
            "shN": torch.zeros(len(points), (SH_DEGREE + 1) ** 2 - 1, 3, device=device),
        }
        self.extent, rates = capture.extent, {"means": MEANS_RATE * capture.extent, **RATES}
        self.params = {name: torch.nn.Parameter(value) for name, value in start.items()}
        groups = [{"params": [p], "lr": rates[name], "name": name} for name, p in self.params.items()]
        self.optimizer, self.means_group = LazyAdam(groups, eps=1e-15), groups[0]
        self.sort_by_place()

    def sort_by_place(self) -> None:
        """Sort the rows so that neighbours in space are neighbours in memory, and clear the statistics."""
        self.params = self.optimizer.permute(blitzgs.morton_order(self.params["means"].detach()))
        self.gradients, self.seen = torch.zeros_like(self.params["means"].detach()[:, :2]).unbind(1)

    def render(self, view: dict[str, Tensor], degree: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Return an image [1, H, W, 3] and the renderer's `meta`."""
        height, width = view["image"].shape[1:3]
        image, _, meta = blitzgs.raw_rasterization(
            *self.params.values(), view["pose"], view["K"], width, height, sh_degree=degree,
            optimizers=self.optimizer,
        )  # fmt: skip
        return image, meta

    def step(self, view: dict[str, Tensor], degree: int) -> Tensor:
        """Move the Gaussians towards a photograph; returns the loss."""
        image, meta = self.render(view, degree)
        meta["means2d"].retain_grad()
        loss = blitzgs.l1_ssim(image, view["image"], view["mask"])
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        across, down = meta["means2d"].grad.unbind(1)
        norms = torch.hypot(across * (meta["width"] / 2), down * (meta["height"] / 2))
        self.gradients.index_add_(0, meta["gaussian_ids"], norms)
        self.seen.index_add_(0, meta["gaussian_ids"], torch.ones_like(norms))
        return loss.detach()

    @torch.no_grad()
    def densify(self, most: int, threshold: float = 2e-4, min_opacity: float = 0.005) -> None:
        """Clone small and split large Gaussians whose gradient is large; prune transparent ones."""
        self.optimizer.catch_up()
        mean = self.gradients / self.seen.clamp(min=1)
        best = mean.topk(min(len(mean), max(0, most - len(mean)))).indices  # each of them adds one Gaussian
        wanted = torch.zeros_like(mean, dtype=torch.bool).index_fill(0, best, True) & (mean > threshold)
        split = wanted & (self.params["scales"].amax(dim=1).exp() > 0.01 * self.extent)
        added = torch.cat([(wanted & ~split).nonzero(), split.nonzero(), split.nonzero()])[:, 0]
        new = {name: p[added].clone() for name, p in self.params.items()}
        halves = split[added]
        turn, axis = torch.nn.functional.normalize(new["quats"][halves], dim=1).split([1, 3], dim=1)
        offsets = torch.randn_like(axis) * new["scales"][halves].exp()
        offsets += 2 * torch.linalg.cross(axis, torch.linalg.cross(axis, offsets) + turn * offsets)
        new["means"][halves] += offsets
        new["scales"][halves] -= math.log(1.6)
        self.optimizer.append(new)
        self.params = self.optimizer.keep(torch.cat([~split, torch.ones_like(added, dtype=torch.bool)]))
        self.params = self.optimizer.keep(self.params["opacities"].sigmoid() > min_opacity)
        self.sort_by_place()


def load_view(capture: Capture, images: ImageStore, index: int, device: torch.device) -> dict[str, Tensor]:
    """Return a photograph uint8 [1, H, W, 3] with its mask, pose and intrinsics."""
    camera, mask = capture.cameras[index], images.mask(index)
    pose, K = (torch.from_numpy(np.float32(m))[None].to(device) for m in (camera.world_to_camera, camera.K))
    view = {"image": images.get(index)[None].to(device), "pose": pose, "K": K}
    return {**view, "mask": None if mask is None else mask[None].to(device)}


@torch.no_grad()
def psnr(model: Model, view: dict[str, Tensor]) -> float:
    """Return the PSNR of a view in dB, over the pixels that count."""
    errors = (model.render(view, SH_DEGREE)[0].clamp(0, 1) - view["image"] / 255).square()
    return -10 * math.log10(errors.mean() if view["mask"] is None else errors[view["mask"] != 0].mean())


def main(arguments: list[str] | None = None) -> Model:
    """Train, measure and write a model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", required=True, help="folder with images/ and a COLMAP model")
    parser.add_argument("--out", required=True, help="PLY file to write")
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--downscale", type=float, default=1)
    parser.add_argument("--most", type=int, default=3_000_000, help="largest number of Gaussians")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args(arguments)
    capture, device = load_capture(options.data, downscale=options.downscale), torch.device(options.device)
    images, chance, model = ImageStore(capture), random.Random(0), Model(capture, device)
    for step in range(1, options.steps + 1):
        model.means_group["lr"] = MEANS_RATE * capture.extent * MEANS_DECAY ** (step / options.steps)
        degree = min(SH_DEGREE, step * 10 // options.steps)
        loss = model.step(load_view(capture, images, chance.choice(capture.train), device), degree)
        if step % 100 == 0:
            if options.steps // 14 <= step <= options.steps // 2:
                model.densify(options.most)
            print(f"step {step}: loss {loss:.4f}, {len(model.params['means'])} Gaussians", flush=True)
    if capture.test:
        found = [psnr(model, load_view(capture, images, index, device)) for index in capture.test]
        print(f"PSNR of {len(found)} held-out views: {sum(found) / len(found):.2f} dB")
    images.close()
    model.optimizer.catch_up()
    p = {name: value.detach() for name, value in model.params.items()}
    sh = torch.cat([p.pop("sh0"), p.pop("shN")], dim=1)
    write_ply(options.out, **p, sh=sh, offset=capture.offset)
    return model


if __name__ == "__main__":
    torch.autograd.set_multithreading_enabled(False)  # on a GPU, a thread of its own costs more than it saves
    main()
