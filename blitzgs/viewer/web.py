# SPDX-License-Identifier: Apache-2.0
"""Models for web pages: one small HTML file of a model, and what the tiles of a city need."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from torch import Tensor

from blitzgs.capture.world import GEOCENTRIC, WorldFrame, converted
from blitzgs.config.files import changed
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import Gaussians, GaussianSource, up_of
from blitzgs.formats.models import offset_of, open_gaussians, system_of, with_degree
from blitzgs.formats.selection import opacity_length
from blitzgs.formats.tiles import upright
from blitzgs.formats.web_page import WebLevels, WebScene, estimated_bytes, frame_bytes, web_page
from blitzgs.frame.render import RenderOptions
from blitzgs.runs import run_files
from blitzgs.runs.cameras import stored_cameras
from blitzgs.runs.clean import contributions as measured
from blitzgs.runs.source import open_source
from blitzgs.runs.world import config_of_file, load_world_frame
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.errors import located
from blitzgs.view.gate import ModelGate
from blitzgs.view.views import CameraLike, Space, render_options
from blitzgs.view.visible import Subject, table_of
from blitzgs.viewer.studio import Opened, box_of
from blitzgs.viewer.world import SCALE, World

# A fainter Gaussian touches no pixel (docs/image.md, step 3).
_FAINTEST = 1 / 255
# Contributions are measured in so many of the capture's views.
_VIEWS = 32


@dataclass(frozen=True)
class WebFile:
    """A page, and what it has of the model."""

    text: str  # the HTML
    gaussians: int  # number of Gaussians in it
    of: int  # number of Gaussians of the model
    left_out: str  # what is missing, in words; empty: nothing that can be seen


def web_file(opened: Opened, max_bytes: int) -> WebFile:
    """Make a page that is at most so large.

    If not everything fits, the SH degree is reduced first, which costs less than to leave out as many bytes
    of Gaussians. Then the Gaussians that contribute least to views of the capture are left out; without
    cameras, those of the least opacity times length.

    `opened`: the model. `max_bytes`: size of the file. ValueError: the model has no visible Gaussian, or none
    fits.
    """
    table, exhibit, options, lod = opened.table, opened.exhibit, opened.subject.options, opened.subject.lod
    space, rows = max_bytes - frame_bytes(), _seen(table)
    if len(rows) == 0:
        raise ValueError(f"{exhibit.title} has no Gaussian that can be seen")
    degree, visible = options.sh_degree, len(rows)
    splats = _splats(table, rows, degree, lod is not None)
    while degree > 0 and estimated_bytes(splats) > space:
        degree -= 1
        splats = with_degree(splats, degree)
    world = World(exhibit.space, exhibit.cameras, exhibit.box, exhibit.up)
    scene = web_scene(world, options, 1.0, None if lod is None else _levels(lod))
    kept = min(visible, int(0.99 * visible * space / estimated_bytes(splats)))
    if kept < visible:
        score = contributions(opened.subject, exhibit.cameras, opened.ranks)
        rows = rows[score[rows].argsort(descending=True, stable=True)]
    while True:
        if kept < 1:
            raise ValueError(f"a file of {max_bytes / 1e6:g} MB holds no Gaussian: choose a larger --max-mb")
        parts = []
        if kept < visible:
            splats = _splats(table, rows[:kept], degree, lod is not None)
            left, whole = visible - kept + opened.unread, visible + opened.unread
            parts.append(f"{left:,} of {whole:,} Gaussians, those that contribute least")
        if degree < exhibit.sh_degree:
            parts.append(f"colours by direction beyond SH degree {degree} of {exhibit.sh_degree}")
        left_out = f"Left out to stay below {max_bytes / 1e6:g} MB: {'; '.join(parts)}." if parts else ""
        text = web_page(splats, scene, exhibit.title, left_out)
        if len(text.encode()) <= max_bytes:
            return WebFile(text, kept, len(table) + opened.unread, left_out)
        kept = int(0.98 * kept)


def _seen(table: GaussianTable) -> Tensor:
    """Return the rows of the Gaussians that some view can show."""
    seen = table["opacities"].sigmoid() >= _FAINTEST
    for name in PARAMETERS:
        seen &= table[name].reshape(len(seen), -1).isfinite().all(dim=1)
    return seen.nonzero()[:, 0]


def contributions(subject: Subject, cameras: Sequence[CameraLike], ranks: Ranks) -> Tensor:
    """Return how much each Gaussian contributes to views of the capture.

    Without a quarter of the Gaussians of the demo, its views are at 39.6 dB of the whole model's by this
    order, at 35.6 dB by opacity times length, and at 30.9 dB by opacity times area.
    """
    if not cameras:
        table = table_of(subject.gaussians)
        return opacity_length(table["opacities"], table["scales"])
    chosen = np.unique(np.linspace(0, len(cameras) - 1, _VIEWS).round().astype(int))
    return measured(subject, [cameras[index] for index in chosen], ranks).score


def _splats(table: GaussianTable, rows: Tensor, degree: int, levels: bool) -> Gaussians:
    rows = rows[morton_order(table["means"][rows])]
    names = ["means", "quats", "scales", "opacities", "sh", *(["level"] if levels else [])]
    means, quats, scales, opacities, sh, *level = (table[name][rows].cpu() for name in names)
    found = Gaussians(means, quats, scales, opacities, sh, levels=level[0] if level else None)
    return with_degree(found, degree)


def web_scene(world: World, options: RenderOptions, unit: float, lod: WebLevels | None = None) -> WebScene:
    """Return how a page shows a scene, with so many units of the page's Gaussians to a trained one."""
    start = world.start()

    def point(values: np.ndarray) -> tuple[float, float, float]:
        x, y, z = values.tolist()
        return x, y, z

    return WebScene(
        near=options.near_plane * unit,
        far=options.far_plane * unit,
        blur=options.eps2d,
        antialiased=options.antialiased,
        background=options.background,
        up=point(world.up),
        eye=point(start.position * (unit / SCALE)),
        target=point(world.middle * (unit / SCALE)),
        fov=start.fov,
        lod=lod,
    )


