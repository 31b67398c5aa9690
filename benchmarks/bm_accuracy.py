# SPDX-License-Identifier: Apache-2.0
"""Measures accuracy against time: each option's image error, gradient error and time.

python benchmarks/bm_accuracy.py [--device cuda] [--gaussians 4000000] [--json FILE]

Renders the aerial scene with each option as training does, forward and backward. Times are medians, per view.
Errors are against the float64 reference of the same mode in a few windows of the same images: the largest
absolute error of the image away from the declared cut pixels, and the largest error of a parameter's gradient
(max |difference| / max |reference|). The benchmark fails if the default setting misses its bounds.

The figures are written again after each option, so that an interrupted run keeps its measurements.

The row "exact exponential" needs a second build of the kernels, whose folder --exact-library names:

cmake -S . -B build-exact -G Ninja -DBLITZGS_EXACT_EXP=ON -DBLITZGS_OUTPUT_DIR=$PWD/build-exact/lib
cmake --build build-exact
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import torch
from harness import make_parser, stage_medians, write_json
from report_tables import accuracy_lines
from scenes import BenchmarkScene, aerial
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import Frame, RenderOptions, render_frame
from blitzgs.frame.tiles import TileAssignment, TileRanges
from blitzgs.frame.transport.collective import CollectiveTransport
from blitzgs.frame.transport.protocol import LocalTransport, Transport
from blitzgs.ops.intersect import TILE_SIZE, tile_counts
from blitzgs.ops.projection_types import Views
from blitzgs.reference import Composite, Splats, composite, project_splats
from blitzgs.table.table import PARAMETERS, GaussianTable
from tests.helpers import parameter_gradients

IMAGE_BOUND, GRADIENT_BOUND = 2e-5, 1e-4  # largest errors of the default setting

NEAR, FAR, EPS2D = 0.01, 1e10, 0.3


class ExactWindows:
    """A scene's images in windows: corners, centre and between, in every view.

    The float64 reference composites the splats whose exact bounding boxes reach a window alone, which is what
    it would have made of all of them.

    Attributes:
        ids: int64 [U], the Gaussians that reach a window of some view.
        inputs: their PARAMETERS as trained (log scales, logits), float64, requiring gradients.
        places: (view, rows, columns) of each window.
        images: float64 [h, w, 3] of each window, differentiable.
        cuts: bool [h, w]: pixels where rounding may decide.
    """

    def __init__(self, scene: BenchmarkScene, antialiased: bool = False, size: int = 24):
        self.scene, self.antialiased = scene, antialiased
        self.places = list(_places(scene, size))
        with torch.no_grad():
            everything = [scene.raw()[name].cpu().double() for name in PARAMETERS]
            self.ids = self._reaching(everything)
        self.inputs = [t[self.ids].requires_grad_() for t in everything]
        results = self._composite()
        self.images = [result.values for result in results]
        self.cuts = [result.cut for result in results]

    def _project(self, inputs: list[Tensor], view: int) -> Splats:
        means, quats, scales, opacities, sh = inputs
        scene = self.scene
        camera = scene.viewmats[view].cpu().double(), scene.Ks[view].cpu().double()
        return project_splats(
            means, quats, scales.exp(), opacities.sigmoid(), sh, *camera, scene.width, scene.height,
            sh_degree=3, near_plane=NEAR, far_plane=FAR, eps2d=EPS2D, antialiased=self.antialiased,
        )  # fmt: skip

    def _reaching(self, inputs: list[Tensor]) -> Tensor:
        found = torch.zeros(len(inputs[0]), dtype=torch.bool)
        for view in range(len(self.scene.viewmats)):
            splats = self._project(inputs, view)
            low, high = _boxes(splats)
            for _, rows, columns in (place for place in self.places if place[0] == view):
                found[splats.ids[_overlap(low, high, rows, columns)]] = True
        return found.nonzero()[:, 0]

    def _composite(self) -> list[Composite]:
        splats = [self._project(self.inputs, view) for view in range(len(self.scene.viewmats))]
        boxes = [_boxes(s) for s in splats]
        results = []
        for view, rows, columns in self.places:
            s, near = splats[view], _overlap(*boxes[view], rows, columns)
            means2d = s.means2d[near] - torch.tensor([columns.start, rows.start])
            size = columns.stop - columns.start, rows.stop - rows.start
            parts = (s.conics[near], s.opacities[near], s.colors[near], s.depths[near])
            results.append(composite(means2d, *parts, *size))
        return results


@torch.no_grad()
def _boxes(splats: Splats) -> tuple[Tensor, Tensor]:
    """Return the lower and upper corners [M, 2], px, of the boxes outside which alpha is below 1/255."""
    variances = splats.factors.square().sum(dim=-1) + EPS2D
    reach = (2 * torch.log(255 * splats.opacities).clamp(min=0)[:, None] * variances).sqrt()
    # The tenth of a pixel leaves room for rounding.
    return splats.means2d - reach - 0.1, splats.means2d + reach + 0.1


def _overlap(low: Tensor, high: Tensor, rows: slice, columns: slice) -> Tensor:
    """Return which boxes reach into a window, bool [M]."""
    first = torch.tensor([columns.start, rows.start])
    last = torch.tensor([columns.stop, rows.stop])
    return ((low < last) & (high > first)).all(dim=1)


def _places(scene: BenchmarkScene, size: int) -> Iterator[tuple[int, slice, slice]]:
    width, height = min(size, scene.width), min(size, scene.height)
    right, bottom = scene.width - width, scene.height - height
    corners = {(0, 0), (right, 0), (0, bottom), (right, bottom)}
    inner = {(right // 2, bottom // 2), (right // 3, 2 * bottom // 3), (3 * right // 4, bottom // 4)}
    for view in range(len(scene.viewmats)):
        for x, y in sorted(corners | inner):
            yield view, slice(y, y + height), slice(x, x + width)


@dataclass(frozen=True)
class Option:
    """One setting of the renderer."""

    name: str
    antialiased: bool = False
    deterministic: bool = False
    views: int = 1
    exchanged: bool = False  # splats pass through the exchange of one rank: all costs but the transfer
    dtype: torch.dtype = torch.float32


@dataclass
class Figures:
    """Time of an option, and its errors against the definition."""

    name: str
    milliseconds: float  # per view
    image_error: float
    gradient_error: float
    cut_pixels: float  # share of the pixels that lie on a cut and are left out


def options_for(device: str) -> list[Option]:
    """Return the options of this device; the first is the default."""
    options = [
        Option("default"),
        Option("antialiased", antialiased=True),
        Option("batch of 4 views", views=4),
        Option("exchange", exchanged=True),
    ]
    if device == "cpu":
        return [*options, Option("float64", dtype=torch.float64)]
    return [*options, Option("deterministic", deterministic=True)]


class Renderer:
    """The training path between parameters and image, with one option."""

    def __init__(self, scene: BenchmarkScene, option: Option) -> None:
        device = scene.means.device
        raw = scene.raw()
        self.table = GaussianTable.create(raw)
        for name in PARAMETERS:
            self.table[name] = raw[name].to(option.dtype)
        viewmats, Ks = scene.viewmats.to(option.dtype), scene.Ks.to(option.dtype)
        self.views = Views(viewmats, Ks, scene.width, scene.height)
        self.options = RenderOptions(
            sh_degree=3, near_plane=NEAR, far_plane=FAR, eps2d=EPS2D, antialiased=option.antialiased,
            deterministic=option.deterministic,
        )  # fmt: skip
        self.assignment: TileAssignment | None = None
        self.transport: Transport = LocalTransport()
        if option.exchanged:
            columns, lines = tile_counts(scene.width, scene.height, TILE_SIZE)
            bounds = (0, len(Ks) * columns * lines)
            ranges = TileRanges(bounds, len(Ks), scene.width, scene.height)
            ranks = Ranks(device=device)
            self.assignment = TileAssignment(ranks, ranges)
            self.transport = CollectiveTransport(ranks)

    def forward(self) -> Frame:
        """Render."""
        return render_frame(
            self.table, self.views, self.options, assignment=self.assignment, transport=self.transport
        )

    def step_ms(self, repeats: int) -> float:
        """Return the milliseconds of forward and backward, per view."""
        v_renders = torch.randn_like(self.forward().renders)

        def step(mark: Callable[[str], None]) -> None:
            parameter_gradients(self.table, self.forward(), v_renders)
            mark("step")

        return stage_medians(step, repeats, device=v_renders.device)[-1][1] / len(self.views)


@cache
def exact_windows(scene: BenchmarkScene, antialiased: bool) -> ExactWindows:
    return ExactWindows(scene, antialiased)


def errors(scene: BenchmarkScene, renderer: Renderer) -> tuple[float, float, float]:
    """Return the image error, the gradient error and the share of cut pixels."""
    exact = exact_windows(scene, renderer.options.antialiased)
    frame = renderer.forward()
    generator = torch.Generator().manual_seed(0)
    v_renders = torch.zeros_like(frame.renders)
    image_error, expected_loss, cut = 0.0, torch.zeros((), dtype=torch.float64), 0.0
    for place, image, cut_here in zip(exact.places, exact.images, exact.cuts, strict=True):
        keep = ~cut_here
        difference = frame.renders[place].cpu().double() - image.detach()
        if keep.any():
            image_error = max(image_error, difference[keep].abs().max().item())
        cut += cut_here.double().mean().item() / len(exact.places)
        weights = torch.randn(image.shape, generator=generator, dtype=torch.float64) * keep[..., None]
        expected_loss = expected_loss + (image * weights).sum()
        v_renders[place] += weights.to(v_renders)
    actual = parameter_gradients(renderer.table, frame, v_renders)
    expected = torch.autograd.grad(expected_loss, exact.inputs, retain_graph=True)
    return (
        image_error,
        _gradient_error(actual, expected, frame.projected.visible_ids.cpu().long(), exact.ids),
        cut,
    )


def _gradient_error(
    actual: tuple[Tensor, ...], expected: tuple[Tensor, ...], visible: Tensor, ids: Tensor
) -> float:
    """Compare gradients of the Gaussians `visible` with those of `ids`; all others are zero."""
    worst = 0.0
    for value, target in zip(actual, expected, strict=True):
        difference = value.cpu().double()
        at = torch.searchsorted(visible, ids).clamp(max=len(visible) - 1)
        seen = visible[at] == ids
        difference[at[seen]] -= target[seen]
        error = difference.abs().max().item()
        if not seen.all():
            error = max(error, target[~seen].abs().max().item())
        worst = max(worst, error / target.abs().max().item())
    return worst


def measure(option: Option, scenes: dict[int, BenchmarkScene], repeats: int) -> Figures:
    scene = scenes[option.views]
    renderer = Renderer(scene, option)
    image_error, gradient_error, cut = errors(scene, renderer)
    return Figures(option.name, renderer.step_ms(repeats), image_error, gradient_error, cut)


def measure_library(folder: Path, arguments: list[str]) -> Figures:
    """Measure the default setting in a process that loads the kernels of another build."""
    with tempfile.TemporaryDirectory() as out:
        path = Path(out) / "accuracy.json"
        subprocess.run(
            [sys.executable, __file__, *arguments, "--only", "default", "--json", str(path)],
            env={**os.environ, "BLITZGS_LIBRARY_DIR": str(folder)},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        (row,) = json.loads(path.read_text())["rows"]
    return replace(Figures(**row), name="exact exponential")


def require_bounds(default: Figures) -> None:
    if default.image_error > IMAGE_BOUND or default.gradient_error > GRADIENT_BOUND:
        raise SystemExit(
            f"the default setting misses its bounds: image {default.image_error:.1e} of {IMAGE_BOUND:.0e}, "
            f"gradients {default.gradient_error:.1e} of {GRADIENT_BOUND:.0e}"
        )


def main() -> None:
    parser = make_parser(__doc__, repeats=10)
    parser.add_argument("--gaussians", type=int, help="default: 4 million on CUDA, 100 thousand on the CPU")
    parser.add_argument("--width", type=int, help="default: 1600 px on CUDA, 400 px on the CPU")
    parser.add_argument("--only", help="the one option to measure")
    parser.add_argument("--exact-library", type=Path, help="kernels built with BLITZGS_EXACT_EXP=ON")
    args = parser.parse_args()
    on_gpu = args.device.startswith("cuda")
    gaussians = args.gaussians or (4_000_000 if on_gpu else 100_000)
    width = args.width or (1600 if on_gpu else 400)
    batch = aerial(gaussians, args.device, views=4, width=width, height=width * 2 // 3)
    scenes = {1: batch.first_views(1), 4: batch}
    title = f"{args.device}, {gaussians:,} Gaussians, {batch.width} x {batch.height}"
    print(f"{title}\n", flush=True)
    rows: list[Figures] = []

    def add(figures: Figures) -> None:
        rows.append(figures)
        lines = accuracy_lines({"rows": [asdict(figures)]})
        print("\n".join(lines[0 if len(rows) == 1 else -1 :]), flush=True)
        write_json(args.json, args.device, title=title, rows=[asdict(row) for row in rows])

    for option in options_for(args.device):
        if args.only in (None, option.name):
            add(measure(option, scenes, args.repeats))
    if args.exact_library:
        repeated = f"--gaussians {gaussians} --width {width} --repeats {args.repeats}"
        add(measure_library(args.exact_library, ["--device", args.device, *repeated.split()]))
    require_bounds(rows[0])


if __name__ == "__main__":
    main()
