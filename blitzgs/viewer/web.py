# SPDX-License-Identifier: Apache-2.0
"""Makes one HTML file of a model, small enough to send."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from blitzgs.formats.web_page import WebLevels, WebScene, WebSplats, estimated_bytes, frame_bytes, web_page
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.gate import SceneGate
from blitzgs.viewer.studio import Opened
from blitzgs.viewer.world import SCALE, World

# A fainter Gaussian touches no pixel (docs/image.md, step 3).
_FAINTEST = 1 / 255
# The SH degree is not reduced below this one before Gaussians are left out.
_LEAST_DEGREE = 1


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

    If not everything fits, the SH degree is reduced first, down to 1; then the Gaussians with the least
    opacity times area of their largest face are left out.

    Args:
        opened: the model.
        max_bytes: size of the file.

    Raises:
        ValueError: the model has no visible Gaussian, or none fits.
    """
    table, exhibit, options = opened.table, opened.exhibit, opened.subject.options
    degree, space = options.sh_degree, max_bytes - frame_bytes()
    rows = _ranked(table)
    if len(rows) == 0:
        raise ValueError(f"{exhibit.title} has no Gaussian that can be seen")
    levels = opened.subject.lod is not None
    splats, visible = _splats(table, rows, degree, levels), len(rows)
    while degree > _LEAST_DEGREE and estimated_bytes(splats) > space:
        degree -= 1
        splats = splats.of_degree(degree)
    scene = _scene(opened)
    kept = min(visible, int(0.99 * visible * space / estimated_bytes(splats)))
    while True:
        if kept < 1:
            raise ValueError(f"a file of {max_bytes / 1e6:g} MB holds no Gaussian: choose a larger --max-mb")
        if kept < visible:
            splats = _splats(table, rows[:kept], degree, levels)
        left_out = _left_out(kept, visible, degree, options.sh_degree, max_bytes)
        text = web_page(splats, scene, exhibit.title, left_out)
        if len(text.encode()) <= max_bytes:
            break
        kept = int(0.98 * kept)
    return WebFile(text, kept, len(table), left_out)


def _left_out(kept: int, visible: int, degree: int, full_degree: int, max_bytes: int) -> str:
    parts = []
    if kept < visible:
        parts.append(f"{visible - kept:,} of {visible:,} Gaussians, those of least opacity times area")
    if degree < full_degree:
        parts.append(f"spherical harmonics above degree {degree} of {full_degree}")
    return f"Left out to stay below {max_bytes / 1e6:g} MB: {'; '.join(parts)}." if parts else ""


def _ranked(table: GaussianTable) -> Tensor:
    """Return the rows of the Gaussians that can be seen, those that contribute most first."""
    opacities = table["opacities"].sigmoid()
    seen = opacities >= _FAINTEST
    for name in PARAMETERS:
        seen &= table[name].reshape(len(seen), -1).isfinite().all(dim=1)
    largest = table["scales"].topk(2, dim=1).values.sum(dim=1)
    rank = (opacities.log() + largest).where(seen, -math.inf)
    return rank.argsort(descending=True, stable=True)[: int(seen.sum())]


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
    exhibit, options = opened.exhibit, opened.subject.options
    world = World(exhibit.space, exhibit.cameras, exhibit.box.mean(axis=0))
    start = world.start()

    def point(values: np.ndarray) -> tuple[float, float, float]:
        x, y, z = values.tolist()
        return x, y, z

    return WebScene(
        near=options.near_plane,
        far=options.far_plane,
        blur=options.eps2d,
        antialiased=options.antialiased,
        background=options.background,
        up=point(world.up),
        eye=point(start.position / SCALE),
        target=point(world.middle / SCALE),
        fov=start.fov,
        lod=None if opened.subject.lod is None else _levels(opened.subject.lod),
    )


def _levels(lod: SceneGate) -> WebLevels:
    fade = lod.gate.fade()
    return WebLevels(
        reach=[None if math.isinf(reach) else reach for reach in lod.gate.reach()],
        slope=fade[0] if fade else 0.0,
        most=None if math.isinf(lod.most_kept) else lod.most_kept,
        least=lod.least_kept,
    )
