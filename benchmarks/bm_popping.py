# SPDX-License-Identifier: Apache-2.0
"""Measures what the LOD gate changes: popping along a descending flight, and what a view can leave out.

    python benchmarks/bm_popping.py RUN [--frames 240] [--out FOLDER] [--device cuda] [--json FILE]
    python benchmarks/bm_popping.py RUN --curve [--device cuda] [--json FILE]

The flight goes down the viewing axis of one of the run's cameras towards what it looks at, by the same ratio
of distances from frame to frame, so that levels come at an even pace. Each frame is rendered with all
Gaussians ("full"), with the LOD gate ("gated") and with smooth levels ("smooth"), of the same model.

Two things are measured, as means of |difference| over the pixels in 1/255. The change of a frame is its
difference from the frame before, most of which is the flight itself: "full" says how much. The popping of a
frame is its difference from the same view with the levels and weights that the frame before had, so that
only the levels have changed. Both are reported as the mean and the largest over the frames; of the popping,
also the value that one pixel in 1,000 exceeds in the worst frame. More frames make smaller steps.

Into the folder go a chart of the popping (popping.svg) and the clip (popping.mp4: full, gated, smooth).

With --curve, views of the run's cameras are rendered with all Gaussians, and again without those that a rule
puts below a threshold, which is the same for all views: by octree level and distance (as the gate of a run
without view.footprint does), by footprint (as with view.footprint), and by the contribution to the very view,
which no rule of distances can beat. For each share of the splats that is left out, the table has the
threshold, the share of the light (sum of alpha T) and the PSNR against the picture with all.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from harness import make_parser, report
from torch import Tensor

from blitzgs.capture.pictures import to_uint8
from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import RenderOptions, Views, render_frame
from blitzgs.frame.survey import survey
from blitzgs.ops.blocks import ActiveRows
from blitzgs.runs import run_files
from blitzgs.runs.cameras import load_cameras
from blitzgs.runs.lod import MOST_KEPT, level_fork
from blitzgs.runs.run_files import TrainedModel
from blitzgs.table.table import GaussianTable
from blitzgs.util.charts import line_chart
from blitzgs.view.gate import LodGate, SceneGate, centres_of
from blitzgs.view.levels import footprint_sizes
from blitzgs.view.views import CameraLike, ViewSet, render_options

MODES = ("full", "gated", "smooth")
FRAMES_PER_SECOND = 30.0
# The flight begins and ends at these multiples of the distance between the camera and what it looks at.
FARTHEST, NEAREST = 4.0, 0.5


def popping(
    run: Path,
    out: Path | None = None,
    device: str = "cpu",
    frames: int = 240,
    width: int = 640,
    camera: str | None = None,
) -> dict[str, Any]:
    """Measure the popping of a run's model.

    Args:
        run: folder of the run.
        out: folder for popping.svg and popping.mp4; None: write nothing.
        device: renders the frames.
        frames: number of frames of the flight, at least 2.
        width: width of the frames in pixels, at most that of the camera.
        camera: name of the view along whose axis the flight goes; None: the view closest to the mean axis.

    Returns:
        "frames", "levels" (K), and for each of "full", "gated" and "smooth" a dictionary: "mean_change" and
        "largest_change", and but for "full" "mean", "largest" and "pixel" of the popping, as above, and
        "kept", the mean share of the Gaussians that a frame keeps.

    Raises:
        ValueError: there are fewer than 2 frames, no view of that name, or nothing in front of the camera.
        OSError: the clip cannot be written.
    """
    ranks = Ranks(device=torch.device(device))
    model = run_files.open_model(run, ranks)
    return popping_of(model, load_cameras(run).cameras, ranks, out, frames, width, camera)


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
    """Measure the popping of a model in memory: as `popping`, with the cameras of its capture."""
    if frames < 2:
        raise ValueError(f"a flight has at least 2 frames, got {frames}")
    viewmats, K, size = _flight(model, cameras, frames, width, camera)
    gates: dict[str, SceneGate | None] = {"full": None}
    gates |= {mode: _gate(model, mode == "smooth", ranks) for mode in MODES[1:]}
    clip = None if out is None else _Clip(out / "popping.mp4", 3 * size[0], size[1])
    flights = {mode: _Flight(model, K, size, gate) for mode, gate in gates.items()}
    for viewmat in viewmats.to(ranks.device):
        images = [flight.next(viewmat[None]) for flight in flights.values()]
        if clip is not None:
            clip.add(torch.cat(images, dim=1))
    found: dict[str, Any] = {"frames": frames, "levels": model.progress.level_count}
    found |= {mode: flight.figures() for mode, flight in flights.items()}
    if out is not None and clip is not None:
        clip.close()
        lines = {mode: list(enumerate(flights[mode].popping, 1)) for mode in MODES[1:]}
        chart = line_chart(lines, "frame", "popping, mean over pixels, 1/255")
        (out / "popping.svg").write_text(chart)
    return found


# Shares of the splats that a rule leaves out.
RULES = ("octree level", "footprint", "contribution")
SHARES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)


@torch.no_grad()
def curve_of(
    model: TrainedModel, cameras: Any, device: torch.device, views: int = 16
) -> list[dict[str, Any]]:
    """Measure what views lose without the splats that a rule puts last, for each rule and share of `SHARES`.

    Args:
        model: the model; its table is on `device`.
        cameras: the cameras of its capture, of which every n-th is a view.
        device: renders the views.
        views: number of views.

    Returns:
        For each rule and share "rule", "left out" (share of the splats), "threshold" (of the levels: the
        factor by which the gate's distances shrink; of the footprints: pixels; of the contributions: sum of
        alpha T in pixels), "light" (share of the sum of alpha T that goes) and "PSNR against all".
    """
    chosen = [cameras[i * len(cameras) // views] for i in range(min(views, len(cameras)))]
    table, poses = model.table, ViewSet(chosen, model.space, device)
    options = render_options(model.config, model.space, model.progress.sh_degree)
    count = model.progress.level_count
    gate = LodGate(model.progress.reference_distance, level_fork(model.config), count, count - 1)
    reach = torch.tensor(gate.reach(), dtype=torch.float64, device=device)[table["level"].long()]
    size = footprint_sizes(table["scales"], table["opacities"]).exp()
    seen = []
    for index in range(len(chosen)):
        view = poses.pick([index])
        found = survey(table, view, options)
        rows, light = found.splats.gaussian_ids.long(), found.weights.double() * 2.0**-32
        distance = (table["means"][rows].double() - centres_of(view.viewmats)[0]).norm(dim=1)
        footprint = size[rows] * float(view.Ks[0, 0, 0]) / distance
        keys = dict(zip(RULES, (reach[rows] / distance, footprint, light), strict=True))
        image = render_frame(table, view, options).renders[0].clamp(0, 1)
        seen.append((view, rows, light, keys, image))
    lines = []
    for rule in RULES:
        ordered = torch.cat([keys[rule] for *_, keys, _ in seen]).sort().values
        for share in SHARES:
            threshold = float(ordered[int(share * len(ordered))])
            if math.isinf(threshold):  # views keep level 0 at any distance
                break
            error = kept = lit = 0.0
            for view, rows, light, keys, image in seen:
                stays = keys[rule] >= threshold
                active = _rows(rows[stays])
                without = render_frame(table, view, options, active).renders[0].clamp(0, 1)
                error += float((without - image).square().mean()) / len(seen)
                kept += float(stays.sum())
                lit += float(light[stays].sum() / light.sum()) / len(seen)
            lines.append(
                {
                    "rule": rule,
                    "left out": 1.0 - kept / len(ordered),
                    "threshold": threshold,
                    "light": 1.0 - lit,
                    "PSNR against all": -10.0 * math.log10(error) if error > 0 else math.inf,
                }
            )
    return lines


def _rows(rows: Tensor) -> ActiveRows:
    """Return the active set of one view that sees these rows, int64 [U]."""
    ids = rows.sort().values.int()
    return ActiveRows(
        ids, torch.ones_like(ids), torch.tensor([len(ids)], dtype=torch.int32, device=ids.device)
    )


class _Flight:
    """Renders one frame after the other in one way, and records the changes."""

    def __init__(
        self, model: TrainedModel, K: Tensor, size: tuple[int, int], scene: SceneGate | None
    ) -> None:
        self._model, self._K, self._size, self._scene = model, K, size, scene
        lod = None if scene is None else scene.gate
        self._options = render_options(model.config, model.space, model.progress.sh_degree, lod)
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
            if self._scene is not None:
                popped = (image - self._with_levels_of(last_pose, viewmats)).abs().mean(2).flatten() * 255
                self.popping.append(float(popped.mean()))
                if self.popping[-1] == max(self.popping):
                    self._worst = popped
        self._before = viewmats, image
        return image

    def figures(self) -> dict[str, float]:
        """Return the figures of this way to render, as `popping` returns them."""
        found = {"mean_change": _mean(self._changes), "largest_change": max(self._changes)}
        if self._scene is None:
            return found
        pixel = float(self._worst.topk(max(1, len(self._worst) // 1000)).values[-1])
        popped = {"mean": _mean(self.popping), "largest": max(self.popping), "pixel": pixel}
        return found | popped | {"kept": _mean(self._kept)}

    def _active(self, viewmats: Tensor) -> ActiveRows | None:
        return None if self._scene is None else self._scene.active(self._model.table, viewmats)

    def _with_levels_of(self, other: Tensor, viewmats: Tensor) -> Tensor:
        """Return the image from a pose, with the Gaussians and weights of the pose `other`."""
        assert self._scene is not None
        table, gate = self._model.table, self._scene.gate
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


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _gate(model: TrainedModel, smooth: bool, ranks: Ranks) -> SceneGate:
    """Return the gate that the run has or would have at its end."""
    progress, config = model.progress, model.config
    count = progress.level_count
    finest = count - 1 if progress.finest_level is None else progress.finest_level
    gate = LodGate(progress.reference_distance, level_fork(config), count, finest, smooth)
    return SceneGate(gate, math.inf if smooth else MOST_KEPT, model.table, ranks)


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
        chosen: CameraLike = cameras[int((axes @ axes.mean(0)).argmax())]
        return chosen
    for camera in cameras:
        if camera.name == name:
            found: CameraLike = camera
            return found
    raise ValueError(f"the run has no view '{name}'; it has for example {cameras[0].name}")


class _Clip:
    """A video file that grows frame by frame."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The codec needs even edges.
        self._size = width // 2 * 2, height // 2 * 2
        self._writer = cv2.VideoWriter(
            str(path), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_SECOND, self._size
        )
        if not self._writer.isOpened():
            raise OSError(f"{path}: OpenCV cannot write MP4 files here; call without an output folder")

    def add(self, image: Tensor) -> None:
        width, height = self._size
        self._writer.write(np.ascontiguousarray(to_uint8(image)[:height, :width, ::-1]))

    def close(self) -> None:
        self._writer.release()


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__)
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("--out", type=Path, help="folder for the chart and the clip (RUN/popping)")
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--width", type=int, default=640, help="of the frames in pixels")
    parser.add_argument("--camera", help="name of the view whose axis is flown along")
    parser.add_argument("--curve", action="store_true", help="measure what views can leave out, not popping")
    options = parser.parse_args(arguments)
    if options.curve:
        ranks = Ranks(device=torch.device(options.device))
        model = run_files.open_model(options.run, ranks)
        lines = curve_of(model, load_cameras(options.run).cameras, ranks.device)
        title = f"What views of {options.run.name} can leave out"
        return report(title, lines, options.json, options.device)
    out = options.out or options.run / "popping"
    found = popping(options.run, out, options.device, options.frames, options.width, options.camera)
    rows = [
        {
            "levels": mode,
            "largest change": found[mode]["largest_change"],
            "mean change": found[mode]["mean_change"],
            "largest popping": found[mode].get("largest", 0.0),
            "mean popping": found[mode].get("mean", 0.0),
            "worst pixels": found[mode].get("pixel", 0.0),
            "kept": found[mode].get("kept", 1.0),
        }
        for mode in MODES
    ]
    title = f"Popping of {options.run.name} over {found['frames']} frames, {found['levels']} levels"
    report(title, rows, options.json, options.device)


if __name__ == "__main__":
    main()
