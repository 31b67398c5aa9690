# SPDX-License-Identifier: Apache-2.0
"""What a visitor has chosen on the page, and the look that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from blitzgs.view.look import Look, Mode

Triple = tuple[float, float, float]


@dataclass
class Settings:
    """The choices of one visitor; lengths in trained units.

    Attributes:
        mode: see `Look.mode`.
        sh_degree: None: the model's.
        background: RGB in [0, 1].
        lod: apply the LOD gate.
        smooth: fade its levels.
        crops: leave out what is outside of the box.
        box: the box's corners.
        near: None: the model's.
        far: None: the model's.
        comparison: one of `blitzgs.viewer.compare.KINDS`.
        wipe: share of the width that shows the photograph.
        exposure: where a photograph was taken, show the render with its exposure, if the model has one.
        most_side: longest side in pixels of a picture at full quality.
        adapts: whether pictures are coarser while the camera moves.
    """

    mode: Mode = "RGB"
    sh_degree: int | None = None
    background: Triple | None = None
    lod: bool = True
    smooth: bool | None = None
    crops: bool = False
    box: tuple[Triple, Triple] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    near: float | None = None
    far: float | None = None
    comparison: str = "off"
    wipe: float = 0.5
    exposure: bool = False
    most_side: int = 1920
    adapts: bool = True

    def look(
        self, viewmat: npt.NDArray[np.float64], K: npt.NDArray[np.float64], width: int, height: int
    ) -> Look:
        """Return what to draw for a pose; comparisons with a photograph are in RGB.

        Raises:
            ValueError: a choice is impossible.
        """
        return Look(
            viewmat,
            K,
            width,
            height,
            mode="RGB" if self.comparison != "off" else self.mode,
            sh_degree=self.sh_degree,
            background=self.background,
            lod=self.lod,
            smooth=self.smooth,
            crop=self.box if self.crops else None,
            near=self.near,
            far=self.far,
        )
