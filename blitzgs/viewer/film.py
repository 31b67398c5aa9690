# SPDX-License-Identifier: Apache-2.0
"""Films: their cameras, from the file of a path or made in the scene, and H.264 by the package av."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import camera_centres
from blitzgs.runs.cameras import RunCamera, checked_camera
from blitzgs.util.errors import optional_package
from blitzgs.util.output import check_replaceable, new_file
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import MAX_PIXELS
from blitzgs.view.views import CameraLike, Space
from blitzgs.viewer.paths import CameraPath, Keyframe, frames_from_json, from_json
from blitzgs.viewer.world import SCALE, Array, Stance, World, horizontal, looking

Tour = Literal["orbit", "flight", "spline"]
TOURS: tuple[Tour, ...] = get_args(Tour)
# Keyframes of a circle and of a spline.
_CIRCLE, _STATIONS = 48, 24
# A flight looks at most so steeply down, so that the horizon's side of the scene is in the picture.
_STEEPEST = math.radians(35)
# Cameras that look down less than this look at no point on the ground nearby.
_FLAT = math.radians(10)


def tour(kind: Tour, world: World, fovs: list[float]) -> CameraPath:
    """Make a path.

    - "orbit": once around the scene's middle, as high and as far as the median camera.
    - "flight": straight across the middle, along the longest extent of the cameras, at their median height;
      looks ahead, as far down as the cameras do, but at most 35 degrees.
    - "spline": a smooth way through up to 24 cameras, in the order of their names.

    `world`: of the scene; its poses are those of the cameras. `fovs`: vertical fields of view of these
    cameras, radians. ValueError: a flight or a spline needs two cameras.
    """
    if kind != "orbit" and len(world.poses) < 2:
        raise ValueError(f"--path {kind} needs the cameras of a capture: use orbit, or the file of a path")
    fov = float(np.median(fovs)) if fovs else world.start().fov
    if kind == "orbit":
        stances = _orbit(world, fov)
    elif kind == "flight":
        stances = _flight(world, fov)
    else:
        chosen = np.unique(np.linspace(0, len(world.poses) - 1, _STATIONS).round().astype(int))
        stances = [world.stance(world.poses[index], fovs[index]) for index in chosen]
    keys = [Keyframe(world.capture_pose(stance), math.degrees(stance.fov), 16 / 9) for stance in stances]
    return CameraPath(keys, seconds=10.0, is_cycle=kind == "orbit")


def _centres(world: World) -> Array:
    return SCALE * camera_centres(np.stack(world.poses))


def _orbit(world: World, fov: float) -> list[Stance]:
    arms = _centres(world) - world.middle if world.poses else (world.start().position - world.middle)[None]
    heights = arms @ world.up
    flat = np.linalg.norm(arms - heights[:, None] * world.up, axis=1)
    height = float(np.median(heights))
    # Cameras straight above the middle would leave no circle.
    radius = max(float(np.median(flat)), 0.7 * abs(height))
    east, north = horizontal(world.up)
    angles = np.arange(_CIRCLE) * 2 * math.pi / _CIRCLE
    places = [
        world.middle + radius * (math.cos(angle) * east + math.sin(angle) * north) + height * world.up
        for angle in angles
    ]
    return [looking(place, world.middle, world.up, fov) for place in places]


def _flight(world: World, fov: float) -> list[Stance]:
    arms = _centres(world) - world.middle
    heights = arms @ world.up
    flat = arms - heights[:, None] * world.up
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    ahead = axes[0] - world.up * (axes[0] @ world.up)
    ahead /= np.linalg.norm(ahead)
    ends = np.quantile(flat @ ahead, (0.1, 0.9))
    height = float(np.median(heights))
    slopes = [math.asin(float(np.clip(pose[2, :3] @ world.up, -1, 1))) for pose in world.poses]
    slope = max(-_STEEPEST, min(0.0, float(np.median(slopes))))
    view = ahead * math.cos(slope) + world.up * math.sin(slope)
    # The point on the ground that the camera looks at goes from end to end.
    behind = height / math.tan(-slope) if height > 0 and slope < -_FLAT else 0.0
    places = [world.middle + (along - behind) * ahead + height * world.up for along in ends]
    return [looking(place, place + view, world.up, fov) for place in places]


# Size and frames a second of films that are made from the scene.
SIZE, FPS = (1920, 1080), 30.0


@dataclass(frozen=True)
class Film:
    """What is known of a film before the model is open."""

    path: CameraPath | None  # its path; None: it is made from the scene
    frames: list[Keyframe]  # viewpoints as the path's file has them; empty: computed from the keyframes
    kind: str  # how the path is made from the scene
    width: int  # pixels
    height: int  # pixels
    fps: float  # frames a second
    seconds: float | None  # duration; None: the path's own

    def cameras(self, space: Space, cameras: Sequence[CameraLike], box: Array) -> list[RunCamera]:
        """Return the cameras of all frames, in the re-centred world.

        `cameras`: of its capture; may be empty. `box`: corners of a box that holds nearly all Gaussians,
        [2, 3], trained units. ValueError: the path cannot be made without cameras.
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
        text = file.read_text(encoding="utf-8", errors="replace")
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

    nerfstudio has x' = scale (R x + t), with [R | t] the "transform" of its file. FileNotFoundError: there is
    no such file. ValueError: it is damaged.
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


SUFFIX = ".mp4"
# Constant rate factor of x264: nearly no visible loss.
_QUALITY = "17"


def require_av() -> ModuleType:
    """Import the optional package that encodes films (ImportError: says how to install it)."""
    return optional_package("av", "film", "making a film")


def check_film(path: Path, width: int, height: int) -> None:
    """Check before rendering that a film can be written.

    ImportError: a package is missing. FileExistsError: there is a file that is not empty and no film.
    OSError: `path` is no regular file. ValueError: a side is an odd number of pixels.
    """
    require_av()
    check_replaceable(path)
    if path.exists():
        with open(path, "rb") as file:
            start = file.read(8)
        if start and start[4:8] != b"ftyp":
            raise FileExistsError(f"{path} exists and is no film: choose another name")
    if width % 2 or height % 2:
        raise ValueError(f"a film must have even sides, got {width}x{height}: choose another --size")


@contextmanager
def new_film(
    path: Path, width: int, height: int, fps: float
) -> Iterator[Callable[[npt.NDArray[np.uint8]], None]]:
    """Yield a function that appends a frame, uint8 RGB [H, W, 3].

    The file appears under its name when the context ends without an error; an interrupted film leaves none.

    `path`: ends in .mp4. `width`: pixels, even. `height`: pixels, even. OSError: the file cannot be written;
    an existing one is unchanged.
    """
    av = require_av()
    with new_file(path) as partial:
        try:
            with av.open(str(partial), "w", format="mp4") as container:
                stream = _stream(container, width, height, fps)

                def append(picture: npt.NDArray[np.uint8]) -> None:
                    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                    frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
                    container.mux(stream.encode(frame))

                yield append
                container.mux(stream.encode(None))
        except av.error.FFmpegError as error:
            # A plain error, whose file name `new_file` can replace by the final one.
            raise OSError(error.errno, error.strerror) from error


def _stream(container: Any, width: int, height: int, fps: float) -> Any:
    stream = container.add_stream("libx264", Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.options = {"crf": _QUALITY}
    # Players take the matrix of HD films unless the file says otherwise; so it is used, and named.
    context = stream.codec_context
    context.colorspace, context.color_primaries, context.color_trc, context.color_range = 1, 1, 1, 1
    return stream
