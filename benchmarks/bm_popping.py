# SPDX-License-Identifier: Apache-2.0
"""Measures what the LOD gate changes: popping along a descending flight.

    python benchmarks/bm_popping.py RUN [--frames 240] [--out FOLDER] [--device cuda] [--json FILE]

The flight goes down the viewing axis of one of the run's cameras towards what it looks at, by the same ratio
of distances from frame to frame, so that levels come at an even pace. Each frame is rendered with all
Gaussians ("full"), with the LOD gate ("gated") and with smooth levels ("smooth"), of the same model.

Two things are measured, as means of |difference| over the pixels in 1/255. The change of a frame is its
difference from the frame before, most of which is the flight itself: "full" says how much. The popping of a
frame is its difference from the same view with the levels and weights that the frame before had, so that
only the levels have changed. Both are reported as the mean and the largest over the frames; of the popping,
also the value that one pixel in 1,000 exceeds in the worst frame. More frames make smaller steps.

Into the folder go a chart of the popping (popping.svg) and the clip (popping.mp4: full, gated, smooth).
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from harness import make_parser, report
from torch import Tensor

from blitzgs.capture.pictures import to_uint8
from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.projection_types import Views
from blitzgs.runs import trained_model
from blitzgs.runs.cameras import load_cameras
from blitzgs.runs.trained_model import MOST_KEPT, TrainedModel
from blitzgs.table.table import GaussianTable
from blitzgs.util.charts import line_chart
from blitzgs.view.gate import LodGate, ModelGate, centres_of
from blitzgs.view.levels import level_fork
from blitzgs.view.views import CameraLike, ViewSet, render_options
from blitzgs.viewer.film import new_film

MODES = ("full", "gated", "smooth")
# The flight begins and ends at these multiples of the distance between the camera and what it looks at.
FARTHEST, NEAREST = 4.0, 0.5


def popping(run: Path, out: Path | None = None, device: str = "cpu", **options: Any) -> dict[str, Any]:
    """Measure the popping of the model of a run: as `popping_of`, on a device."""
    ranks = Ranks(device=torch.device(device))
    return popping_of(trained_model.open_model(run, ranks), load_cameras(run).cameras, ranks, out, **options)


@torch.no_grad()
def popping_of(
    model: TrainedModel,
    cameras: Any,
    ranks: Ranks,
    out: Path | None = None,
    frames: int = 240,
    width: int = 640,
    camera: str | None = None,
) -> dict[str, Any]:
    """Measure the popping of a model.

    `ranks`: this process alone. `out`: folder for popping.svg and popping.mp4; None: write nothing. `width`:
    of the frames in pixels, at most that of the camera. `camera`: name of the view along whose axis the
    flight goes; None: the view closest to the mean axis.

    Returns "frames", "levels" (K), and for each of "full", "gated" and "smooth" a dictionary: "mean_change"
    and "largest_change", and but for "full" "mean", "largest" and "pixel" of the popping, as above, and
    "kept", the mean share of the Gaussians that a frame keeps. ValueError: there are fewer than 2 frames, no
    view of that name, or nothing in front of the camera. OSError: the clip cannot be written.
    """
    if frames < 2:
        raise ValueError(f"a flight has at least 2 frames, got {frames}")
    viewmats, K, size = _flight(model, cameras, frames, width, camera)
    gates: dict[str, ModelGate | None] = {"full": None}
    gates |= {mode: _gate(model, mode == "smooth", ranks) for mode in MODES[1:]}
    flights = {mode: _Flight(model, K, size, gate) for mode, gate in gates.items()}
    width, height = 3 * size[0] // 2 * 2, size[1] // 2 * 2  # the codec needs even edges
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    with nullcontext() if out is None else new_film(out / "popping.mp4", width, height, 30.0) as append:
        for viewmat in viewmats.to(ranks.device):
            images = [flight.next(viewmat[None]) for flight in flights.values()]
            if append is not None:
                append(to_uint8(torch.cat(images, dim=1))[:height, :width])
    found: dict[str, Any] = {"frames": frames, "levels": model.progress.level_count}
    found |= {mode: flight.figures() for mode, flight in flights.items()}
    if out is not None:
        lines = {mode: list(enumerate(flights[mode].popping, 1)) for mode in MODES[1:]}
        chart = line_chart(lines, "frame", "popping, mean over pixels, 1/255")
        (out / "popping.svg").write_text(chart)
    return found


class _Flight:
    """Renders one frame after the other in one way, and records the changes."""

    def __init__(self, model: TrainedModel, K: Tensor, size: tuple[int, int], lod: ModelGate | None) -> None:
        self._model, self._K, self._size, self._lod = model, K, size, lod
        gate = None if lod is None else lod.gate
        self._options = render_options(model.config, model.space, model.progress.sh_degree, gate)
        self._before: tuple[Tensor, Tensor] | None = None
        self._changes: list[float] = []
        self._kept: list[float] = []
        self._worst = torch.zeros(1)
        self.popping: list[float] = []

    def next(self, viewmats: Tensor) -> Tensor:
        """Return the image [H, W, 3] in [0, 1] from a pose, [1, 4, 4]."""
        table, active = self._model.table, self._active(viewmats)
        image = self._render(table, viewmats, self._options, active)
        self._kept.append(1.0 if active is None else float((active.views != 0).double().mean()))
        if self._before is not None:
            last_pose, last_image = self._before
            self._changes.append(float((image - last_image).abs().mean()) * 255)
            if self._lod is not None:
                popped = (image - self._with_levels_of(last_pose, viewmats)).abs().mean(2).flatten() * 255
                self.popping.append(float(popped.mean()))
                if self.popping[-1] == max(self.popping):
                    self._worst = popped
        self._before = viewmats, image
        return image

    def figures(self) -> dict[str, float]:
        """Return the figures of this way to render, as `popping` returns them."""
        found = {"mean_change": fmean(self._changes), "largest_change": max(self._changes)}
        if self._lod is None:
            return found
        pixel = float(self._worst.topk(max(1, len(self._worst) // 1000)).values[-1])
        popped = {"mean": fmean(self.popping), "largest": max(self.popping), "pixel": pixel}
        return found | popped | {"kept": fmean(self._kept)}

    def _active(self, viewmats: Tensor) -> ActiveRows | None:
        return None if self._lod is None else self._lod.active(self._model.table, viewmats)

    def _with_levels_of(self, other: Tensor, viewmats: Tensor) -> Tensor:
        """Return the image from a pose, with the Gaussians and weights of the pose `other`."""
        assert self._lod is not None
        table, gate = self._model.table, self._lod.gate
        if gate.smooth:
            weights = gate.weights(table["means"], table["level"], centres_of(other)[0])
            opacities = (table["opacities"].double().sigmoid() * weights).logit().float()
            table = GaussianTable(table.columns | {"opacities": opacities})
        return self._render(table, viewmats, replace(self._options, fade=()), self._active(other))

    def _render(
        self, table: GaussianTable, viewmats: Tensor, options: RenderOptions, active: ActiveRows | None
    ) -> Tensor:
        views = Views(viewmats, self._K.to(viewmats.device)[None], *self._size)
        return render_frame(table, views, options, active).renders[0].clamp(0, 1)


def _gate(model: TrainedModel, smooth: bool, ranks: Ranks) -> ModelGate:
    """Return the gate that the run has or would have at its end."""
    progress, config = model.progress, model.config
    count = progress.level_count
    finest = count - 1 if progress.finest_level is None else progress.finest_level
    gate = LodGate(progress.reference_distance, level_fork(config), count, finest, smooth)
    return ModelGate(gate, MOST_KEPT, model.table, ranks)


def _flight(
    model: TrainedModel, cameras: Any, frames: int, width: int, name: str | None
) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Return the poses [frames, 4, 4], the intrinsics [3, 3] and the size in pixels of the frames."""
    chosen = _camera(cameras, name)
    view = ViewSet([chosen], model.space, torch.device("cpu")).pick([0])
    pose, K = view.viewmats[0].double(), view.Ks[0].clone()
    scale = min(1.0, width / chosen.width)
    size = round(chosen.width * scale), round(chosen.height * scale)
    K[0] *= size[0] / chosen.width
    K[1] *= size[1] / chosen.height
    points = model.table["means"].cpu().double() @ pose[:3, :3].T + pose[:3, 3]
    slopes = points[:, :2] / points[:, 2:]
    # The depths around the middle of the picture give the distance.
    seen = (points[:, 2] > 0) & (slopes.abs() < 0.1 * chosen.width / float(view.Ks[0, 0, 0])).all(1)
    if not bool(seen.any()):
        raise ValueError(
            f"there is no Gaussian in front of the middle of {chosen.name}: choose another --camera"
        )
    distance = float(points[seen, 2].median())
    share = torch.linspace(0, 1, frames, dtype=torch.float64)
    poses = pose.repeat(frames, 1, 1)
    poses[:, 2, 3] += distance * (FARTHEST * (NEAREST / FARTHEST) ** share - 1)
    return poses.float(), K, size


def _camera(cameras: Any, name: str | None) -> CameraLike:
    if name is None:
        axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
        return cameras[int((axes @ axes.mean(0)).argmax())]
    for camera in cameras:
        if camera.name == name:
            return camera
    raise ValueError(f"the run has no view '{name}'; it has for example {cameras[0].name}")


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__)
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--out", type=Path, help="folder for the chart and the clip (RUN/popping)")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--width", type=int, default=640, help="of the frames in pixels")
    parser.add_argument("--camera", help="name of the view whose axis is flown along")
    options = parser.parse_args(arguments)
    out = options.out or options.run / "popping"
    flight = {name: getattr(options, name) for name in ("frames", "width", "camera")}
    found = popping(options.run, out, options.device, **flight)
    nothing = {"mean": 0.0, "largest": 0.0, "pixel": 0.0, "kept": 1.0}
    rows = [{"levels": mode} | nothing | found[mode] for mode in MODES]
    title = f"Popping of {options.run.name} over {found['frames']} frames, {found['levels']} levels"
    report(title, rows, options.json, options.device)


if __name__ == "__main__":
    main()
