# SPDX-License-Identifier: Apache-2.0
"""The cameras of a film: read from the file of a path, or made from the scene."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from blitzgs.runs.cameras import RunCamera, checked_camera
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import MAX_PIXELS
from blitzgs.view.views import CameraLike, Space
from blitzgs.viewer.paths import CameraPath, Keyframe, frames_from_json, from_json
from blitzgs.viewer.tours import TOURS, tour
from blitzgs.viewer.world import Array, World

# Size and frames a second of films that are made from the scene.
SIZE, FPS = (1920, 1080), 30.0


@dataclass(frozen=True)
class Film:
    """What is known of a film before the model is open.

    Attributes:
        path: its path; None: it is made from the scene.
        frames: viewpoints as the path's file has them; empty: computed from the keyframes.
        kind: how the path is made from the scene.
        width: pixels.
        height: pixels.
        fps: frames a second.
        seconds: duration; None: the path's own.
    """

    path: CameraPath | None
    frames: list[Keyframe]
    kind: str
    width: int
    height: int
    fps: float
    seconds: float | None

    def cameras(self, space: Space, cameras: Sequence[CameraLike], box: Array) -> list[RunCamera]:
        """Return the cameras of all frames, in the re-centred world.

        Args:
            space: of the model.
            cameras: of its capture; may be empty.
            box: corners of a box that holds nearly all Gaussians, [2, 3], trained units.

        Raises:
            ValueError: the path cannot be made without cameras.
        """
        return [
            self._camera(number, frame, space)
            for number, frame in enumerate(self._frames(space, cameras, box), 1)
        ]

    def _frames(self, space: Space, cameras: Sequence[CameraLike], box: Array) -> list[Keyframe]:
        if self.frames:
            return self.frames
        path = self.path
        if path is None:
            fovs = [2 * math.atan(camera.height / 2 / camera.K[1, 1]) for camera in cameras]
            kind = next(kind for kind in TOURS if kind == self.kind)
            path = tour(kind, World(space, cameras, box.mean(axis=0)), fovs)
        return replace(path, fps=self.fps, seconds=self.seconds or path.seconds).frames()

    def _camera(self, number: int, frame: Keyframe, space: Space) -> RunCamera:
        pose = np.linalg.inv(frame.camera_to_world)
        pose[:3, 3] += pose[:3, :3] @ np.array(space.offset)
        K = intrinsics(self.width, self.height, math.radians(frame.fov))  # noqa: N806
        return checked_camera(f"frame_{number:05}", self.width, self.height, K, pose)


def read_film(
    source: str, size: tuple[int, int] | None, fps: float | None, seconds: float | None, moved: Path | None
) -> Film:
    """Read the file of a path, or take the name of one that is made from the scene.

    Args:
        source: a name of `TOURS`, or a file.
        size: width and height; None: the file's, or 1920 x 1080.
        fps: frames a second; None: the file's, or 30.
        seconds: duration; None: the file's, or 10.
        moved: dataparser_transforms.json of the nerfstudio training that the path is from; None: the path is
            in the capture's coordinates.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a file is damaged; names it, the place and the reason.
    """
    if source in TOURS:
        width, height = size or SIZE
        return Film(None, [], source, width, height, fps or FPS, seconds)
    file = Path(source)
    if not file.is_file():
        raise FileNotFoundError(f"--path {source}: there is no such file; {', '.join(TOURS)} need none")
    try:
        text = file.read_text(encoding="utf-8")
        path = from_json(text)
        frames = [] if fps or seconds else frames_from_json(text)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    width, height = size or (path.width, path.height)
    if max(width, height) > MAX_PIXELS:
        raise ValueError(f"{file}: render_width and render_height must be at most {MAX_PIXELS}: use --size")
    if moved is not None:
        back = _back(moved)
        frames = [back(key) for key in frames]
        path = replace(path, keyframes=[back(key) for key in path.keyframes])
    return Film(path, frames, "", width, height, fps or path.fps, seconds)


def _back(file: Path) -> Callable[[Keyframe], Keyframe]:
    """Return a function that takes a viewpoint from nerfstudio's world to that of its capture.

    nerfstudio has x' = scale (R x + t), with [R | t] the "transform" of its file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        matrix, scale = np.array(content["transform"], dtype=np.float64), float(content["scale"])
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or not 0 < scale < math.inf:
            raise ValueError(f"transform must be 3 x 4 numbers and scale positive, got {content!r:.200}")
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{file}: no dataparser_transforms.json of nerfstudio: {reason}") from error
    rotation, shift = matrix[:, :3], matrix[:, 3]

    def back(key: Keyframe) -> Keyframe:
        pose = np.eye(4)
        pose[:3, :3] = rotation.T @ key.camera_to_world[:3, :3]
        pose[:3, 3] = rotation.T @ (key.camera_to_world[:3, 3] / scale - shift)
        return replace(key, camera_to_world=pose)

    return back