def _levels(lod: ModelGate) -> WebLevels:
    fade = lod.gate.fade()
    return WebLevels(
        reach=[None if math.isinf(reach) else reach for reach in lod.gate.reach()],
        slope=fade[0] if fade else 0.0,
        most=None if math.isinf(lod.most_kept) else lod.most_kept,
        least=lod.least_kept,
    )


Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class City:
    """A model that need not fit into memory, with what its tiles say besides its Gaussians."""

    source: GaussianSource  # the Gaussians, in the capture's unit around `offset`
    offset: Array  # origin of the source in the capture's coordinates, [3]
    extent: float  # the capture's size, in its unit
    frame: WorldFrame | None  # where the capture lies in the world; None: nobody says
    scene: WebScene  # how the page shows the model, in the coordinates of the source
    title: str  # name of the run or the file

    def transform(self) -> Array:
        """Return the map [4, 4] from the source's coordinates to EPSG:4978, or to an upright local frame.

        ImportError: pyproj is missing. ValueError: pyproj does not know the reference system.
        """
        if self.frame is None or not self.frame.crs:
            return upright(self.scene.up)
        return to_globe(self.frame, self.offset)


def open_city(path: Path, checked: bool = True) -> City:
    """Open a run, a checkpoint in it or a file, without reading a run's or a PLY's Gaussians into memory.

    Files and `checked` are as for `blitzgs.formats.models.open_gaussians`. FileNotFoundError: there is no
    such file, or no run or checkpoint in the folder. ValueError: the file is damaged or no model, or holds no
    Gaussians.
    """
    cameras: Sequence[CameraLike] = ()
    run, frame = None, None
    if path.is_file():
        source: GaussianSource = open_gaussians(path, checked)
        offset = np.array(offset_of(source.comments))
        if crs := system_of(path, source):
            frame = WorldFrame(crs, source=path.name)
    else:
        folder, checkpoint = run_files.run_and_checkpoint(path)
        run = open_source(folder, checkpoint)
        source, offset = run, np.array(run.space.offset)
        cameras = stored_cameras(folder).cameras
        frame = load_world_frame(folder)
    first = next(iter(source.blocks()), None)
    if first is None or len(first) == 0:
        raise ValueError(f"{path} holds no Gaussians")
    box = box_of(first.means[first.sound()])
    if run is None:
        extent = float(np.linalg.norm(box[1] - box[0])) / 2
        space = Space.of(offset, extent)
        config = changed(config_of_file(source), "model", near=1e-3)
    else:
        space, config = run.space, run.config
    world = World(space, cameras, box / space.unit, up_of(source.comments))
    scene = web_scene(world, render_options(config, space, source.degree), space.unit)
    return City(source, offset, space.extent * space.unit, frame, scene, path.resolve().stem)


def to_globe(frame: WorldFrame, origin: Array) -> Array:
    """Return the affine map [4, 4] from capture coordinates around `origin` to EPSG:4978.

    It is the map of the reference system at the origin to first order, so it has the convergence and the
    scale of a map projection there; at a distance of 2 km, the earth's curvature departs from it by 0.3 m.
    Heights are taken as above the ellipsoid, unless the reference system says otherwise.

    `frame`: of the capture; it has a reference system. `origin`: [3], capture coordinates. ImportError:
    pyproj is missing. ValueError: pyproj does not know the reference system, or the place is outside of it.
    """
    # Central differences over this length, in the unit of the capture.
    step = 10.0
    places = origin + step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    with located(frame.source):
        globe = converted(frame.to_world(places), frame.crs, GEOCENTRIC)
    matrix = np.eye(4)
    matrix[:3, :3] = (globe[1:4] - globe[4:]).T / (2 * step)
    matrix[:3, 3] = globe[0]
    return matrix
