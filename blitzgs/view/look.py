# SPDX-License-Identifier: Apache-2.0
"""What a viewer asks to see of a model at rest or in training, and the picture that answers it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np
import numpy.typing as npt

Mode = Literal["RGB", "depth", "alpha", "count", "level"]
MODES: tuple[Mode, ...] = get_args(Mode)
# Pictures have at most this many pixels on a side.
MAX_PIXELS = 8192


@dataclass(frozen=True, eq=False)
class Look:
    """One view of a model, with what to show of it; lengths in trained units."""

    viewmat: npt.NDArray[np.float64]  # trained world to camera, float64 [4, 4]
    K: npt.NDArray[np.float64]  # intrinsics in pixels, float64 [3, 3]
    width: int  # pixels
    height: int  # pixels
    # "RGB"; "depth", the expected depth in the capture's unit; "alpha", the opacity; "count", how many
    # entries of its tile's list a pixel goes through; "level", RGB with a colour for each octree level.
    mode: Mode = "RGB"
    sh_degree: int | None = None  # of spherical harmonics; None, or a higher one: the model's
    background: tuple[float, float, float] | None = None  # RGB in [0, 1]; None: the model's
    lod: bool = True  # apply the model's LOD gate, if it has one
    smooth: bool | None = None  # fade the levels of the gate; None: as the model was trained
    # Two opposite corners of a box; Gaussians with their centres outside are left out. None: none are.
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    near: float | None = None  # near plane; None: the model's
    far: float | None = None  # far plane; None: the model's

    def __post_init__(self) -> None:
        """Check the values, which come from a browser (ValueError: one is impossible, by name)."""
        if self.mode not in MODES:
            raise ValueError(f"mode must be one of {', '.join(MODES)}, got {self.mode!r}")
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= MAX_PIXELS:
                raise ValueError(f"{name} must be from 1 to {MAX_PIXELS}, got {size}")
        for name, matrix, shape in (("viewmat", self.viewmat, (4, 4)), ("K", self.K, (3, 3))):
            if matrix.shape != shape or not np.isfinite(matrix).all():
                raise ValueError(f"{name} must be a finite matrix {shape}, got {matrix.tolist()}")
        if min(self.K[0, 0], self.K[1, 1]) <= 0:
            raise ValueError(f"K must have positive focal lengths, got {self.K.tolist()}")
        near, far = self.near or 0.0, self.far or np.inf
        if not 0 <= near < far:
            raise ValueError(f"the near plane must be before the far plane, got {near} and {far}")


@dataclass(frozen=True, eq=False)
class Picture:
    """A rendered `Look`."""

    # uint8 [H, W, 3] for "RGB" and "level"; else float32 [H, W]: depth in the capture's unit (0 where nothing
    # is), opacity in [0, 1], or a number of entries.
    values: npt.NDArray[np.uint8] | npt.NDArray[np.float32]
    gaussians: int  # number of Gaussians that the view sees
    milliseconds: float  # time that rendering took, with the copy to the host


class Wish(NamedTuple):
    """What a watcher wants between two steps."""

    look: Look | None = None  # a picture to draw, or None
    pause: bool = False  # whether the training is to wait; it asks again at once
    save: bool = False  # whether the model is to be saved now


class Watcher(Protocol):
    """Watches a training, on rank 0. An error in any method ends the watching, never the training."""

    def wants(self) -> bool:
        """Tell whether it has a wish. Called after every step: it takes microseconds."""

    def wish(self) -> Wish:
        """Return the wish; an empty one lets the training go on."""

    def show(self, picture: Picture, seconds: float) -> None:
        """Take the picture of the last wish, which cost the training these seconds."""

    def failed(self, reason: str) -> None:
        """Learn that the picture of the last wish could not be drawn."""

    def told(self, t: int, values: Mapping[str, Any]) -> None:
        """Take a record of the run's log, at time `t` (images)."""

    def close(self) -> None:
        """Learn that the training has ended."""
