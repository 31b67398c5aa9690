# SPDX-License-Identifier: Apache-2.0
"""What a training knows of those who watch it: it draws what they ask for between two steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from blitzgs.view.look import Look, Picture


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

    def stay(self) -> None:
        """Learn that the training has ended, and go on with a pause that shows its model."""

    def close(self) -> None:
        """Learn that the training has ended."""
