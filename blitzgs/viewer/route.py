# SPDX-License-Identifier: Apache-2.0
"""The controls for viewpoints and camera paths (save, record, play, load), and files of a visitor."""

from __future__ import annotations

import math
import re
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from blitzgs.util.output import write_file
from blitzgs.viewer.paths import CameraPath, Keyframe, from_json, to_json
from blitzgs.viewer.world import Stance

if TYPE_CHECKING:
    from blitzgs.viewer.visitor import Visitor


# Seconds between two keyframes of a recorded movement.
RECORD_SECONDS = 0.5


class Route:
    """The path that one visitor makes."""

    def __init__(self, visitor: Visitor, gui: Any) -> None:
        """Begin with an empty path."""
        self._visitor, self._gui = visitor, gui
        self.path = CameraPath()
        self._noted = 0.0
        self._playing = threading.Event()

    def build(self) -> None:
        """Add the controls."""
        gui = self._gui
        self._count = gui.add_markdown("No viewpoint yet")
        gui.add_button("Add viewpoint").on_click(lambda _: self.add())
        self._records = gui.add_checkbox("Record movement", False, hint="A viewpoint every half second")
        self._seconds = gui.add_number("Seconds", 4.0, min=0.1, max=3600.0, step=0.5)
        self._cycle = gui.add_checkbox("Closed", False)
        gui.add_button("Play").on_click(lambda _: self.play())
        self._name = gui.add_text("Name", "path")
        gui.add_button("Save path").on_click(lambda _: self.save())
        gui.add_button("Remove the last").on_click(lambda _: self.remove())
        gui.add_button("Clear").on_click(lambda _: self.clear())
        upload = gui.add_upload_button("Load a path", mime_type="application/json")
        upload.on_upload(lambda _: self.load(upload.value.content))
        self._visitor.listeners.append(self._moved)

    def add(self) -> None:
        """Add the present viewpoint."""
        visitor = self._visitor
        stance, aspect = visitor.stance, visitor.client.camera.aspect
        pose = visitor.world.capture_pose(stance)
        self.path.keyframes.append(Keyframe(pose, math.degrees(stance.fov), aspect))
        self._tell()

    def _moved(self) -> None:
        if (
            self._records.value
            and time.monotonic() > self._noted + RECORD_SECONDS
            and not self._playing.is_set()
        ):
            self._noted = time.monotonic()
            self.add()

    def remove(self) -> None:
        """Remove the last viewpoint."""
        if self.path.keyframes:
            self.path.keyframes.pop()
        self._tell()

    def clear(self) -> None:
        """Remove all viewpoints."""
        self.path.keyframes.clear()
        self._tell()

    def _tell(self) -> None:
        count = len(self.path.keyframes)
        self._count.content = f"{count} viewpoint{'s' * (count != 1)}"

    def stance_of(self, key: Keyframe) -> Stance:
        """Return a viewpoint in the page's coordinates."""
        pose = key.camera_to_world
        position = self._visitor.world.page_position(pose[:3, 3])
        return Stance(position, pose[:3, :3].copy(), math.radians(key.fov))

    def _timed(self) -> CameraPath:
        self.path.seconds, self.path.is_cycle = float(self._seconds.value), bool(self._cycle.value)
        return self.path

    def play(self) -> None:
        """Move the visitor along the path, or stop if it is being played."""
        if self._playing.is_set():
            self._playing.clear()
            return
        if not self.path.keyframes:
            note(self._visitor, "add a viewpoint first")
            return
        self._playing.set()
        frames, begin = self._timed().frames(), time.monotonic()
        while self._playing.is_set():
            index = int((time.monotonic() - begin) * self.path.fps)
            if index >= len(frames) or self._visitor.is_gone:
                break
            self._visitor.go(self.stance_of(frames[index]))
            time.sleep(0.05)
        self._playing.clear()

    def save(self) -> None:
        """Write the path beside the run, and give it to the browser."""
        if not self.path.keyframes:
            note(self._visitor, "add a viewpoint first")
            return
        text, name = to_json(self._timed()), safe_name(self._name.value) + ".json"
        self._visitor.client.send_file_download(name, text.encode(), save_immediately=True)
        note(self._visitor, save_beside(self._visitor.exhibit.paths, name, text))

    def load(self, content: bytes) -> None:
        """Take over a path from a file, and go to its first viewpoint."""
        try:
            self.path = from_json(content.decode())
        except (ValueError, UnicodeDecodeError) as error:
            note(self._visitor, str(error))
            return
        self._seconds.value, self._cycle.value = self.path.seconds, self.path.is_cycle
        self._tell()
        if self.path.keyframes:
            self._visitor.go(self.stance_of(self.path.keyframes[0]))


def save_beside(folder: Path, name: str, content: bytes | str) -> str:
    """Write a file into the folder for paths and screenshots; return what to tell the visitor."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / name, content)
    except OSError as error:
        return f"the file is in the browser's downloads; {folder} cannot be written: {error}"
    return f"saved as {folder / name}"


def note(visitor: Visitor, text: str) -> None:
    """Show a note on the visitor's page for some seconds."""
    visitor.client.add_notification("BlitzGS", text, auto_close_seconds=6.0)


def safe_name(text: str) -> str:
    """Return a text as the name of a file."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "view"
