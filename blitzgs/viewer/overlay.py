# SPDX-License-Identifier: Apache-2.0
"""The figures over the picture: Gaussians, time, memory, coordinates, a scale bar and a legend."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from blitzgs.capture.world import GEOCENTRIC
from blitzgs.view.draw import LEVEL_COLOURS
from blitzgs.viewer.visitor import Shown, Visitor
from blitzgs.viewer.world import SCALE

_BOX = (
    "position:fixed;left:14px;bottom:14px;z-index:5;pointer-events:none;color:#fff;"
    "font:12px/1.5 ui-monospace,monospace;text-shadow:0 0 3px #000,0 0 3px #000;"
    "background:rgba(0,0,0,.45);border-radius:6px;padding:8px 12px"
)
# On a narrow page, the panel is at the bottom.
_NARROW = "@media(max-width:600px){#blitzgs-figures{inset:14px 14px auto!important;font-size:11px!important}}"
_TURBO = "linear-gradient(90deg,#7a0403,#d23105,#fb8022,#e1dd37,#61fc6c,#1ae4b6,#4490fe,#30123b)"
_INFERNO = "linear-gradient(90deg,#000004,#420a68,#932667,#dd513a,#fca50a,#fcffa4)"
_GREY = "linear-gradient(90deg,#000,#fff)"


def overlay(visitor: Visitor, shown: Shown, memory: str) -> str:
    """Return the figures of a picture as HTML."""
    ask, picture = shown.ask, shown.picture
    look = ask.look
    place = visitor.world.capture_position(visitor.stance.position)
    lines = [
        f"{picture.gaussians:,} Gaussians in view &middot; {picture.milliseconds:.1f} ms &middot; "
        f"{look.width}&times;{look.height}" + (f" &middot; {memory}" if memory else ""),
        "x {:.2f} &nbsp;y {:.2f} &nbsp;z {:.2f}".format(*place),
        *((escape(frame.label(place)),) if (frame := visitor.exhibit.frame) is not None else ()),
    ]
    if ask.camera is not None and shown.psnr is not None:
        name = visitor.exhibit.cameras[ask.camera].name
        part = "held out" if ask.camera in set(visitor.exhibit.test) else "trained on"
        lines.append(f"{escape(name)} ({part}) &middot; <b>{shown.psnr:.2f} dB</b>")
    if shown.low is not None and shown.high is not None:
        colours = {"depth": _TURBO, "count": _INFERNO}.get(look.mode, _GREY)
        lines.append(
            f"{look.mode} {shown.low:.3g} <span style='display:inline-block;width:120px;height:9px;"
            f"background:{colours}'></span> {shown.high:.3g}"
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
        distance = float(np.linalg.norm(visitor.world.middle - visitor.stance.position))
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
