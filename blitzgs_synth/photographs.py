# SPDX-License-Identifier: Apache-2.0
"""Takes the photographs of a city, in processes that share it, except those that exist already."""

from __future__ import annotations

import io
import multiprocessing
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from blitzgs.util.output import write_file
from blitzgs.util.progress import follow_parent
from blitzgs_synth.flight import View
from blitzgs_synth.plan import Bytes, CityOptions
from blitzgs_synth.render import City
from blitzgs_synth.tracks import Corners, find_corners

T = TypeVar("T")
_task: Callable[[int], Any]  # the task of the forked processes, which share this memory


def each(task: Callable[[int], T], count: int, processes: int) -> Iterator[T]:
    """Yield task(0), task(1), ..., task(count - 1), in this order.

    The processes are forked, so that `task` may hold gigabytes, as a closure does; only indices and results
    are sent. They end with this process, however it ends. With one process, the calls are in this one.
    BrokenProcessPool: a process was killed, for example because memory ran out.
    """
    cv_threads = cv2.getNumThreads()
    # Every core runs a call of its own, and a forked process can neither use nor end OpenCV's threads.
    cv2.setNumThreads(1)
    try:
        if processes == 1:
            yield from map(task, range(count))
        else:
            yield from _forked(task, count, processes)
    finally:
        cv2.setNumThreads(cv_threads)


def _forked(task: Callable[[int], T], count: int, processes: int) -> Iterator[T]:
    global _task
    _task = task
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(min(processes, count), context, follow_parent) as pool:
        try:
            yield from pool.map(_call, range(count))
        except BaseException:
            pool.shutdown(cancel_futures=True)  # otherwise leaving the pool would first make every call
            raise


def _call(index: int) -> Any:
    return _task(index)


IMAGES, CORNERS = "images", "corners"
_JPEG_QUALITY = 95
_FIELDS = ("pixels", "positions", "directions", "colors")

# Called with the images finished so far and their number.
Progress = Callable[[int, int], None]


def take_photographs(
    folder: Path, city: City, views: list[View], processes: int, progress: Progress | None
) -> list[Corners]:
    """Write the photographs of all views and return the corners found in each.

    A photograph that exists, is whole and has its corners beside it is not taken again. It is read once and
    compared with the checksum that is kept with the corners. So an interrupted call continues in its folder,
    which gets `images/` and `corners/`. `progress` is called after each view.
    """
    for name in (IMAGES, CORNERS):
        (folder / name).mkdir(exist_ok=True)
    options = city.plan.options

    def photograph(index: int) -> Corners:
        view = views[index]
        path = folder / IMAGES / view.name
        record = folder / CORNERS / f"{index:05d}.npz"
        corners = _finished(path, record)
        if corners is None:
            image = _exposed(city.render(view), index, options)
            corners = find_corners(city, view, image, options.points_per_view, options.seed)
            done, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            if not done:
                raise OSError(f"{path}: the image could not be encoded as JPEG")
            # Checksums find files that a power failure tore, so the files are not synced to disk.
            write_file(path, encoded.tobytes(), sync=False)
            write_file(record, _pack(corners, encoded.tobytes()), sync=False)
        return corners

    found = []
    for corners in each(photograph, len(views), processes):
        found.append(corners)
        if progress:
            progress(len(found), len(views))
    return found


def _exposed(image: Bytes, index: int, options: CityOptions) -> Bytes:
    """Return a photograph, RGB [H, W, 3], with the gain and the grain of the camera."""
    if options.grain == 0 and options.exposure == 0:
        return image
    rng = np.random.default_rng([options.seed, 6, index])
    # Channels differ by less than photographs do.
    gains = np.exp(options.exposure * (rng.standard_normal() + 0.25 * rng.standard_normal(3)))
    values = image.astype(np.float32) * gains.astype(np.float32)
    values += np.float32(options.grain) * rng.standard_normal(image.shape, np.float32)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def _finished(image: Path, record: Path) -> Corners | None:
    """Return the corners of a photograph that is whole, else None."""
    try:
        content = image.read_bytes()
        with np.load(record, allow_pickle=False) as arrays:
            if int(arrays["checksum"]) != zlib.crc32(content):
                return None
            return Corners(*(arrays[name] for name in _FIELDS))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


def _pack(corners: Corners, encoded: bytes) -> bytes:
    buffer = io.BytesIO()
    arrays = {name: getattr(corners, name) for name in _FIELDS}
    np.savez(buffer, checksum=np.uint32(zlib.crc32(encoded)), **arrays)
    return buffer.getvalue()
