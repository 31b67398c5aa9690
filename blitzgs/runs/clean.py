# SPDX-License-Identifier: Apache-2.0
"""Cleans a model of floaters and fringes, shows what goes, and measures views before and after."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import downscaled_size, scaled_matrix
from blitzgs.capture.pictures import encode_image, strip
from blitzgs.config.fields import ScoreRule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.population.cleaning import floaters, views_counting
from blitzgs.population.importance import Importance, ViewBatch, is_culled, sweep
from blitzgs.runs.cameras import RunCamera, RunCameras
from blitzgs.runs.evaluation import image_metrics
from blitzgs.runs.folder import Model
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.output import write_file
from blitzgs.view.draw import table_of_parameters
from blitzgs.view.gate import SceneGate
from blitzgs.view.views import CameraLike, Space, render_options, viewmat

# Contributions are measured, and pictures drawn, at most so wide.
_WIDTH = 800
_PICTURES = 3
_LABELS = ("before", "after", "what goes")


def contributions(
    table: GaussianTable,
    cameras: Sequence[CameraLike],
    space: Space,
    options: RenderOptions,
    ranks: Ranks,
    lod: SceneGate | None,
    rule: ScoreRule = "weight",
) -> Importance:
    """Measure what each Gaussian contributes to views of these cameras, in small pictures."""
    batches = []
    for column, camera in enumerate(map(_small, cameras)):
        viewmats, Ks = (  # noqa: N806
            torch.from_numpy(matrix).float()[None].to(table.device)
            for matrix in (viewmat(camera, space), camera.K)
        )
        batches.append(ViewBatch([column], Views(viewmats, Ks, camera.width, camera.height)))
    return sweep(table, batches, len(batches), options, ranks, rule=rule, lod=lod)


@dataclass(frozen=True)
class Cleaned:
    """What cleaning leaves."""

    kept: Tensor  # bool [N]
    picture: bytes | None  # of what goes, as JPEG; None: nothing goes
    # Mean PSNR of the held-out views before and after; None: there are no photographs.
    psnr: tuple[float, float] | None

    def write_picture(self, path: Path) -> None:
        """Write the picture, if there is one."""
        if self.picture is not None:
            write_file(path, self.picture)


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
    table = table_of_parameters({name: getattr(model, name) for name in (*PARAMETERS, "level")})
    gate = None if model.lod is None else model.lod.gate
    options = render_options(model.config, model.space, model.sh_degree, gate)
    views = [cameras.cameras[index] for index in cameras.train]
    cull = contributions(table, views, model.space, options, ranks, model.lod).cull
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
    """Return the mean PSNR of the held-out views."""
    found = []
    for index in cameras.test:
        target = torch.from_numpy(photograph(index))
        found.append(image_metrics(model.render(cameras.cameras[index]).cpu(), target, None)["psnr"])
    return sum(found) / len(found)


def _small(camera: CameraLike) -> RunCamera:
    """Return a camera whose picture is at most `_WIDTH` wide."""
    old = (camera.width, camera.height)
    new = downscaled_size(*old, max(1.0, camera.width / _WIDTH))
    return RunCamera(camera.name, *new, scaled_matrix(camera.K, old, new), camera.world_to_camera)
