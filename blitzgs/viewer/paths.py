# SPDX-License-Identifier: Apache-2.0
"""Camera paths: JSON files in the layout of nerfstudio's camera_path.json, and the controls that make them.

Matrices are camera to world, row by row, in the capture's own coordinates; a camera's axes are right, up and
backward (OpenGL). Angles are vertical fields of view in degrees.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.util.errors import WRONG_CONTENT
from blitzgs.viewer.world import Stance

if TYPE_CHECKING:
    from blitzgs.viewer.visitor import Visitor

Array = npt.NDArray[np.float64]
# From a camera with the axes right, down, forward to one with right, up, backward.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Of a film; all are in memory.
_MOST_FRAMES = 1_000_000


@dataclass
class Keyframe:
    """A viewpoint: camera to world [4, 4] (right, down, forward), vertical fov in degrees, width / height."""

    camera_to_world: Array
    fov: float
    aspect: float


@dataclass
class CameraPath:
    """Keyframes, and how they are played."""

    keyframes: list[Keyframe] = field(default_factory=list)  # at least one
    width: int = 1920  # pixels of a rendered frame
    height: int = 1080  # pixels
    fps: float = 24.0  # frames a second
    seconds: float = 4.0  # duration of the film
    is_cycle: bool = False  # whether the last keyframe leads to the first
    # All frames as another program computed them; empty: they follow from the keyframes.
    played: list[Keyframe] = field(default_factory=list)

    def frames(self) -> list[Keyframe]:
        """Return the viewpoints of all frames: positions on a Catmull-Rom spline, rotations interpolated.

        ValueError: they are too many.
        """
        if self.played:
            return self.played
        count = max(1, round(self.fps * self.seconds))
        if count > _MOST_FRAMES:
            raise ValueError(
                f"a film has at most {_MOST_FRAMES:,} frames, got {count:,}: lower fps or seconds"
            )
        keys = self.keyframes + (self.keyframes[:1] if self.is_cycle else [])
        last = len(keys) - 1
        if last < 1:
            return keys * count
        places, frames = np.stack([key.camera_to_world[:3, 3] for key in keys]), []
        for at in np.linspace(0, last, count, endpoint=not self.is_cycle).tolist():
            first = min(int(at), last - 1)
            share, around = at - first, first + np.arange(-1, 3)
            p0, p1, p2, p3 = places[around % last if self.is_cycle else around.clip(0, last)]
            a, b, pose = keys[first], keys[first + 1], np.eye(4)
            # The rotation turns about one axis.
            turn = cv2.Rodrigues(a.camera_to_world[:3, :3].T @ b.camera_to_world[:3, :3])[0]
            pose[:3, :3] = a.camera_to_world[:3, :3] @ cv2.Rodrigues(share * turn)[0]
            pose[:3, 3] = 0.5 * (
                2 * p1
                + (p2 - p0) * share
                + (2 * p0 - 5 * p1 + 4 * p2 - p3) * share**2
                + (3 * p1 - p0 - 3 * p2 + p3) * share**3
            )
            fov, aspect = a.fov + share * (b.fov - a.fov), a.aspect + share * (b.aspect - a.aspect)
            frames.append(Keyframe(pose, fov, aspect))
        return frames


def to_json(path: CameraPath) -> str:
    """Return a path as text."""
    frames = [
        {"camera_to_world": _rows(frame), "fov": frame.fov, "aspect": frame.aspect} for frame in path.frames()
    ]
    keyframes = [{"matrix": _rows(key), "fov": key.fov, "aspect": key.aspect} for key in path.keyframes]
    content = {
        "camera_type": "perspective",
        "render_width": path.width,
        "render_height": path.height,
        "fps": path.fps,
        "seconds": path.seconds,
        "is_cycle": path.is_cycle,
        "smoothness_value": 0.0,
        "default_fov": path.keyframes[0].fov,
        "default_transition_sec": path.seconds / max(1, len(path.keyframes) - (not path.is_cycle)),
        "keyframes": keyframes,
        "camera_path": frames,
        "crop": None,
    }
    return json.dumps(content, indent=1) + "\n"


def from_json(text: str) -> CameraPath:
    """Read a path; one without keyframes has its frames as keyframes.

    ValueError: it is no camera path; the message says where and why.
    """
    content = _content(text)
    keys, played = _viewpoints(content, "keyframes"), _viewpoints(content, "camera_path")
    if not (keys or played):
        raise ValueError(f"{_NO_PATH}: it has neither keyframes nor camera_path")
    fps = _number(content, "fps", 24.0, 0.01, 240.0)
    return CameraPath(
        keys or played,
        round(_number(content, "render_width", 1920, 1)),
        round(_number(content, "render_height", 1080, 1)),
        fps,
        _number(content, "seconds", 4.0, 0.0, _MOST_FRAMES / fps),
        bool(content.get("is_cycle", False)),
        played,
    )


_NO_PATH = "this is no camera path in the layout of nerfstudio"


def _content(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{_NO_PATH}: no JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{_NO_PATH}: its content is no object")
    if (kind := content.get("camera_type", "perspective")) != "perspective":
        raise ValueError(f"{_NO_PATH}: camera_type is {kind!r:.40}, and only 'perspective' is rendered")
    return content


def _viewpoints(content: dict[str, Any], name: str) -> list[Keyframe]:
    entries = content.get(name) or []
    if not isinstance(entries, list):
        raise ValueError(f"{_NO_PATH}: {name} is no list")
    found = []
    for index, entry in enumerate(entries):
        try:
            found.append(_keyframe(entry))
        except WRONG_CONTENT as error:
            raise ValueError(f"{_NO_PATH}: {name}[{index}]: {error}") from error
    return found


def _number(fields: dict[str, Any], name: str, default: float, least: float, most: float = 1e9) -> float:
    value = fields.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
        raise ValueError(f"{name} must be a number from {least:g} to {most:g}, got {value!r:.40}")
    return float(value)


def _rows(key: Keyframe) -> list[float]:
    flat: list[float] = (key.camera_to_world @ _FLIP).ravel().tolist()
    return flat


def _keyframe(entry: dict[str, Any]) -> Keyframe:
    name = next((name for name in ("matrix", "camera_to_world") if name in entry), None)
    if name is None:
        raise ValueError("matrix is missing")
    matrix = entry[name]
    if isinstance(matrix, str):  # files of old versions have the matrix as text, column by column
        flat = np.array(json.loads(matrix), dtype=np.float64).ravel()
        flat = flat.reshape(4, 4).T.ravel() if len(flat) == 16 else flat
    else:
        flat = np.array(matrix, dtype=np.float64).ravel()
    if len(flat) != 16 or not np.isfinite(flat).all():
        raise ValueError(f"{name} must be 16 finite numbers, got {len(flat)} numbers: {str(matrix):.60}")
    pose = flat.reshape(4, 4)
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise ValueError(f"{name} is no rotation with a position")
    fov, aspect = _number(entry, "fov", 50.0, 0.1, 179.0), _number(entry, "aspect", 16 / 9, 1e-3)
    return Keyframe(pose @ _FLIP, fov, aspect)


# Seconds between two keyframes of a recorded movement.
RECORD_SECONDS = 0.5


class Route:
    """The path that one visitor makes, and the controls for it."""

    def __init__(self, visitor: Visitor, gui: Any) -> None:
        """Add the controls; the path is empty."""
        self._visitor = visitor
        self._path = CameraPath()
        self._noted = 0.0
        self._plays = False
        self._count = gui.add_markdown("No viewpoint yet")
        gui.add_button("Add viewpoint").on_click(lambda _: self._add())
        self._records = gui.add_checkbox("Record movement", False, hint="A viewpoint every half second")
        self._seconds = gui.add_number("Seconds", 4.0, min=0.1, max=3600.0, step=0.5)
        self._cycle = gui.add_checkbox("Closed", False)
        gui.add_button("Play").on_click(lambda _: self._play())
        self._name = gui.add_text("Name", "path")
        gui.add_button("Save path").on_click(lambda _: self._save())
        gui.add_button("Remove the last").on_click(lambda _: self._cut(-1))
        gui.add_button("Clear").on_click(lambda _: self._cut(0))
        upload = gui.add_upload_button("Load a path", mime_type="application/json")
        upload.on_upload(lambda _: self._load(upload.value.content))
        visitor.listeners.append(self._moved)

    def _add(self) -> None:
        visitor = self._visitor
        stance, aspect = visitor.stance, visitor.client.camera.aspect
        pose = visitor.world.capture_pose(stance)
        self._path.keyframes.append(Keyframe(pose, math.degrees(stance.fov), aspect))
        self._tell()

    def _moved(self) -> None:
        now = time.monotonic()
        if self._records.value and now > self._noted + RECORD_SECONDS and not self._plays:
            self._noted = now
            self._add()

    def _cut(self, first: int) -> None:
        """Remove the viewpoints from one on."""
        del self._path.keyframes[first:]
        self._tell()

    def _tell(self) -> None:
        count = len(self._path.keyframes)
        self._count.content = f"{count} viewpoint{'s' * (count != 1)}"

    def _go(self, key: Keyframe) -> None:
        """Move the visitor to a viewpoint."""
        pose = key.camera_to_world
        position = self._visitor.world.page_position(pose[:3, 3])
        self._visitor.go(Stance(position, pose[:3, :3].copy(), math.radians(key.fov)))

    def _timed(self) -> CameraPath | None:
        """Return the path as the controls say; without viewpoints, tell the visitor, and return None."""
        if not self._path.keyframes:
            self._visitor.note("add a viewpoint first")
            return None
        self._path.seconds, self._path.is_cycle = float(self._seconds.value), bool(self._cycle.value)
        return self._path

    def _play(self) -> None:
        """Move the visitor along the path, or stop if it is being played."""
        if self._plays or (path := self._timed()) is None:
            self._plays = False
            return
        self._plays = True
        frames, begin = path.frames(), time.monotonic()
        while self._plays and not self._visitor.is_gone:
            index = int((time.monotonic() - begin) * path.fps)
            if index >= len(frames):
                break
            self._go(frames[index])
            time.sleep(0.05)
        self._plays = False

    def _save(self) -> None:
        if (path := self._timed()) is not None:
            self._visitor.save(self._name.value, ".json", to_json(path).encode())

    def _load(self, content: bytes) -> None:
        """Take over a path from a file, and go to its first viewpoint."""
        try:
            self._path = replace(from_json(content.decode()), played=[])
        except ValueError as error:
            self._visitor.note(str(error))
            return
        self._seconds.value, self._cycle.value = self._path.seconds, self._path.is_cycle
        self._tell()
        self._go(self._path.keyframes[0])
