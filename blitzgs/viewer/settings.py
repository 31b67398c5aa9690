# SPDX-License-Identifier: Apache-2.0
"""What a visitor has chosen on the page, the look that follows, and how fine its pictures are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from blitzgs.view.look import Look, Mode

Triple = tuple[float, float, float]


@dataclass
class Settings:
    """The choices of one visitor; lengths in trained units."""

    mode: Mode = "RGB"  # see `Look.mode`
    sh_degree: int | None = None  # None: the model's
    background: Triple | None = None  # RGB in [0, 1]
    lod: bool = True  # apply the LOD gate
    smooth: bool | None = None  # fade its levels
    crop: tuple[Triple, Triple] | None = None  # corners of a box; what is outside is left out. None: nothing
    near: float | None = None  # None: the model's
    far: float | None = None  # None: the model's
    comparison: str = "off"  # one of `blitzgs.viewer.compare.KINDS`
    wipe: float = 0.5  # share of the width that shows the photograph
    # Where a photograph was taken, show the render with its exposure, if the model has one.
    exposure: bool = False
    most_side: int = 1920  # longest side in pixels of a picture at full quality
    adapts: bool = True  # whether pictures are coarser while the camera moves

    def look(
        self, viewmat: npt.NDArray[np.float64], K: npt.NDArray[np.float64], width: int, height: int
    ) -> Look:
        """Return what to draw for a pose; comparisons with a photograph are in RGB.

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
            crop=self.crop,
            near=self.near,
            far=self.far,
        )


# Sides of a picture relative to full quality.
SCALES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.125)
# Milliseconds that a picture may take while the camera moves.
MOVING_MS = 40.0
# Seconds without a movement after which the camera is still.
STILL_SECONDS = 0.2
# Time grows with the side to this power: between that of the Gaussians (0) and that of the pixels (2).
_POWER = 1.4


class Pace:
    """Predicts the time of pictures from the last one."""

    def __init__(self, moving_ms: float = MOVING_MS) -> None:
        """Begin without a prediction; `moving_ms` is the time of a picture while the camera moves."""
        self._moving = moving_ms
        self._full: float | None = None  # milliseconds of a picture at full quality

    def measured(self, scale: float, milliseconds: float) -> None:
        """Note the time of a picture."""
        full = milliseconds / scale**_POWER
        self._full = full if self._full is None else 0.5 * self._full + 0.5 * full

    def coarse(self) -> float:
        """Return the largest scale that is fast enough for movement."""
        if self._full is None:
            return SCALES[3]
        return next((scale for scale in SCALES if self._full * scale**_POWER <= self._moving), SCALES[-1])

    def next_scale(self, drawn: float | None, moving: bool) -> float | None:
        """Return the scale of the next picture; None: the one that is shown is good enough.

        `drawn`: scale of the picture that shows the present viewpoint and choices; None: there is none.
        `moving`: whether the camera moved just now.
        """
        coarse = self.coarse()
        if drawn is None:
            return coarse
        if moving or drawn >= 1.0:
            return None
        # One step in between, if full quality takes long.
        middle = 0.5 if drawn < 0.45 and self._full is not None and self._full > 10 * self._moving else 1.0
        return max(middle, coarse)
