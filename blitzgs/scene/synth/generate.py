# SPDX-License-Identifier: Apache-2.0
"""Writes a synthetic city as a capture: images, COLMAP model and manifest."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2

from blitzgs.scene.colmap import write_model
from blitzgs.scene.synth.arrays import Bytes
from blitzgs.scene.synth.dataset import colmap_model
from blitzgs.scene.synth.flight import plan_flight
from blitzgs.scene.synth.options import CityOptions
from blitzgs.scene.synth.plan import Plan
from blitzgs.scene.synth.render import City
from blitzgs.scene.synth.tracks import Corners, find_corners, track

MANIFEST = "city.json"
_JPEG_QUALITY = 95

# Called with the images finished so far and their number.
Progress = Callable[[int, int], None]


def generate_city(
    out: Path | str,
    *,
    extent: float = CityOptions.extent,
    views: int = CityOptions.views,
    width: int = CityOptions.width,
    height: int = CityOptions.height,
    points_per_view: int = CityOptions.points_per_view,
    oblique: float = CityOptions.oblique,
    seed: int = CityOptions.seed,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Generate a city and photograph it from the air, unless `out` already holds the same one.

    Writes `images/*.jpg`, `sparse/0/*.bin` (a COLMAP model: PINHOLE camera, poses, points with tracks; in
    metres, z up) and `city.json` (the parameters). The folder appears only when complete. The files depend
    on the parameters alone, not on the number of threads; on another processor or with other library versions
    single pixels may differ in rounding.

    Args:
        out: folder to create.
        extent: edge of the built-up square in metres.
        views: number of images.
        width: of the images, pixels.
        height: of the images, pixels.
        points_per_view: feature points looked for per image.
        oblique: fraction of oblique views, 0 to 1.
        seed: of everything random.
        threads: to render with; all of this process's cores if None.
        overwrite: replace a city with other parameters instead of raising.
        progress: called after each image.

    Returns:
        `out`, ready to be trained on.

    Raises:
        ValueError: a parameter is out of range.
        FileExistsError: `out` holds something else.
        ModuleNotFoundError: `embreex` is not installed.
    """
    options = CityOptions(extent, views, width, height, points_per_view, oblique, seed)
    out = Path(out)
    if _reusable(out, options, overwrite):
        return out
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        _write(scratch, options, threads or len(os.sched_getaffinity(0)), progress)
        scratch.chmod(0o755)
        if out.exists() and any(out.iterdir()):
            _replace(out, scratch)
        else:
            scratch.rename(out)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    return out


def _reusable(out: Path, options: CityOptions, overwrite: bool) -> bool:
    """Return whether `out` holds this very city; raise if it holds anything that must not be replaced."""
    if not out.exists():
        return False
    if not out.is_dir():
        raise FileExistsError(f"{out} is a file; choose a folder for the city")
    if not any(out.iterdir()):
        return False
    try:
        found = json.loads((out / MANIFEST).read_text())
        if not isinstance(found, dict):
            raise ValueError("not a JSON object")
    except (OSError, ValueError) as error:
        raise FileExistsError(
            f"{out} holds no generated city ({MANIFEST}: {error}); choose another folder"
        ) from error
    wanted = options.manifest()
    different = [
        f"{key} {found.get(key)}, not {value}" for key, value in wanted.items() if found.get(key) != value
    ]
    if different and not overwrite:
        raise FileExistsError(
            f"{out} holds another city ({'; '.join(different)}); choose another folder, or --overwrite it"
        )
    return not different


def _write(folder: Path, options: CityOptions, threads: int, progress: Progress | None) -> None:
    images = folder / "images"
    images.mkdir()
    city = City(Plan(options))
    views = plan_flight(options)

    def photograph(index: int) -> Corners:
        view = views[index]
        image = city.render(view)
        _write_jpeg(images / view.name, image)
        return find_corners(city, view, image, options.points_per_view, options.seed)

    cv_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # every core has a view of its own
    try:
        with ThreadPoolExecutor(threads) as pool:
            try:
                corners = []
                for found in pool.map(photograph, range(len(views))):
                    corners.append(found)
                    if progress:
                        progress(len(corners), len(views))
                cloud = track(city, views, corners, options.seed, pool.map)
            except BaseException:
                pool.shutdown(cancel_futures=True)  # or leaving the pool would first take every photograph
                raise
    finally:
        cv2.setNumThreads(cv_threads)
    write_model(folder / "sparse" / "0", colmap_model(views, cloud))
    (folder / MANIFEST).write_text(json.dumps(options.manifest(), indent=2) + "\n")


def _replace(out: Path, scratch: Path) -> None:
    """Put a new city in place of the one in `out`, leaving alone whatever else is there."""
    (out / MANIFEST).unlink()
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
        (scratch / name).rename(out / name)
    (scratch / MANIFEST).rename(out / MANIFEST)
    scratch.rmdir()


def _write_jpeg(path: Path, image: Bytes) -> None:
    done, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise OSError(f"{path}: the image could not be encoded as JPEG")
    path.write_bytes(encoded.tobytes())
