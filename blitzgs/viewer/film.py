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
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.runs.cameras import RunCamera, checked_camera
from blitzgs.util.errors import WRONG_CONTENT, located, optional_package
from blitzgs.util.output import check_replaceable, new_file
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import MAX_PIXELS
from blitzgs.view.views import CameraLike, Space
from blitzgs.viewer.paths import CameraPath, Keyframe, from_json
from blitzgs.viewer.world import Array, Stance, World, horizontal, looking

TOURS = ("orbit", "flight", "spline")
# Keyframes of a circle and of a spline.
_CIRCLE, _STATIONS = 48, 24
# A flight looks at most so steeply down, so that the horizon's side of the scene is in the picture.
_STEEPEST = math.radians(35)
# Cameras that look down less than this look at no point on the ground nearby.
_FLAT = math.radians(10)


def tour(kind: str, world: World) -> list[Keyframe]:
    """Make the keyframes of one of `TOURS`.

    - "orbit": once around the scene's middle, as high and as far as the median camera.
    - "flight": straight across the middle, along the longest extent of the cameras, at their median height;
      looks ahead, as far down as the cameras do, but at most 35 degrees.
    - "spline": a smooth way through up to 24 cameras, in the order of their names.

    ValueError: a flight or a spline needs two cameras.
    """
    if kind != "orbit" and len(world.poses) < 2:
        raise ValueError(f"--path {kind} needs the cameras of a capture: use orbit, or the file of a path")
    if kind == "spline":
        chosen = np.unique(np.linspace(0, len(world.poses) - 1, _STATIONS).round().astype(int))
        stances = [world.stance(world.poses[index], world.fovs[index]) for index in chosen]
    else:
        stances = (_orbit if kind == "orbit" else _flight)(world)
    return [Keyframe(world.capture_pose(stance), math.degrees(stance.fov), 16 / 9) for stance in stances]


def _above(world: World, places: Array) -> tuple[Array, float]:
    """Return the way to places from the middle, without height, [V, 3], and their median height."""
    heights = (places - world.middle) @ world.up
    return places - world.middle - heights[:, None] * world.up, float(np.median(heights))


def _orbit(world: World) -> list[Stance]:
    start = world.start()
    flat, height = _above(world, world.centres if world.poses else start.position[None])
    fov = float(np.median(world.fovs)) if world.fovs else start.fov
    # Cameras straight above the middle would leave no circle.
    radius = max(float(np.median(np.linalg.norm(flat, axis=1))), 0.7 * abs(height))
    east, north = horizontal(world.up)
    angles = np.arange(_CIRCLE)[:, None] * 2 * math.pi / _CIRCLE
    places = world.middle + radius * (np.cos(angles) * east + np.sin(angles) * north) + height * world.up
    return [looking(place, world.middle, world.up, fov) for place in places]


def _flight(world: World) -> list[Stance]:
    flat, height = _above(world, world.centres)
    _, _, axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    ahead = axes[0] - world.up * (axes[0] @ world.up)
    ahead /= np.linalg.norm(ahead)
    slopes = np.arcsin(np.clip([pose[2, :3] @ world.up for pose in world.poses], -1, 1))
    slope = float(np.clip(np.median(slopes), -_STEEPEST, 0))
    view = ahead * math.cos(slope) + world.up * math.sin(slope)
    # The point on the ground that the camera looks at goes from end to end.
    behind = height / math.tan(-slope) if height > 0 and slope < -_FLAT else 0.0
    ends, fov = np.quantile(flat @ ahead, (0.1, 0.9)), float(np.median(world.fovs))
    places = [world.middle + (along - behind) * ahead + height * world.up for along in ends]
    return [looking(place, place + view, world.up, fov) for place in places]


@dataclass
class Film(CameraPath):
    """A path whose keyframes may depend on the scene."""

    # One of `TOURS`, which gives the keyframes once the model is open; empty: they are known.
    kind: str = ""

    def cameras(
        self,
        space: Space,
        cameras: Sequence[CameraLike],
        box: Array,
        up: tuple[float, float, float] | None = None,
    ) -> list[RunCamera]:
        """Return the cameras of all frames, in the re-centred world.

        `cameras`: of its capture; may be empty. `box`: corners of a box that holds nearly all Gaussians,
        [2, 3], trained units. `up`: the upward direction; None: the cameras tell. ValueError: the path cannot
        be made without cameras.
        """
        keys = tour(self.kind, World(space, cameras, box, up)) if self.kind else self.keyframes
        found = []
        for number, frame in enumerate(replace(self, keyframes=keys).frames(), 1):
            pose = np.linalg.inv(frame.camera_to_world)
            pose[:3, 3] += pose[:3, :3] @ np.array(space.offset)
            K = intrinsics(self.width, self.height, math.radians(frame.fov))  # noqa: N806
            found.append(checked_camera(f"frame_{number:05}", self.width, self.height, K, pose))
        return found


def read_film(
    source: str,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    seconds: float | None = None,
    moved: Path | None = None,
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
        width, height = size or (1920, 1080)
        return Film([], width, height, fps or 30.0, seconds or 10.0, source == "orbit", kind=source)
    file = Path(source)
    if not file.is_file():
        raise FileNotFoundError(f"--path {source}: there is no such file; {', '.join(TOURS)} need none")
    with located(str(file)):
        film = Film(**vars(from_json(file.read_text(encoding="utf-8", errors="replace"))))
    film.width, film.height = size or (film.width, film.height)
    if max(film.width, film.height) > MAX_PIXELS:
        raise ValueError(f"{file}: render_width and render_height must be at most {MAX_PIXELS}: use --size")
    if fps or seconds:
        film.fps, film.seconds, film.played = fps or film.fps, seconds or film.seconds, []
    if moved is not None:
        back = _back(moved)
        film.keyframes, film.played = [*map(back, film.keyframes)], [*map(back, film.played)]
    return film


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
    except WRONG_CONTENT as error:
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
