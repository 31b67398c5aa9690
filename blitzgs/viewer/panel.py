# SPDX-License-Identifier: Apache-2.0
"""The controls of the page for one visitor, and the figures over the picture."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
import torch

from blitzgs.capture.pictures import encode_image
from blitzgs.capture.world import GEOCENTRIC
from blitzgs.view.draw import LEVEL_COLOURS
from blitzgs.view.look import MODES
from blitzgs.viewer import compare
from blitzgs.viewer.frustums import Frustums
from blitzgs.viewer.paths import Route
from blitzgs.viewer.settings import Triple
from blitzgs.viewer.visitor import Shown, Visitor
from blitzgs.viewer.world import SCALE

MOTIONS = {
    "orbit": "**Orbit**: drag turns around a point, right drag moves it, the wheel nears it.",
    "fly": "**Fly**: drag turns your head.",
    "walk": "**Walk**: drag turns your head, at eye height above the ground.",
}
KEYS = "Keys: W A S D move level, Q down, E up, arrows turn."


class Panel:
    """The controls of a visitor, which change the visitor's settings as they are used."""

    def __init__(self, visitor: Visitor, frustums: Frustums) -> None:
        """Add all controls."""
        self._visitor, self._frustums, self._exhibit = visitor, frustums, visitor.exhibit
        gui: Any = visitor.client.gui
        self._gui = gui
        visitor.figures = gui.add_html("")
        with gui.add_folder("Show"):
            self._show()
        if self._exhibit.cameras:
            with gui.add_folder("Photographs"):
                self._photographs()
        with gui.add_folder("Move"):
            self._move()
        with gui.add_folder("Model", expand_by_default=False):
            self._model()
        with gui.add_folder("Crop box", expand_by_default=False):
            self._crop()
        with gui.add_folder("Viewpoints and path", expand_by_default=False):
            Route(visitor, gui)

    def _bind(self, control: Any, choice: str, convert: Callable[[Any], Any] = lambda value: value) -> None:
        """Change a field of the visitor's settings whenever a control is used."""
        control.on_update(lambda _: self._visitor.change(**{choice: convert(control.value)}))

    def _show(self) -> None:
        gui = self._gui
        modes = [mode for mode in MODES if mode != "level" or self._exhibit.levels]
        self._bind(gui.add_dropdown("Mode", modes, initial_value="RGB"), "mode")
        sides = gui.add_slider("Longest side", min=320, max=3840, step=160, initial_value=1920)
        self._bind(sides, "most_side", int)
        self._bind(gui.add_checkbox("Coarse while moving", True), "adapts")
        gui.add_button("Screenshot").on_click(lambda _: self._screenshot())

    def _photographs(self) -> None:
        visitor, gui, exhibit = self._visitor, self._gui, self._exhibit
        shown = gui.add_checkbox("Show cameras", True, hint="Blue: trained on. Orange: held out.")
        shown.on_update(lambda _: self._frustums.show(shown.value))
        if (few := len(self._frustums.indices)) < len(exhibit.cameras):
            gui.add_markdown(f"{few} of {len(exhibit.cameras):,} are shown; *Camera* below reaches all.")
        size = gui.add_slider("Camera size", min=0.1, max=4.0, step=0.1, initial_value=1.0)
        size.on_update(lambda _: self._frustums.resize(size.value))
        number = gui.add_slider(
            "Camera", min=0, max=max(1, len(exhibit.cameras) - 1), step=1, initial_value=0
        )
        name = gui.add_markdown("")
        choice = gui.add_dropdown(
            "Compare", compare.KINDS, initial_value="off", disabled=exhibit.photograph is None,
            hint="With the photograph, where you stand at its camera",
        )  # fmt: skip
        exposure = gui.add_checkbox(
            "Exposure", False, disabled=not exhibit.exposures,
            hint="Where a photograph was trained on, show the render with its exposure",
        )  # fmt: skip
        self._bind(exposure, "exposure")
        wipe = gui.add_slider("Wipe", min=0.0, max=1.0, step=0.01, initial_value=0.5, disabled=True)

        def stand(_: Any) -> None:
            if number.value < len(exhibit.cameras):
                visitor.stand_at(int(number.value))

        def tell() -> None:
            at = visitor.standing
            name.content = (
                f"Standing at **{exhibit.cameras[at].name}**" if at is not None else "*At no camera*"
            )

        def chosen(_: Any) -> None:
            visitor.change(comparison=choice.value)
            wipe.disabled = choice.value != "wipe"
            if choice.value != "off" and visitor.standing is None:
                stand(None)

        gui.add_button("Stand there").on_click(stand)
        choice.on_update(chosen)
        self._bind(wipe, "wipe", float)
        visitor.listeners.append(tell)
        tell()

    def _move(self) -> None:
        visitor, gui, world = self._visitor, self._gui, self._visitor.world
        start = world.start()
        motion = gui.add_button_group("Motion", tuple(MOTIONS))
        fov = gui.add_slider(
            "Field of view", min=10, max=110, step=1, initial_value=50, hint="Vertical, degrees"
        )

        def turn(_: Any) -> None:
            visitor.client.camera.fov = float(np.radians(fov.value))

        fov.on_update(turn)
        gui.add_button("Level the horizon").on_click(lambda _: visitor.go(visitor.stance))
        gui.add_button("Back to the start").on_click(lambda _: visitor.go(start, world.distance(start)))
        help_text = gui.add_markdown("")

        def moves(_: Any) -> None:
            visitor.choose_motion(motion.value)
            tell()

        def tell() -> None:  # the buttons do not show which is chosen
            click = " Click a frustum to stand there." if self._exhibit.cameras else ""
            help_text.content = f"{MOTIONS[visitor.motion]} {KEYS}{click}"

        motion.on_click(moves)
        tell()

    def _model(self) -> None:
        gui, exhibit = self._gui, self._exhibit
        self._bind(gui.add_checkbox("LOD gate", exhibit.lod, disabled=not exhibit.lod), "lod")
        self._bind(gui.add_checkbox("Smooth levels", exhibit.smooth, disabled=not exhibit.lod), "smooth")
        degree = gui.add_slider("SH degree", min=0, max=max(1, exhibit.sh_degree), step=1,
                                initial_value=exhibit.sh_degree, disabled=exhibit.sh_degree == 0)  # fmt: skip
        self._bind(degree, "sh_degree", int)
        colour = tuple(round(255 * value) for value in exhibit.background)
        background = gui.add_rgb("Background", initial_value=colour)
        self._bind(background, "background", lambda channels: tuple(value / 255 for value in channels))
        unit = exhibit.space.unit
        for name, share in (("Near", 0.01), ("Far", 0.1)):
            step = share * unit * exhibit.space.extent
            plane = gui.add_number(name, 0.0, min=0.0, step=step, hint="0: the model's")
            self._bind(plane, name.lower(), lambda value: value / unit or None)

    def _crop(self) -> None:
        visitor, gui, exhibit = self._visitor, self._gui, self._exhibit
        offset, unit = np.array(exhibit.space.offset), exhibit.space.unit
        least, most = exhibit.box * unit + offset
        crops = gui.add_checkbox("Crop", False)
        sliders = [
            gui.add_multi_slider(
                axis, min=float(least[k]), max=float(most[k]), step=float((most[k] - least[k]) / 200) or 1.0,
                initial_value=(float(least[k]), float(most[k])),
            )
            for k, axis in enumerate("xyz")
        ]  # fmt: skip
        outline = visitor.client.scene.add_box(
            "/crop", color=(255, 220, 80), dimensions=(1.0, 1.0, 1.0), wireframe=True, visible=False
        )

        def update(_: Any) -> None:
            ends = np.array([slider.value for slider in sliders], dtype=np.float64)
            corners = ((ends.T - offset) / unit).tolist()
            box: tuple[Triple, Triple] = (tuple(corners[0]), tuple(corners[1]))
            low, high = SCALE * np.array(box)
            outline.dimensions = tuple(high - low)
            outline.position = (low + high) / 2
            outline.visible = crops.value
            visitor.change(crop=box if crops.value else None)

        for control in (crops, *sliders):
            control.on_update(update)

    def _screenshot(self) -> None:
        visitor = self._visitor
        shown = visitor.shown
        if shown is None:
            return
        content = encode_image(torch.from_numpy(shown.shaded.image), ".png")
        visitor.save(f"{self._exhibit.title}_{time.strftime('%Y%m%d_%H%M%S')}", ".png", content)


