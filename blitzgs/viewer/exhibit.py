# SPDX-License-Identifier: Apache-2.0
"""What the page has to know about a model, besides how to draw it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.world import WorldFrame
from blitzgs.view.views import CameraLike, Space


@dataclass(frozen=True)
class Exhibit:
    """A model or a training to show.

    Attributes:
        title: shown on the page.
        space: maps the trained world to the capture's.
        sh_degree: highest spherical-harmonics degree.
        near: near plane, trained units.
        far: far plane, trained units.
        background: RGB in [0, 1].
        levels: whether the Gaussians have octree levels.
        lod: whether the model has an LOD gate.
        smooth: whether its levels fade.
        box: corners of a box that holds nearly all Gaussians, float64 [2, 3], trained units.
        cameras: the capture's cameras.
        test: indices of those that are held out.
        photograph: returns the photograph of a camera, uint8 [H, W, 3]; None: there are none.
        exposures: gain and bias of photographs by their cameras, float64 [2, 3]; empty: the model has none.
        paths: folder for camera paths and screenshots.
        frame: where the capture lies in the world; None: unknown.
    """

    title: str
    space: Space
    sh_degree: int
    near: float
    far: float
    background: tuple[float, float, float]
    levels: bool
    lod: bool
    smooth: bool
    box: npt.NDArray[np.float64]
    cameras: Sequence[CameraLike] = ()
    test: Sequence[int] = ()
    photograph: Callable[[int], npt.NDArray[np.uint8]] | None = None
    exposures: dict[int, npt.NDArray[np.float64]] = field(default_factory=dict)
    paths: Path = field(default_factory=lambda: Path("paths"))
    frame: WorldFrame | None = None
