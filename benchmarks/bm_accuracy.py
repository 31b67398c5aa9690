# SPDX-License-Identifier: Apache-2.0
"""Accuracy against time: each option's image and gradient error next to what it costs.

python benchmarks/bm_accuracy.py [--device cuda] [--gaussians 1000000] [--out runs/accuracy]

Errors are against the float64 reference of the same mode on a small aerial scene (--exact-gaussians at
--exact-width): the largest absolute error of the image away from the declared cut pixels, and the largest
relative error of any parameter's gradient (max |difference| / max |reference|). Times are medians of
forward + backward on a large one. Writes a table (Markdown), the figures (JSON) and, with matplotlib, a
Pareto plot.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from scenes import BenchmarkScene, aerial
from timing import median_ms
from torch import Tensor

import blitzgs
from blitzgs.reference import ReferenceImage, render

PARAMETERS = ("means", "quats", "scales", "opacities", "sh", "viewmats")


@dataclass(frozen=True)
class Option:
    """One setting of the renderer."""

    name: str
    arguments: dict[str, Any] = field(default_factory=dict)
    dtype: torch.dtype = torch.float32
    deterministic: bool = False
    half_colors: bool = False  # SH coefficients rounded to float16, as when they are stored or sent so


@dataclass
class Figures:
    """What an option costs and how far it is from the definition."""

    name: str
    milliseconds: float
    image_error: float
    gradient_error: float
    cut_pixels: float  # share of the pixels that sit on a cut and are left out


def options_for(device: str) -> list[Option]:
    """Return what can be chosen on this device; the first is the default."""
    options = [
        Option("default"),
        Option("antialiased", {"rasterize_mode": "antialiased"}),
        Option("tiles of 8", {"tile_size": 8}),
        Option("tiles of 32", {"tile_size": 32}),
        Option("dense meta (packed=False)", {"packed": False}),
        Option("absolute gradients", {"absgrad": True}),
        Option("colour and expected depth", {"render_mode": "RGB+ED"}),
        Option("SH rounded to half precision", half_colors=True),
    ]
    if device == "cpu":
        return [*options, Option("float64", dtype=torch.float64)]
    return [*options, Option("deterministic", deterministic=True)]


def leaves(scene: BenchmarkScene, option: Option) -> list[Tensor]:
    tensors = [getattr(scene, name) for name in PARAMETERS]
    if option.half_colors:
        tensors[4] = tensors[4].half()
    return [t.to(option.dtype).detach().requires_grad_() for t in tensors]


def image(scene: BenchmarkScene, option: Option, inputs: list[Tensor]) -> Tensor:
    *gaussians, viewmats = inputs
    Ks = scene.Ks.to(option.dtype)
    arguments = {"sh_degree": 3, **option.arguments}
    return blitzgs.rasterization(*gaussians, viewmats, Ks, scene.width, scene.height, **arguments)[0]


def reference_of(scene: BenchmarkScene, option: Option) -> tuple[ReferenceImage, list[Tensor]]:
    inputs = [getattr(scene, name).double().cpu().requires_grad_() for name in PARAMETERS]
    *gaussians, viewmats = inputs
    result = render(
        *gaussians,
        viewmats[0],
        scene.Ks[0].cpu(),
        scene.width,
        scene.height,
        sh_degree=3,
        render_mode=option.arguments.get("render_mode", "RGB"),
        antialiased=option.arguments.get("rasterize_mode") == "antialiased",
    )
    return result, inputs


def errors(scene: BenchmarkScene, option: Option) -> tuple[float, float, float]:
    """Return the image error, the gradient error and the share of cut pixels."""
    reference, reference_inputs = reference_of(scene, option)
    inputs = leaves(scene, option)
    actual = image(scene, option, inputs)[0]
    keep = ~reference.cut
    # Depth is compared relative to the largest one, colour as it is.
    size = reference.image.detach().abs().amax(dim=(0, 1)).clamp(min=1.0)
    difference = (actual.detach().double().cpu() - reference.image.detach()).abs() / size
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(actual.shape, generator=generator, dtype=torch.float64) * keep[..., None] / size
    gradients = torch.autograd.grad((actual.double() * weights.to(actual.device)).sum(), inputs)
    expected = torch.autograd.grad((reference.image * weights).sum(), reference_inputs)
    worst = max(
        ((a.double().cpu() - e).abs().max() / e.abs().max()).item()
        for a, e in zip(gradients, expected, strict=True)
    )
    return difference[keep].max().item(), worst, reference.cut.double().mean().item()


def step_ms(scene: BenchmarkScene, option: Option, repeats: int) -> float:
    inputs = leaves(scene, option)
    weights = torch.randn_like(image(scene, option, inputs))
    return median_ms(
        lambda w: torch.autograd.grad((image(scene, option, inputs) * w).sum(), inputs),
        [(weights,)],
        repeats,
        warm_up=2,
    )


def measure(option: Option, exact: BenchmarkScene, large: BenchmarkScene, repeats: int) -> Figures:
    torch.use_deterministic_algorithms(option.deterministic, warn_only=True)
    image_error, gradient_error, cut = errors(exact, option)
    result = Figures(option.name, step_ms(large, option, repeats), image_error, gradient_error, cut)
    torch.use_deterministic_algorithms(False)
    return result


def reference_ms(scene: BenchmarkScene) -> float:
    """Return the milliseconds of forward + backward of the plain PyTorch reference."""
    begin = time.perf_counter()
    result, inputs = reference_of(scene, Option("default"))
    torch.autograd.grad(result.image.sum(), inputs)
    return 1e3 * (time.perf_counter() - begin)


def table(rows: list[Figures]) -> str:
    lines = [
        "| option | forward + backward, ms | image error | gradient error | cut pixels |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.name} | {r.milliseconds:.2f} | {r.image_error:.1e} | {r.gradient_error:.1e} | "
        f"{r.cut_pixels:.2%} |"
        for r in rows
    ]
    return "\n".join(lines)


def plot(rows: list[Figures], path: Path) -> None:
    """Draw time against error, both axes better towards the lower left; skipped without matplotlib."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError:
        print("matplotlib is not installed: no plot")
        return
    figure, axes = plt.subplots(1, 2, figsize=(12, 5), sharex=True)
    for axis, name in zip(axes, ("image_error", "gradient_error"), strict=True):
        for row in rows:
            axis.scatter(row.milliseconds, max(getattr(row, name), 1e-17), s=40, label=row.name)
        axis.set_yscale("log")
        axis.set_xlabel("forward + backward, ms")
        axis.set_ylabel(name.replace("_", " "))
        axis.grid(True, which="both", alpha=0.2)
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    cuda = torch.cuda.is_available()
    parser.add_argument("--device", default="cuda" if cuda else "cpu")
    parser.add_argument("--gaussians", type=int, default=1_000_000 if cuda else 100_000)
    parser.add_argument("--width", type=int, default=1600 if cuda else 400)
    parser.add_argument("--exact-gaussians", type=int, default=1_000)
    parser.add_argument("--exact-width", type=int, default=72)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--out", type=Path, help="folder for accuracy.json, accuracy.md and accuracy.png")
    args = parser.parse_args()
    exact_height, height = args.exact_width * 2 // 3, args.width * 2 // 3
    exact = aerial(args.exact_gaussians, args.device, width=args.exact_width, height=exact_height)
    large = aerial(args.gaussians, args.device, width=args.width, height=height)
    print(
        f"{args.device}: errors with {args.exact_gaussians} Gaussians at {exact.width} x {exact.height}, "
        f"times with {args.gaussians} at {large.width} x {large.height}"
    )
    rows = [measure(option, exact, large, args.repeats) for option in options_for(args.device)]
    print(table(rows))
    ours, plain = step_ms(exact, Option("default"), args.repeats), reference_ms(exact)
    print(
        f"the small scene, forward + backward: {ours:.2f} ms; "
        f"the reference (float64 PyTorch, no culling, CPU): {plain:.0f} ms"
    )
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "accuracy.md").write_text(table(rows) + "\n")
        (args.out / "accuracy.json").write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
        plot(rows, args.out / "accuracy.png")


if __name__ == "__main__":
    main()
