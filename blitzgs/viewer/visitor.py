# SPDX-License-Identifier: Apache-2.0
"""One browser that shows the page: its camera, what it has to be shown next, and its pictures."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.util.output import write_file
from blitzgs.util.rotations import quaternion_matrices
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import Look, Picture
from blitzgs.viewer import compare
from blitzgs.viewer.compare import Shaded, shaded
from blitzgs.viewer.settings import STILL_SECONDS, Pace, Settings
from blitzgs.viewer.world import SCALE, Exhibit, Stance, World, horizontal, looking

if TYPE_CHECKING:
    import viser

# A visitor who was put before a photograph's camera stays there until the browser's camera is elsewhere. In
# the first second, the browser may still report where it was before.
_ARRIVING_SECONDS = 1.0
# Eye height above the ground of a visitor who walks, as a share of the scene's extent.
EYE_HEIGHT = 0.01


@dataclass(frozen=True, eq=False)
class Ask:
    """A picture that a visitor waits for."""

    visitor: Visitor
    look: Look  # what to draw
    version: int  # number of the visitor's viewpoint and choices
    scale: float  # side relative to full quality
    settings: Settings
    camera: int | None = None  # index of the photograph's camera to compare with; None: no comparison
    columns: int = 1  # of the grid of images side by side
    # Gain and bias, float64 [2, 3], of the photograph whose exposure is shown, or None.
    exposure: npt.NDArray[np.float64] | None = None
    is_sounding: bool = False  # the look is down from the camera, to find the ground


@dataclass(frozen=True, eq=False)
class Shown:
    """The newest picture of a visitor, for the figures on the page and for screenshots."""

    ask: Ask
    picture: Picture
    shaded: Shaded  # what the page shows of the picture


class Visitor:
    """The state of one browser; any thread may call any method."""

    def __init__(
        self,
        client: viser.ClientHandle,
        world: World,
        exhibit: Exhibit,
        wake: Callable[[], None],
        moving_ms: float,
    ) -> None:
        """Begin with the browser's camera.

        `wake`: called whenever a picture is needed. `moving_ms`: milliseconds that a picture may take while
        the camera moves.
        """
        self.client, self.world, self.exhibit, self._wake = client, world, exhibit, wake
        self.settings = Settings()  # the visitor's choices; replaced as a whole when one changes
        self.shown: Shown | None = None  # the newest picture
        self.motion = "orbit"  # "orbit", "fly" or "walk"
        self.standing: int | None = None
        self._arrived = 0.0
        self._lock = threading.Lock()
        self.version, self._drawn = 0, -1
        self._drawn_scale = 0.0
        self._moved, self._stance = 0.0, self._read()
        self._place = self._stance  # of the camera at which the visitor stands
        self._pace = Pace(moving_ms)
        self._sounded = -1
        self.is_stale = False  # the model has changed: another picture is wanted, as fine as the last
        self.is_gone = False  # the browser has closed the page
        self.figures: Any = None  # the element of the page with the figures over the picture
        self.figured = 0.0  # when they were last updated
        self.listeners: list[Callable[[], None]] = []
        client.camera.on_update(self._on_camera)

    # -- the camera ----------------------------------------------------------------------------------------

    @property
    def stance(self) -> Stance:
        """Where the visitor is; exactly the photograph's camera for one who stands there."""
        return self._stance if self.standing is None else self._place

    def _read(self) -> Stance:
        camera = self.client.camera
        wxyz = torch.tensor(tuple(camera.wxyz), dtype=torch.float64)
        rotation = quaternion_matrices((wxyz / wxyz.norm())[None])[0].numpy()
        return Stance(np.array(camera.position, dtype=np.float64), rotation, float(camera.fov))

    def _on_camera(self, _: object) -> None:
        stance = self._read()
        with self._lock:
            same = stance.is_near(self._stance, 1e-6, 1e-6) and stance.fov == self._stance.fov
            self._stance = stance
            if self.standing is not None:
                here = stance.is_near(self._place, 0.02, 0.01)
                if here or time.monotonic() < self._arrived + _ARRIVING_SECONDS:
                    return
                self.standing = None
            elif same:
                self.version += self._size_changed()
                self._wake()
                return
            self.version += 1
            self._moved = time.monotonic()
        self._wake()
        self._tell()

    def _size_changed(self) -> bool:
        shown = self.shown
        if shown is None:
            return True
        height, width = shown.shaded.image.shape[:2]
        return abs(width / height / self.client.camera.aspect - 1) > 0.05

    def _tell(self) -> None:
        for listener in self.listeners:
            listener()

    def go(
        self, stance: Stance, distance: float | None = None, up: npt.NDArray[np.float64] | None = None
    ) -> None:
        """Move the browser's camera to a stance.

        `distance`: to the point around which the browser orbits, page units; None: as the motion needs. `up`:
        the orbit's axis; None: the scene's up.
        """
        camera = self.client.camera
        if distance is None:
            distance = float(np.linalg.norm(np.array(camera.look_at) - np.array(camera.position)))
            distance = 0.02 if self.motion != "orbit" else max(distance, 0.1)
        with self.client.atomic():
            camera.up_direction = self.world.up if up is None else up
            camera.position = stance.position
            camera.look_at = stance.position + stance.rotation[:, 2] * distance
            camera.fov = stance.fov

    def stand_at(self, index: int) -> None:
        """Put the visitor where a photograph was taken."""
        camera = self.exhibit.cameras[index]
        fov = compare.fitting_fov(camera, self.client.camera.aspect)
        stance = self.world.stance(self.world.poses[index], fov)
        with self._lock:
            self.standing, self._place, self._arrived = index, stance, time.monotonic()
            self.version += 1
        self.go(stance, max(0.1, self.world.distance(stance)), up=-stance.rotation[:, 1])
        self._wake()
        self._tell()

    def change(self, **choices: object) -> None:
        """Change some of the settings."""
        with self._lock:
            self.settings = replace(self.settings, **choices)  # type: ignore[arg-type]
            self.version += 1
        self._wake()

    def choose_motion(self, motion: str) -> None:
        """Choose how the camera moves: "orbit", "fly" or "walk"."""
        self.motion = motion
        self.go(self.stance, self.world.distance(self.stance) if motion == "orbit" else None)

    # -- pictures ------------------------------------------------------------------------------------------

    def next_ask(self) -> Ask | None:
        """Return what to draw next; None: nothing at present."""
        with self._lock:
            moving = time.monotonic() < self._moved + STILL_SECONDS
            version, settings = self.version, self.settings
            drawn = self._drawn_scale if self._drawn == version else None
            scale = (
                self._pace.next_scale(drawn, moving) if settings.adapts else (1.0 if drawn is None else None)
            )
            stance, index = self.stance, self.standing
            if scale is None and self.is_stale and not moving:
                scale = drawn
            if scale == 1.0:
                self.is_stale = False
            if scale is None:
                if self.motion == "walk" and not moving and self._sounded != version:
                    self._sounded = version
                    return self._sounding(stance, version, settings)
                return None
        try:
            return self._ask(stance, index, scale, version, settings)
        except (ValueError, ArithmeticError):  # an impossible choice, such as a near plane behind the far one
            with self._lock:
                self._drawn, self._drawn_scale = version, 1.0
            return None

    def _ask(self, stance: Stance, index: int | None, scale: float, version: int, settings: Settings) -> Ask:
        """Return what to draw; `index`: of the camera at which the visitor stands."""
        exposure = self.exhibit.exposures.get(index) if settings.exposure and index is not None else None
        if settings.comparison == "off" or self.exhibit.photograph is None:
            index = None
        elif index is None:
            settings = replace(settings, comparison="off")
        sides = self.client.camera.image_width, self.client.camera.image_height
        share = scale * min(1.0, settings.most_side / max(*sides, 1))
        width, height = (max(16, round(side * share)) for side in sides)
        columns, fov = 1, stance.fov
        if index is not None:
            camera = self.exhibit.cameras[index]
            if settings.comparison == "side by side":
                columns = compare.grid_columns(camera, width, height)
                width, height = max(16, width // columns), max(16, height // compare.ROWS[columns])
            fov = compare.fitting_fov(camera, width / height)
        K = intrinsics(width, height, fov)  # noqa: N806
        look = settings.look(self.world.viewmat(stance), K, width, height)
        return Ask(self, look, version, scale, settings, index, columns, exposure)

    def _sounding(self, stance: Stance, version: int, settings: Settings) -> Ask:
        """Return a look straight down, to find the ground under a visitor who walks."""
        up = self.world.up
        down = looking(stance.position, stance.position - up, horizontal(up)[0], 0.2)
        plain = replace(settings, mode="depth", comparison="off", near=1e-6)
        look = plain.look(self.world.viewmat(down), intrinsics(32, 32, down.fov), 32, 32)
        return Ask(self, look, version, 1.0, plain, is_sounding=True)

    def take(self, ask: Ask, picture: Picture) -> Shown | None:
        """Note a drawn picture, and return what to show; None: nothing, or it is out of date."""
        if ask.is_sounding:
            self._step_to_ground(ask, picture)
            return None
        with self._lock:
            self._pace.measured(ask.scale, picture.milliseconds)
            if ask.version >= self._drawn:
                self._drawn, self._drawn_scale = ask.version, ask.scale
            else:
                return None
        result = shaded(picture, ask.look.mode)
        if ask.exposure is not None and ask.look.mode == "RGB":
            gain, bias = ask.exposure
            exposed = np.clip(result.image * gain + 255 * bias + 0.5, 0, 255).astype(np.uint8)
            result = Shaded(exposed)
        if ask.camera is not None and self.exhibit.photograph is not None:
            try:
                photograph = self.exhibit.photograph(ask.camera)
            except (OSError, ValueError, RuntimeError):
                return Shown(ask, picture, result)
            camera, kind, wipe = self.exhibit.cameras[ask.camera], ask.settings.comparison, ask.settings.wipe
            result = compare.compare(kind, result.image, photograph, camera, ask.look.K, wipe, ask.columns)
        return Shown(ask, picture, result)

    def _step_to_ground(self, ask: Ask, picture: Picture) -> None:
        known = picture.values[picture.values > 0]
        if len(known) == 0 or self.motion != "walk" or ask.version != self.version:
            return
        eye = EYE_HEIGHT * self.exhibit.space.extent * SCALE
        height = float(np.median(known)) / self.exhibit.space.unit * SCALE
        if abs(height - eye) < 0.1 * eye or not math.isfinite(height):
            return
        stance = self.stance
        self.go(replace(stance, position=stance.position - self.world.up * (height - eye)))

    def failed(self, ask: Ask, reason: str) -> None:
        """Note that a picture cannot be drawn, and tell the visitor; the next movement asks again."""
        with self._lock:
            self._drawn, self._drawn_scale = max(ask.version, self._drawn), 1.0
        self.client.add_notification("BlitzGS", reason, auto_close_seconds=10.0, color="red")

    def note(self, text: str) -> None:
        """Show a note on the page for some seconds."""
        self.client.add_notification("BlitzGS", text, auto_close_seconds=6.0)

    def save(self, name: str, suffix: str, content: bytes) -> None:
        """Give a file to the browser, write it into the folder for paths and screenshots, and say so."""
        name = (re.sub(r"[^\w.-]+", "_", name).strip("._") or "view") + suffix
        self.client.send_file_download(name, content, save_immediately=True)
        folder = self.exhibit.paths
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / name, content)
        except OSError as error:
            self.note(f"the file is in the browser's downloads; {folder} cannot be written: {error}")
        else:
            self.note(f"saved as {folder / name}")