_BOX = (
    "position:fixed;left:14px;bottom:14px;z-index:5;pointer-events:none;color:#fff;"
    "font:12px/1.5 ui-monospace,monospace;text-shadow:0 0 3px #000,0 0 3px #000;"
    "background:rgba(0,0,0,.45);border-radius:6px;padding:8px 12px"
)
# On a narrow page, viser's panel is at the bottom and covers the lower 60 % of the model; a tap folds it.
_NARROW = (
    "@media(max-width:600px){#blitzgs-figures{inset:14px 14px auto!important;font-size:11px!important}"
    "[style*='max-height: 60%']{max-height:36%!important}}"
)
_TURBO = "linear-gradient(90deg,#7a0403,#d23105,#fb8022,#e1dd37,#61fc6c,#1ae4b6,#4490fe,#30123b)"
_INFERNO = "linear-gradient(90deg,#000004,#420a68,#932667,#dd513a,#fca50a,#fcffa4)"
_GREY = "linear-gradient(90deg,#000,#fff)"


def overlay(visitor: Visitor, shown: Shown, memory: str) -> str:
    """Return the figures of a picture as HTML."""
    ask, picture, shaded = shown.ask, shown.picture, shown.shaded
    look = ask.look
    place = visitor.world.capture_position(visitor.stance.position)
    lines = [
        f"{picture.gaussians:,} Gaussians in view &middot; {picture.milliseconds:.1f} ms &middot; "
        f"{look.width}&times;{look.height}" + (f" &middot; {memory}" if memory else ""),
        "x {:.2f} &nbsp;y {:.2f} &nbsp;z {:.2f}".format(*place),
        *((escape(frame.label(place)),) if (frame := visitor.exhibit.frame) is not None else ()),
    ]
    if ask.camera is not None and shaded.psnr is not None:
        name = visitor.exhibit.cameras[ask.camera].name
        part = "held out" if ask.camera in set(visitor.exhibit.test) else "trained on"
        lines.append(f"{escape(name)} ({part}) &middot; <b>{shaded.psnr:.2f} dB</b>")
    if shaded.low is not None and shaded.high is not None:
        colours = {"depth": _TURBO, "count": _INFERNO}.get(look.mode, _GREY)
        lines.append(
            f"{look.mode} {shaded.low:.3g} <span style='display:inline-block;width:120px;height:9px;"
            f"background:{colours}'></span> {shaded.high:.3g}"
        )
    if look.mode == "level":
        boxes = "".join(_level(k, colour) for k, colour in enumerate(LEVEL_COLOURS))
        lines.append(f"level {boxes} (coarse to fine)")
    box = f"<style>{_NARROW}</style><div id='blitzgs-figures' style='{_BOX}'>"
    return f"{box}{scale_bar(visitor)}{'<br>'.join(lines)}</div>"


