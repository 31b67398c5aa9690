# SPDX-License-Identifier: Apache-2.0
"""Runs gsplat's training loop with gsplat's parts and with ours, and compares time and quality.

    python benchmarks/bm_drop_in.py CAPTURE [--steps 7000] [--arms gsplat import four] [--device cuda]
        [--one-thread]

The loop, learning rates and density strategy are those of gsplat's `simple_trainer.py` 1.5.3
(`opponents/gsplat_training.py`), with photographs on the device. Arms:

- gsplat: `gsplat.rasterization`, `torch.optim.Adam(fused=True)`, and L1 and SSIM by fused_ssim, or by our
  kernel where fused_ssim is not installed (the column "loss" says which);
- import: the same with `blitzgs.rasterization` in place of gsplat's function;
- four: `blitzgs.raw_rasterization`, `blitzgs.optim.LazyAdam`, `blitzgs.l1_ssim` and Morton order.

Times are of the whole training, of the two steps around each time at which the strategy may change the
population, and of the steps between two such times at the end; PSNR is the mean over held-out views.
`--one-thread` calls `torch.autograd.set_multithreading_enabled(False)` for all arms, as the guide recommends:
autograd then runs the backward pass in the loop's own thread.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from harness import make_parser, report, seconds_of
from opponents.gsplat_training import GsplatOptions, GsplatTrainer
from torch import Tensor

import blitzgs
from blitzgs.capture.capture import load_capture
from blitzgs.capture.images import ImageStore
from blitzgs.optim import LazyAdam


class OneImport(GsplatTrainer):
    """gsplat's loop with another renderer."""

    # Whose kernels compute the loss.
    loss_name = "fused_ssim" if find_spec("fused_ssim") else "blitzgs.l1_ssim"

    def loss(self, renders: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
        """Return L1 and SSIM, with the kernels that gsplat's trainer uses where they are installed."""
        if self.loss_name != "fused_ssim":
            return blitzgs.l1_ssim(renders, target, ssim_weight=self.options.ssim_lambda)
        from fused_ssim import fused_ssim

        target = target / 255.0
        l1 = torch.nn.functional.l1_loss(renders, target)
        similar = fused_ssim(renders.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2), padding="valid")
        return torch.lerp(l1, 1.0 - similar, self.options.ssim_lambda)


# Refinements from one sorting of the rows to the next: each appends few rows, so the order stays good.
SORT_EVERY = 5


class FourSwaps(OneImport):
    """The loop with our renderer of raw parameters, optimiser and loss, and rows in Morton order."""

    loss_name = "blitzgs.l1_ssim"

    def initialise(self, capture: Any) -> Any:
        """Make the parameters and a `LazyAdam` for each."""
        params, adams = super().initialise(capture)
        lazy = {
            name: LazyAdam([{**adam.param_groups[0], "lr_rest": None}], eps=1e-15)
            for name, adam in adams.items()
        }
        return params, lazy

    def render(self, views: Any) -> tuple[Tensor, Any]:
        """Return the image of a view and what the strategy needs of it."""
        p = self.params
        image, _, info = blitzgs.raw_rasterization(
            p["means"], p["quats"], p["scales"], p["opacities"], p["sh0"], p["shN"], views.viewmats, views.Ks,
            views.width, views.height, sh_degree=self.sh_degree, optimizers=self._optimisers,
        )  # fmt: skip
        return image, info

    def change_population(self, info: Any) -> None:
        """Bring all rows up to date before the strategy reads them; now and then sort them afterwards."""
        strategy = self._strategy
        refines = self.step < strategy.refine_stop_iter and self.step % strategy.refine_every == 0
        if refines:  # the strategy then reads and replaces parameters and their state
            for optimiser in self._optimisers.values():
                optimiser.catch_up()
        super().change_population(info)
        if refines and self.step % (SORT_EVERY * strategy.refine_every) == 0:
            order = blitzgs.morton_order(self.params["means"].detach())
            for name, optimiser in self._optimisers.items():
                self.params[name] = optimiser.permute(order)[name]
            for key, value in self._state.items():
                if isinstance(value, Tensor) and len(value) == len(order):
                    self._state[key] = value[order]


class Gsplat(OneImport):
    """gsplat's loop without changes."""

    def __init__(self, *arguments: Any) -> None:
        import_module("gsplat.cuda._backend")  # may compile gsplat's kernels, which is no part of training
        from gsplat import rasterization

        self.rasterization = rasterization
        super().__init__(*arguments)


ARMS = {"gsplat": Gsplat, "import": OneImport, "four": FourSwaps}


def seconds_until(trainer: GsplatTrainer, step: int) -> float:
    """Continue the training to a step; returns the seconds it took."""
    return seconds_of(trainer.device, lambda: trainer.train_to(step))


def seconds_by_kind(trainer: GsplatTrainer, until: int) -> tuple[float, float]:
    """Continue the training; return the seconds of ordinary steps, and of those around a change.

    The step after a change counts as well, because estimates of sizes begin anew in it.
    """
    every, ordinary, around = trainer._strategy.refine_every, 0.0, 0.0
    while trainer.step < until:
        ordinary += seconds_until(trainer, min(-(-trainer.step // every) * every, until))
        around += seconds_until(trainer, min(trainer.step + 2, until))
    return ordinary, around


@torch.no_grad()
def psnr(trainer: OneImport, capture: Any, images: ImageStore) -> float:
    """Return the mean PSNR of the held-out views, in dB."""
    if isinstance(trainer, FourSwaps):
        for optimiser in trainer._optimisers.values():
            optimiser.catch_up()
    found = []
    for index in capture.test:
        image, _ = trainer.render(trainer.views.pick([index]))
        error = image[0].clamp(0, 1) - images.get(index).to(image.device) / 255
        found.append(-10 * error.square().mean().log10())
    return float(torch.stack(found).mean())


def measure(name: str, capture: Any, images: ImageStore, options: argparse.Namespace) -> dict[str, Any]:
    """Train with one arm; returns a row of the report."""
    device = torch.device(options.device)
    choices = {"steps": options.steps, "packed": issubclass(ARMS[name], FourSwaps)}
    trainer = ARMS[name]("default", GsplatOptions.of("default", choices), capture, images, device, 0)
    last = min(99, options.steps // 10)  # between two densifications
    ordinary, changes = seconds_by_kind(trainer, options.steps - last)
    rest = seconds_until(trainer, options.steps)
    return {
        "arm": name,
        "loss": trainer.loss_name,
        "training, s": ordinary + changes + rest,
        "of it around refinements, s": changes,
        "last steps, ms each": rest / last * 1e3,
        "Gaussians": len(trainer.params["means"]),
        "PSNR, dB": psnr(trainer, capture, images),
    }


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    parser = make_parser(__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--downscale", type=float, default=1)
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=["gsplat", "import", "four"])
    parser.add_argument("--one-thread", action="store_true", help="run autograd in the loop's own thread")
    options = parser.parse_args(arguments)
    capture = load_capture(options.capture, downscale=options.downscale)
    images = ImageStore(capture)
    threads = ", autograd in one thread" if options.one_thread else ""
    title, rows = f"gsplat's loop, {options.steps} steps of {options.capture.name}{threads}", []
    with torch.autograd.set_multithreading_enabled(not options.one_thread):
        for name in options.arms:
            rows.append(measure(name, capture, images, options))
            # After each arm: a run that is cut off leaves what it measured.
            report(title, rows, options.json, options.device)
    images.close()
    return rows


if __name__ == "__main__":
    main()
