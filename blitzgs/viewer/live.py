# SPDX-License-Identifier: Apache-2.0
"""The page during a training: pictures of the model as it is, curves, pause and save."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from blitzgs.view.look import Picture, Wish
from blitzgs.viewer.page import Page
from blitzgs.viewer.visitor import Ask
from blitzgs.viewer.world import Exhibit

# A curve is drawn with this many points at most.
_MAX_POINTS = 300
_SERIES = {
    "loss": ("Loss", "#4dabf7"),
    "psnr": ("PSNR, dB", "#69db7c"),
    "gaussians": ("Gaussians", "#ffa94d"),
}


class Curves:
    """The numbers of a run's log that are drawn."""

    def __init__(self, total: int) -> None:
        self.version = 0  # grows with every record
        self._total = total  # images of the whole run
        self._points: dict[str, list[tuple[int, float]]] = {name: [] for name in _SERIES}
        self._held_out: float | None = None  # PSNR of the held-out views
        self._last: dict[str, Any] = {}

    def add(self, t: int, values: Mapping[str, Any]) -> None:
        """Take a record at time `t` (images): of a step, of the held-out views, or of a change of pace."""
        kind = values.get("event")
        if kind is None:
            for name, points in self._points.items():
                if isinstance(value := values.get(name), (int, float)):
                    points.append((t, float(value)))
            self._last = {"t": t, **values}
        elif kind == "evaluation" and isinstance(psnr := values.get("psnr"), (int, float)):
            self._held_out = float(psnr)
        elif kind == "pace":  # --minutes
            self._total = values["images"]
        else:
            return
        self.version += 1

    def status(self) -> str:
        """Return the newest figures as text in Markdown."""
        last = self._last
        if not last:
            return "*no figures yet*"
        parts = [f"**{last['t']:,}** of {self._total:,} images"]
        if "loss" in last:
            parts.append(f"loss {last['loss']:.4f}")
        if "psnr" in last:
            parts.append(f"{last['psnr']:.2f} dB")
        if "images_per_second" in last:
            parts.append(f"{last['images_per_second']:.1f} images/s")
        if self._held_out is not None:
            parts.append(f"held out: {self._held_out:.2f} dB")
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


# Share of the training's time that pictures may take while somebody looks.
SHARE = 0.03
# Seconds after which a picture of a model that goes on training is drawn anew.
_REFRESH_SECONDS = 2.0
# A paused training goes on if nobody has had the page open for this many seconds.
ALONE_SECONDS = 60.0
# Seconds until the visitors are asked again if none of them waits for a picture.
_IDLE_SECONDS = 0.05
# Seconds between two updates of the curves.
_CURVES_SECONDS = 2.0
# Milliseconds of a picture while the camera moves.
MOVING_MS = 12.0


