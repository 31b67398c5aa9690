# SPDX-License-Identifier: Apache-2.0
"""The curves of a training on its page: loss, PSNR and population over the images seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

# A curve is drawn with this many points at most.
_MAX_POINTS = 300
_SERIES = {
    "loss": ("Loss", "#4dabf7"),
    "psnr": ("PSNR, dB", "#69db7c"),
    "gaussians": ("Gaussians", "#ffa94d"),
}


class Curves:
    """The numbers of a run's log that are drawn.

    Attributes:
        version: grows with every record.
    """

    def __init__(self) -> None:
        self.version = 0
        self._points: dict[str, list[tuple[int, float]]] = {name: [] for name in _SERIES}
        self._held_out: list[tuple[int, float]] = []
        self._last: dict[str, Any] = {}

    def add(self, t: int, values: Mapping[str, Any]) -> None:
        """Take a record at time `t` (images): of a step, or of an evaluation of the held-out views."""
        kind = values.get("event")
        if kind is None:
            for name, points in self._points.items():
                if isinstance(value := values.get(name), (int, float)):
                    points.append((t, float(value)))
            self._last = {"t": t, **values}
        elif kind == "evaluation" and isinstance(psnr := values.get("psnr"), (int, float)):
            self._held_out.append((t, float(psnr)))
        else:
            return
        self.version += 1

    def status(self, total: int) -> str:
        """Return the newest figures as text in Markdown."""
        last = self._last
        if not last:
            return "*no figures yet*"
        parts = [f"**{last['t']:,}** of {total:,} images"]
        if "loss" in last:
            parts.append(f"loss {last['loss']:.4f}")
        if "psnr" in last:
            parts.append(f"{last['psnr']:.2f} dB")
        if "images_per_second" in last:
            parts.append(f"{last['images_per_second']:.1f} images/s")
        if self._held_out:
            parts.append(f"held out: {self._held_out[-1][1]:.2f} dB")
        return " &middot; ".join(parts)

    def add_to(self, gui: Any) -> dict[str, Any]:
        """Add the plots to a visitor's page; return them by name."""
        plots = {}
        for name, (label, colour) in _SERIES.items():
            plots[name] = gui.add_uplot(
                self._data(name),
                ({"label": "images"}, {"label": label, "stroke": colour, "width": 2}),
                title=label,
                scales={"x": {"time": False}},
                axes=(
                    {"stroke": "#bbb", "grid": {"stroke": "#444"}},
                    {"stroke": "#bbb", "grid": {"stroke": "#444"}, "size": 64},
                ),
                legend={"show": False},
                height=130,
            )
        return plots

    def update(self, plots: Mapping[str, Any]) -> None:
        """Draw the present curves into plots."""
        for name, plot in plots.items():
            plot.data = self._data(name)

    def _data(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        points = self._points[name]
        step = max(1, -(-len(points) // _MAX_POINTS))
        some = points[::-step][::-1] or [(0, 0.0)]
        times, values = zip(*some, strict=True)
        return np.array(times, dtype=np.float64), np.array(values, dtype=np.float64)
