# SPDX-License-Identifier: Apache-2.0
"""Makes one HTML file of a model, small enough to send."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from blitzgs.formats.selection import opacity_length
from blitzgs.formats.web_page import WebLevels, WebScene, WebSplats, estimated_bytes, frame_bytes, web_page
from blitzgs.frame.render import RenderOptions
from blitzgs.runs.clean import contributions as measured
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.gate import SceneGate
from blitzgs.viewer.studio import Opened
from blitzgs.viewer.world import SCALE, World

# A fainter Gaussian touches no pixel (docs/image.md, step 3).
_FAINTEST = 1 / 255
# Contributions are measured in so many of the capture's views.
_VIEWS = 32


@dataclass(frozen=True)
class WebFile:
    """A page, and what it has of the model.

    Attributes:
        text: the HTML.
        gaussians: number of Gaussians in it.
        of: number of Gaussians of the model.
        left_out: what is missing, in words; empty: nothing that can be seen.
    """

    text: str
    gaussians: int
    of: int
    left_out: str


def web_file(opened: Opened, max_bytes: int) -> WebFile:
    """Make a page that is at most so large.

    If not everything fits, the SH degree is reduced first, which costs less than to leave out as many bytes
    of Gaussians. Then the Gaussians that contribute least to views of the capture are left out; without
    cameras, those of the least opacity times length.

    Args:
        opened: the model.
        max_bytes: size of the file.

    Raises:
        ValueError: the model has no visible Gaussian, or none fits.
    """
    table, exhibit, full_degree = opened.table, opened.exhibit, opened.subject.options.sh_degree
    degree, space = full_degree, max_bytes - frame_bytes()
    rows = _seen(table)
    if len(rows) == 0:
        raise ValueError(f"{exhibit.title} has no Gaussian that can be seen")
    levels = opened.subject.lod is not None
    splats, visible = _splats(table, rows, degree, levels), len(rows)
    while degree > 0 and estimated_bytes(splats) > space:
        degree -= 1
        splats = splats.of_degree(degree)
    scene = _scene(opened)
    kept = min(visible, int(0.99 * visible * space / estimated_bytes(splats)))
    if kept < visible:
        rows = rows[contributions(opened)[rows].argsort(descending=True, stable=True)]
    while True:
        if kept < 1:
            raise ValueError(f"a file of {max_bytes / 1e6:g} MB holds no Gaussian: choose a larger --max-mb")
        if kept < visible:
            splats = _splats(table, rows[:kept], degree, levels)
        parts = []
        if kept < visible:
            parts.append(f"{visible - kept:,} of {visible:,} Gaussians, those that contribute least")
        if degree < full_degree:
            parts.append(f"colours by direction beyond SH degree {degree} of {full_degree}")
        left_out = f"Left out to stay below {max_bytes / 1e6:g} MB: {'; '.join(parts)}." if parts else ""
        text = web_page(splats, scene, exhibit.title, left_out)
        if len(text.encode()) <= max_bytes:
            return WebFile(text, kept, len(table), left_out)
        kept = int(0.98 * kept)


def _seen(table: GaussianTable) -> Tensor:
    """Return the rows of the Gaussians that some view can show."""
    seen = table["opacities"].sigmoid() >= _FAINTEST
    for name in PARAMETERS:
        seen &= table[name].reshape(len(seen), -1).isfinite().all(dim=1)
    return seen.nonzero()[:, 0]


def contributions(opened: Opened) -> Tensor:
    """Return how much each Gaussian contributes to views of the capture.

    Without a quarter of the Gaussians of the demo, its views are at 39.6 dB of the whole model's by this
    order, at 35.6 dB by opacity times length, and at 30.9 dB by opacity times area.
    """
    table, exhibit, subject = opened.table, opened.exhibit, opened.subject
    if not exhibit.cameras:
        return opacity_length(table["opacities"], table["scales"])
    chosen = np.unique(np.linspace(0, len(exhibit.cameras) - 1, _VIEWS).round().astype(int))
    cameras = [exhibit.cameras[index] for index in chosen]
    return measured(table, cameras, exhibit.space, subject.options, opened.ranks, subject.lod).score


def _splats(table: GaussianTable, rows: Tensor, degree: int, levels: bool) -> WebSplats:
    rows = rows[morton_order(table["means"][rows])]

    def column(name: str) -> np.ndarray:
        return table[name][rows].cpu().numpy()

    return WebSplats(
        means=column("means"),
        quats=column("quats"),
        scales=column("scales"),
        opacities=table["opacities"][rows].sigmoid().cpu().numpy(),
        sh=column("sh")[:, : (degree + 1) ** 2],
        levels=column("level") if levels else None,
    )


def _scene(opened: Opened) -> WebScene:
    exhibit, lod = opened.exhibit, opened.subject.lod
    world = World(exhibit.space, exhibit.cameras, exhibit.box.mean(axis=0))
    return web_scene(world, opened.subject.options, 1.0, None if lod is None else _levels(lod))


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


def _levels(lod: SceneGate) -> WebLevels:
    fade = lod.gate.fade()
    return WebLevels(
        reach=[None if math.isinf(reach) else reach for reach in lod.gate.reach()],
        slope=fade[0] if fade else 0.0,
        most=None if math.isinf(lod.most_kept) else lod.most_kept,
        least=lod.least_kept,
    )