class Live:
    """Watches a training (`blitzgs.view.look.Watcher`), and shows it on a page."""

    def __init__(self, exhibit: Exhibit, total: int, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start the page; errors are those of `Page`.

        `total`: images of the whole run. `port`: 0: any free one.
        """
        self._share = SHARE
        self._curves = Curves(total)
        self._count = 0
        self._paused = self._saves = False
        self._allowed, self._refreshed, self._left_alone = 0.0, 0.0, 0.0
        self._next: Ask | None = None  # to be drawn
        self._last: Ask | None = None  # being drawn
        self._sent = 0.0
        self._folders: dict[int, Any] = {}
        self._ends = threading.Event()
        self.page = Page(
            exhibit, host, port, folders=self._add_folder, memory=self._memory, moving_ms=MOVING_MS
        )
        self._thread = threading.Thread(target=self._update_curves, daemon=True, name="viewer curves")
        self._thread.start()

    # -- called by the training ----------------------------------------------------------------------------

    def wants(self) -> bool:
        """Tell whether there is something to do between two steps."""
        if self._saves or self._paused:
            return True
        if self._next is None and self.page.visitors and time.monotonic() >= self._allowed:
            self._next = self._asked_for()
        return self._next is not None

    def _asked_for(self) -> Ask | None:
        """Return a picture that a visitor waits for, if there is one."""
        now = time.monotonic()
        if not self._paused and now >= self._refreshed + _REFRESH_SECONDS:
            self._refreshed = now
            for visitor in list(self.page.visitors.values()):
                visitor.is_stale = True
        found = self.page.next_ask()
        if found is None:
            self._allowed = now + _IDLE_SECONDS
        return found

    def wish(self) -> Wish:
        """Return what to do: the picture that `wants` has found and, in a pause, whatever is asked for."""
        now = time.monotonic()
        saves, self._saves = self._saves, False
        if self.page.visitors:
            self._left_alone = 0.0
        elif self._paused:
            self._left_alone = self._left_alone or now
            if now > self._left_alone + ALONE_SECONDS:
                self._paused = False
        self._last, self._next = self._next, None
        if self._last is None and self._paused and self.page.visitors:
            self._last = self._asked_for()
        return Wish(None if self._last is None else self._last.look, self._paused, saves)

    def show(self, picture: Picture, seconds: float) -> None:
        """Send a picture, and note what it cost."""
        if self._last is None:
            return
        # Packing and sending the pictures before this one took time of the same processor.
        sent, self._sent = self.page.send_seconds - self._sent, self.page.send_seconds
        begin = time.monotonic()
        self.page.deliver(self._last, picture)
        spent = seconds + sent + time.monotonic() - begin
        self._allowed = time.monotonic() + spent * (1 / self._share - 1)

    def failed(self, reason: str) -> None:
        """Tell the visitor that there is no picture."""
        if self._last is not None:
            self._last.visitor.failed(self._last, reason)
        self._allowed = time.monotonic() + 1.0

    def told(self, t: int, values: Mapping[str, Any]) -> None:
        """Take a record of the log."""
        self._curves.add(t, values)
        if isinstance(count := values.get("gaussians"), (int, float)):
            self._count = int(count)

    def close(self) -> None:
        """Close the page."""
        self._ends.set()
        self._thread.join(timeout=3)
        self.page.close()

    # -- the page ------------------------------------------------------------------------------------------

    def _memory(self) -> str:
        return f"{self._count:,} in all" if self._count else ""

    def _add_folder(self, client: Any) -> None:
        gui = client.gui
        with gui.add_folder("Training"):
            status = gui.add_markdown(self._curves.status())
            pause = gui.add_button("Pause")
            save = gui.add_button("Save now", hint="Write a checkpoint after this step")
            share = gui.add_slider(
                "% of the time", min=1, max=50, step=1, initial_value=round(100 * self._share),
                hint="Share of the training's time that pictures may take",
            )  # fmt: skip
            plots = self._curves.add_to(gui)

        def toggle(_: Any) -> None:
            self._paused = not self._paused
            self._tell_paused()

        def saved(_: Any) -> None:
            self._saves = True
            client.add_notification("BlitzGS", "the model is saved after this step", auto_close_seconds=4.0)

        def shared(_: Any) -> None:
            self._share, self._allowed = share.value / 100, 0.0

        pause.on_click(toggle)
        save.on_click(saved)
        share.on_update(shared)
        self._folders[client.client_id] = (status, pause, plots)
        self._tell_paused()

    def _tell_paused(self) -> None:
        for _, pause, _ in list(self._folders.values()):
            pause.label = "Go on" if self._paused else "Pause"

    def _update_curves(self) -> None:
        seen = -1
        while not self._ends.wait(_CURVES_SECONDS):
            for number in set(self._folders) - set(self.page.visitors):
                self._folders.pop(number, None)
            if not self._folders or self._curves.version == seen:
                continue
            seen = self._curves.version
            text = self._curves.status()
            for status, _, plots in list(self._folders.values()):
                status.content = text
                self._curves.update(plots)
