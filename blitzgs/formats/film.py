# SPDX-License-Identifier: Apache-2.0
"""Films: H.264 in MP4, through the package av, whose wheels contain FFmpeg."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.util.output import check_replaceable, new_file

SUFFIX = ".mp4"
# Constant rate factor of x264: nearly no visible loss.
_QUALITY = "17"


def require_av() -> ModuleType:
    """Import the optional package that encodes films.

    Raises:
        ImportError: it is not installed; the message says how to install it.
    """
    try:
        import av
    except ImportError as error:
        raise ImportError(f'films need the package av: pip install "blitzgs[film]" ({error})') from error
    return av


def check_film(path: Path, width: int, height: int) -> None:
    """Check before rendering that a film can be written.

    Raises:
        ImportError: a package is missing.
        FileExistsError: there is a file that is not empty and no film.
        OSError: `path` is no regular file.
        ValueError: a side is an odd number of pixels.
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

    Args:
        path: ends in .mp4.
        width: pixels, even.
        height: pixels, even.
        fps: frames a second.

    Raises:
        OSError: the file cannot be written; an existing one is unchanged.
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