def _level(level: int, colour: tuple[float, float, float]) -> str:
    channels = ",".join(f"{255 * value:.0f}" for value in colour)
    return f"<span style='background:rgb({channels});padding:0 4px'>{level}</span>"


def scale_bar(visitor: Visitor) -> str:
    """Return a bar of a round length at the distance of the point around which the camera orbits, as HTML."""
    camera = visitor.client.camera
    distance = float(np.linalg.norm(np.array(camera.look_at) - np.array(camera.position)))
    if visitor.motion != "orbit":
        distance = visitor.world.distance(visitor.stance)
    # Height of the view at this distance in the capture's unit, or in metres if these are known. The picture
    # is as high as the page; beside the panel it is less wide.
    frame, unit = visitor.exhibit.frame, visitor.exhibit.space.unit
    in_metres = frame is not None and frame.crs == GEOCENTRIC
    if frame is not None and in_metres:
        unit *= frame.scale
    height = 2 * distance * math.tan(visitor.stance.fov / 2) / SCALE * unit
    if not (math.isfinite(height) and height > 0):
        return ""
    length = round_length(height * camera.aspect / 8)
    name = "m" if in_metres else "unit" if length == 1 else "units"
    return (
        f"<div style='width:{100 * length / height:.2f}vh;border:2px solid #fff;border-top:0;height:5px;"
        f"margin:2px 0'></div><div>{length:g} {name} at the orbit's centre</div>"
    )


def round_length(length: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, ... (or 0.5, 0.2, ...) that is no longer than a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= length * (1 + 1e-9))
