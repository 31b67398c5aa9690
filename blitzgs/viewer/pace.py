# SPDX-License-Identifier: Apache-2.0
"""Chooses how fine a picture is: coarse while the camera moves, and in steps up to full when it is still."""

from __future__ import annotations

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

        Args:
            drawn: scale of the picture that shows the present viewpoint and choices; None: there is none.
            moving: whether the camera moved just now.
        """
        coarse = self.coarse()
        if drawn is None:
            return coarse
        if moving or drawn >= 1.0:
            return None
        # One step in between, if full quality takes long.
        middle = 0.5 if drawn < 0.45 and self._full is not None and self._full > 10 * self._moving else 1.0
        return max(middle, coarse)
