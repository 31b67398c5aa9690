# SPDX-License-Identifier: Apache-2.0
"""Finds floaters and the fringe of a model, shows what goes, and measures views before and after."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import fmean

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import downscaled_size, scaled_matrix
from blitzgs.capture.pictures import encode_image, strip
from blitzgs.config.fields import ScoreRule
from blitzgs.distributed.group import Ranks
from blitzgs.ops.blocks import WORD_BITS
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.population import CELL_BITS, voxel_keys
from blitzgs.ops.projection_types import Views
from blitzgs.population.importance import Importance, ViewBatch, is_culled, sweep
from blitzgs.runs.cameras import RunCamera, RunCameras
from blitzgs.runs.evaluation import image_metrics
from blitzgs.runs.folder import Model, subject_of
from blitzgs.table.table import PARAMETERS
from blitzgs.view.views import CameraLike, viewmat
from blitzgs.view.visible import Subject

# Contributions are measured, and pictures drawn, at most so wide.
_WIDTH = 800
_PICTURES = 3
_LABELS = ("before", "after", "what goes")


def contributions(
    subject: Subject, cameras: Sequence[CameraLike], ranks: Ranks, rule: ScoreRule = "weight"
) -> Importance:
    """Measure what each Gaussian contributes to views of these cameras, in small pictures."""
    batches = []
    for column, camera in enumerate(map(_small, cameras)):
        viewmats, Ks = (  # noqa: N806
            torch.from_numpy(matrix).float()[None].to(ranks.device)
            for matrix in (viewmat(camera, subject.space), camera.K)
        )
        batches.append(ViewBatch([column], Views(viewmats, Ks, camera.width, camera.height)))
    return sweep(subject.gaussians, batches, len(batches), subject.options, ranks, rule=rule, lod=subject.lod)


@dataclass(frozen=True)
class Cleaned:
    """What cleaning leaves."""

    kept: Tensor  # bool [N]
    picture: bytes | None  # of what goes, as JPEG; None: nothing goes
    # Mean PSNR of the held-out views before and after; None: there are no photographs.
    psnr: tuple[float, float] | None


def cleaned(
    model: Model,
    cameras: RunCameras,
    most_views: int,
    ranks: Ranks,
    photograph: Callable[[int], npt.NDArray[np.uint8]] | None,
) -> Cleaned:
    """Find the Gaussians of a run that at most so many training views count, far from the rest or large.

    `photograph` returns the photograph of a camera; None: there are none.
    """
    views = [cameras.cameras[index] for index in cameras.train]
    cull = contributions(subject_of(model), views, ranks).cull
    removed = floaters(model.means, model.scales, views_counting(cull, len(views)), most_views)
    kept, picture = ~removed, None
    if bool(removed.any()):
        rest, gone = _rows(model, kept), _rows(model, removed)
        seen = [int((removed & ~is_culled(cull, column)).sum()) for column in range(len(views))]
        worst = sorted(range(len(views)), key=lambda column: -seen[column])[:_PICTURES]
        rows = [
            strip([some.render(_small(views[column])) for some in (model, rest, gone)], _LABELS)
            for column in worst
        ]
        width = min(row.shape[1] for row in rows)
        picture = encode_image(torch.cat([row[:, :width] for row in rows]), ".jpg")
    psnr = None
    if photograph is not None and cameras.test:
        before = _psnr(model, cameras, photograph)
        psnr = (before, before if picture is None else _psnr(_rows(model, kept), cameras, photograph))
    return Cleaned(kept.cpu(), picture, psnr)


def _rows(model: Model, rows: Tensor) -> Model:
    columns = {name: getattr(model, name)[rows] for name in (*PARAMETERS, "level")}
    return dataclasses.replace(model, **columns)


def _psnr(model: Model, cameras: RunCameras, photograph: Callable[[int], npt.NDArray[np.uint8]]) -> float:
    views = ((model.render(cameras.cameras[i]).cpu(), torch.from_numpy(photograph(i))) for i in cameras.test)
    return fmean(image_metrics(render, target, None)["psnr"] for render, target in views)


def _small(camera: CameraLike) -> RunCamera:
    """Return a camera whose picture is at most `_WIDTH` wide."""
    old = (camera.width, camera.height)
    new = downscaled_size(*old, max(1.0, camera.width / _WIDTH))
    return RunCamera(camera.name, *new, scaled_matrix(camera.K, old, new), camera.world_to_camera)


# A Gaussian is large if so few of the well-seen ones are larger.
_LARGE = 0.99
# A Gaussian is far from the well-seen ones at this multiple of their distances to each other, of which so
# few are larger. The distance is that to three neighbours.
_FAR, _SPACING, _NEIGHBOURS = 4.0, 0.95, 3


def views_counting(cull: Tensor, n_views: int) -> Tensor:
    """Return in how many views each Gaussian counts, int32 [N], from the matrix of `Importance.cull`."""
    counted = torch.zeros(len(cull), dtype=torch.int32, device=cull.device)
    for column in range(n_views):
        counted += 1 - (cull[:, column // WORD_BITS] >> (column % WORD_BITS) & 1)
    return counted


def floaters(means: Tensor, scales: Tensor, counted: Tensor, most_views: int) -> Tensor:
    """Tell which Gaussians to remove, bool [N]: few views count them, and they are far or large.

    Small ones among Gaussians that more than `most_views` count stay: they are details. Means and logarithms
    of scales are float32 [N, 3], in the same unit; `counted`: how many training views count each, int [N].
    """
    weak = counted <= most_views
    sound = ~weak
    if int(sound.sum()) <= _NEIGHBOURS or not bool(weak.any()):
        return torch.zeros_like(weak)
    sizes = scales.amax(dim=1)
    remove = weak & (sizes > _share(sizes[sound], _LARGE))
    remove[weak] |= _far(means[weak], means[sound])
    return remove


def _far(points: Tensor, others: Tensor) -> Tensor:
    """Tell which points have none of the others in their voxel or beside it, bool [P]."""
    spacing = knn_distances(others, _NEIGHBOURS).mean(dim=1)
    low, high = others.amin(dim=0), others.amax(dim=0)
    # The grid has to hold all others; points outside are clamped into its free margin.
    cell = max(_FAR * _share(spacing, _SPACING), float((high - low).max()) / (1 << (CELL_BITS - 1)), 1e-12)
    origin = (low - 3 * cell).tolist()
    taken = voxel_keys(others, origin, cell).unique()
    keys = voxel_keys(points, origin, cell)
    near = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for x, y, z in product((-1, 0, 1), repeat=3):
        near |= torch.isin(keys + x + (y << CELL_BITS) + (z << 2 * CELL_BITS), taken)
    return ~near


def _share(values: Tensor, share: float) -> float:
    """Return the value that this share of all does not exceed."""
    return float(values.kthvalue(max(1, int(share * len(values)))).values)
