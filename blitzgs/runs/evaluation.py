# SPDX-License-Identifier: Apache-2.0
"""Measures renders against their photographs: PSNR, SSIM and, given weights, LPIPS; writes pictures.

The report shows small pictures of the best and worst views, and of evenly spaced ones: `previews` beside
`metrics.json` has NUMBER_render.webp, NUMBER_photograph.webp and NUMBER_error.webp, where NUMBER is that of
the camera among all of the run, and `views.json`, the list of these numbers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.images import ImageStore, PhotographError
from blitzgs.capture.pictures import comparison, encode_image, error_map, to_uint8
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.frame.tiles import TileAssignment, collect_images
from blitzgs.ops.photometric import ssim
from blitzgs.util.errors import explain_memory, warn
from blitzgs.util.output import OutputFolder
from blitzgs.util.progress import Report
from blitzgs.view.views import CameraLike, ViewSet
from blitzgs.view.visible import Subject, VisibleFinder

Lpips = Callable[[Tensor, Tensor], Tensor]
Stops = Callable[[], bool]
METRICS = ("psnr", "ssim", "psnr_corrected", "lpips")


class EvaluationStoppedError(Exception):
    """An evaluation was given up because the run has to stop."""


def image_metrics(
    render: Tensor, target: Tensor, mask: Tensor | None, lpips: Lpips | None = None
) -> dict[str, float]:
    """Return PSNR in dB, SSIM, the PSNR after `correct_colours` ("psnr_corrected"), and LPIPS of one view.

    The render, float [H, W, 3], is clamped to [0, 1] and not quantised; the target is uint8 [H, W, 3]. Pixels
    with 0 in the mask, uint8 [H, W], are left out of all metrics but LPIPS.
    """
    render = render.clamp(0.0, 1.0)
    mask = None if mask is None else mask.to(target.device)
    counted = torch.ones_like(target[..., 0]) if mask is None else mask
    pixels, wanted = render[counted != 0].double(), target[counted != 0].double() / 255.0
    similarity = ssim(render[None], target[None], None if mask is None else mask[None])
    metrics = {
        "psnr": _psnr(pixels, wanted),
        "ssim": similarity.item(),
        "psnr_corrected": _psnr(correct_colours(pixels, wanted), wanted),
    }
    if lpips is not None:
        pair = (image.permute(2, 0, 1)[None].cpu() * 2 - 1 for image in (render, target.float() / 255))
        metrics["lpips"] = float(lpips(*pair))
    return metrics


def correct_colours(pixels: Tensor, wanted: Tensor) -> Tensor:
    """Apply the affine colour map (3 x 4) that brings `pixels` closest to `wanted`, float64 [P, 3]; clamped.

    The map is fitted by least squares over the pixels of one view. It removes differences of exposure and
    white balance, which are properties of the photograph and not of the scene.
    """
    mean, rest = wanted.mean(0), pixels - pixels.mean(0)
    squares, axes = torch.linalg.eigh(rest.T @ rest)
    # Along an axis on which the colours differ by the rounding of float32 alone, all maps are equally good.
    along = rest @ axes[:, squares > 1e-12 * len(pixels)]
    gains = along.T @ (wanted - mean) / along.square().sum(0)[:, None]
    return (mean + along @ gains).clamp(0.0, 1.0)


def _psnr(pixels: Tensor, wanted: Tensor) -> float:
    """Return the PSNR in dB of colours [P, 3]; 120 if they are equal or P is 0."""
    mse = ((pixels - wanted) ** 2).sum().item() / max(1, pixels.numel())
    return -10.0 * math.log10(max(mse, 1e-12))


def load_lpips(path: str | None) -> Lpips | None:
    """Load a perceptual metric: a TorchScript module (render, target) -> distance, [1, 3, H, W] in [-1, 1].

    ValueError: the file is missing or not a TorchScript module.
    """
    try:
        return None if path is None else torch.jit.load(path, map_location="cpu")
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is not readable TorchScript of LPIPS (--lpips): {error}") from error


def render_view(
    finder: VisibleFinder,
    views: ViewSet,
    index: int,
    options: RenderOptions,
    owners: TileOwners,
    destination: int = 0,
) -> Tensor | None:
    """Render camera `index` with the Gaussians of all ranks; every rank calls this.

    Returns float32 [H, W, 3] on rank `destination`, the same bits at any number of ranks; None elsewhere.
    """
    picked, ranks = views.pick([index]), owners.ranks
    table, active, _ = finder.find(picked, options.limits)
    try:
        if ranks.world_size == 1:
            return render_frame(table, picked, options, active).renders[0]
        ranges = owners.divide([index], picked.width, picked.height)
        frame = render_frame(table, picked, options, active, TileAssignment(ranks, ranges))
    except (RuntimeError, MemoryError) as error:
        explain_memory(error, 1, picked.width, picked.height, len(table), ranks.device)
        raise
    owners.record([index], frame.tile_work, ranges)
    collect_images(frame.renders, ranges, ranks, destination)
    return frame.renders[0] if ranks.rank == destination else None


def evaluate(
    subject: Subject,
    views: ViewSet,
    cameras: Sequence[CameraLike],
    images: ImageStore,
    indices: Sequence[int],
    folder: Path | None,
    owners: TileOwners,
    *,
    pictures: int = 0,
    lpips: Lpips | None = None,
    report: Report | None = None,
    inputs: Iterable[Path] = (),
    optional_files: bool = False,
    stops: Stops | None = None,
) -> dict[str, Any]:
    """Render views and compare them with their photographs; the ranks take turns at comparing.

    Args:
        folder: folder for `metrics.json` and the pictures; None: nothing is written.
        pictures: number of evenly spaced views for which render | photograph | error are written side by
            side; if not 0, the previews of the report are written too.
        optional_files: if a file cannot be written, warn instead of raising an OSError.
        stops: asked after each round in which every rank compares one view, with the same answer on every
            rank; True ends the evaluation (EvaluationStoppedError).

    Returns {"psnr": mean, "ssim": mean, "psnr_corrected": mean, ("lpips": mean,) "views": {name: {...}}}, the
    same on every rank. Views whose pixels are all masked are left out; the means are absent if no view
    remains. PhotographError: a photograph cannot be read; raised on every rank after the others are measured.
    """
    ranks = owners.ranks
    output = None if folder is None else OutputFolder(folder, inputs)
    chosen: dict[int, Path] = {}  # evenly spaced views, and the paths of their pictures

    @contextmanager
    def tolerated() -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not optional_files:
                raise
            warn(f"the evaluation could not write a file and goes on without it: {error}")

    def write(path: Path, content: bytes) -> None:
        with tolerated():
            if output is not None:
                output.write(path, content)

    if output is not None:
        count = min(pictures, len(indices))
        spaced = [indices[k * len(indices) // count] for k in range(count)]
        with tolerated():
            paths = output.paths([cameras[index].name for index in spaced], ".jpg", flat=True)
            chosen = dict(zip(spaced, paths, strict=True))
    per_view: dict[str, dict[str, float]] = {}
    lost: str | None = None
    previews = Previews(folder, set(chosen)) if folder is not None and pictures > 0 else None
    own = list(indices[ranks.rank :: ranks.world_size])
    finder = VisibleFinder(subject.gaussians, subject.lod)
    for position, index in enumerate(indices):
        turn, destination = divmod(position, ranks.world_size)
        if destination == 0:
            if stops is not None and position > 0 and stops():
                raise EvaluationStoppedError
            images.prefetch(own[turn : turn + 4])
        render = render_view(finder, views, index, subject.options, owners, destination)
        if report is not None:
            report(position + 1, len(indices))
        if render is None:
            continue
        with ranks.watchdog.working(f"comparing view {cameras[index].name}"):
            try:
                target, mask = images.get(index).to(render.device), images.mask(index)
            except (OSError, ValueError) as error:
                lost = lost or str(error)  # the other ranks continue and learn of this at the end
                continue
            if mask is not None and not bool(mask.any()):
                continue  # nothing to compare
            per_view[cameras[index].name] = image_metrics(render, target, mask, lpips)
            if index in chosen:
                write(chosen[index], encode_image(comparison(render, target, mask), ".jpg"))
            if previews is not None:
                previews.add(index, per_view[cameras[index].name]["psnr"], render, target, mask)
    result = _over_all_ranks(per_view, lost, [cameras[index].name for index in indices], ranks)
    if folder is not None and ranks.rank == 0:
        write(folder / "metrics.json", json.dumps(result, indent=1).encode())
    if previews is not None:
        measured = result["views"]
        psnr = {i: measured[cameras[i].name]["psnr"] for i in indices if cameras[i].name in measured}
        for path, content in previews.files(psnr, ranks.rank == 0):
            write(path, content)
    return result


def _over_all_ranks(
    per_view: dict[str, dict[str, float]], lost: str | None, names: list[str], ranks: Ranks
) -> dict[str, Any]:
    """Collect the metrics of all ranks, and return what `evaluate` returns. Collective.

    `lost` says why this rank could not read a photograph; None: it has read all.
    """
    parts = ranks.all_gather_object((per_view, lost))
    if reasons := [reason for _, reason in parts if reason is not None]:
        raise PhotographError("; ".join(reasons))
    found = {name: view for part, _ in parts for name, view in part.items()}
    masked = [name for name in names if name not in found]
    if masked and ranks.rank == 0:
        shown = ", ".join(masked[:5]) + (", ..." if len(masked) > 5 else "")
        warn(f"{len(masked)} of {len(names)} views cannot be measured, as they are masked: {shown}")
    views = {name: found[name] for name in names if name in found}
    values = {metric: [view[metric] for view in views.values() if metric in view] for metric in METRICS}
    return {metric: sum(some) / len(some) for metric, some in values.items() if some} | {"views": views}


def worst_views(views: Mapping[str, Mapping[str, float]]) -> list[tuple[str, float]]:
    """Return names and PSNR of at most three views, of the lower half by PSNR, the worst first."""
    ordered = sorted((view["psnr"], name) for name, view in views.items())
    return [(name, psnr) for psnr, name in ordered[: min(3, len(ordered) // 2)]]


def evenly_ordered(indices: Sequence[int]) -> list[int]:
    """Order indices such that the first few of them are spread evenly, however many are taken."""
    share = (math.sqrt(5) - 1) / 2
    return [index for _, index in sorted((k * share % 1, index) for k, index in enumerate(indices))]


FOLDER, INDEX = "previews", "views.json"
PARTS = ("render", "photograph", "error")
# Longest side in pixels, and quality of WebP.
_SIDE, _QUALITY = 720, 80
# So many of the best and as many of the worst views.
_EXTREMES = 4


class Previews:
    """Keeps the encoded pictures of this rank's candidates until all views are measured."""

    def __init__(self, folder: Path, fixed: set[int]) -> None:
        """Begin; `fixed` are cameras whose pictures are kept whatever their PSNR."""
        self._folder, self._fixed = folder / FOLDER, fixed
        self._kept: dict[int, dict[str, bytes]] = {}
        self._psnr: dict[int, float] = {}  # of this rank's views so far

    def add(self, index: int, psnr: float, render: Tensor, target: Tensor, mask: Tensor | None) -> None:
        """Take a measured view; arguments are those of `blitzgs.capture.pictures.comparison`."""
        self._psnr[index] = psnr
        needed = _extremes(self._psnr) | self._fixed
        if index in needed:
            pictures = map(_encoded, (render, target, error_map(render, target, mask)))
            self._kept[index] = dict(zip(PARTS, pictures, strict=True))
        for other in self._kept.keys() - needed:
            del self._kept[other]

    def files(self, psnr: Mapping[int, float], lists: bool) -> Iterator[tuple[Path, bytes]]:
        """Return this rank's files, given the PSNR of all ranks' views; one rank also `lists` the cameras."""
        chosen = _extremes(psnr) | (self._fixed & psnr.keys())
        for index in sorted(chosen & self._kept.keys()):
            for part, content in self._kept[index].items():
                yield preview_file(self._folder, index, part), content
        if lists:
            yield self._folder / INDEX, json.dumps(sorted(chosen)).encode()


def preview_file(folder: Path, index: int, part: str) -> Path:
    """Return the file of one of `PARTS` of a camera."""
    return folder / f"{index:06d}_{part}.webp"


def _extremes(psnr: Mapping[int, float]) -> set[int]:
    ordered = sorted(psnr, key=lambda index: (psnr[index], index))
    return {*ordered[:_EXTREMES], *ordered[-_EXTREMES:]}


def _encoded(image: Tensor) -> bytes:
    picture = to_uint8(image)
    height, width = picture.shape[:2]
    if (scale := _SIDE / max(height, width)) < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    _, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return bytes(data)
