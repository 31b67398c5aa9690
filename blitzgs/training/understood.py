# SPDX-License-Identifier: Apache-2.0
"""What a training has understood of its capture, what in that predicts a bad model, and what it will take."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from blitzgs.capture.cameras import Camera, Float64
from blitzgs.capture.capture import Capture
from blitzgs.capture.image_files import UInt8
from blitzgs.capture.images import ImageStore
from blitzgs.capture.lengths import NEAR_OF_EXTENT, depths_seen, points_seen, sampled
from blitzgs.config.fields import BLACK, Config
from blitzgs.config.schedule import Schedule, stretched
from blitzgs.population.density import growth_limit
from blitzgs.training.inputs import is_opaque, sharing_hint
from blitzgs.training.state import TrainingState
from blitzgs.util.errors import printable, warn

# Photographs that are decoded before the training, and views that are compared with the points.
_DECODED, _PROJECTED = 16, 100
# Means of a photograph or of all points' colours, of 255, from which it is black or saturated.
_BLACK, _SATURATED = 4.0, 251.0
_DIM = 16.0  # white of 12 bits in a file of 16: a photograph with hardly a brighter pixel is black
# The brightness of points and of the pixels that show them correlates by 0.5 to 0.95, with another photograph
# or a turned or cropped one by -0.2 to 0.2; among points that are mostly hidden, both are less. The least
# number of points, the least correlation, and its least share of that of the other photographs.
_LEAST_POINTS, _ALIKE, _AS_OTHERS = 100, 0.12, 0.3
# Few photographs are named only if the median is clear, as right ones of rooms fall below too. Which share is
# many.
_CLEAR, _MANY = 0.5, 0.4
# Cells of a side of the picture, and the contrast below which it says nothing, as of one colour, fog, night.
_CELLS, _LEAST_CONTRAST = 20, 2.0


class HopelessCaptureError(ValueError):
    """Poses and points of a capture do not belong together, so that there is nothing to train."""


@dataclass(frozen=True)
class Pictures:
    """Figures of some photographs."""

    means: list[float]  # mean of each, over the pixels that count, 0 to 255
    black: list[bool]  # whether hardly one of these pixels is brighter
    masked: list[float]  # share of each that its mask excludes, of those with a mask
    unread: list[str]  # what is wrong with those that could not be decoded
    likeness: dict[str, float]  # correlation with the points' brightness, by name; NaN: unknown


def check_worlds(capture: Capture) -> None:
    """Refuse a capture of which no view sees a point (HopelessCaptureError: see above)."""
    views = len(capture.cameras)
    if capture.about.blind < views:
        return
    if capture.about.random_points:
        raise HopelessCaptureError(
            f"{capture.root} has no points, and its cameras do not say where the scene is: put the points of "
            "the reconstruction into the folder (PLY, LAS, LAZ or E57 for another program's project)"
        )
    raise HopelessCaptureError(
        f"{views} of {views} views see none of the {len(capture.points):,} points, so there is nothing "
        f"to train: the cameras of {capture.about.cameras} and the points have different worlds "
        "(give points that were reconstructed with these cameras, in the same coordinates), or the "
        "cameras look along another axis than +z (COLMAP) or -z (transforms.json)"
    )


def understood(config: Config, capture: Capture, images: ImageStore) -> list[str]:
    """Return the lines of the block, and warn of what predicts a bad model."""
    pictures = _look(capture, images)
    near = config.model.near * capture.extent or capture.near
    _warn_of_pictures(capture, pictures, near)
    lines = [
        ("capture", f"{capture.root}, cameras of {capture.about.cameras}"),
        ("photographs", _photographs(capture)),
        ("held out", _held_out(capture)),
        ("stray cameras", _strays(capture)),
        ("sizes", _sizes(capture, config.data.downscale)),
        ("masks", _masks(capture, pictures)),
        ("alpha", _alpha(capture, config)),
        ("points", _points(capture)),
        ("exposure", _exposure(pictures)),
        ("extent", f"{capture.extent:.6g}; near plane {near:.4g} ({_why_near(config, capture)})"),
        *(("note", note) for note in capture.about.notes),
    ]
    # A name may have characters that a terminal would obey.
    return [f"{name + ':':15}{printable(text)}" for name, text in lines]


def _look(capture: Capture, images: ImageStore) -> Pictures:
    """Decode some photographs, evenly chosen; a damaged one is left to the reader that needs it."""
    some = capture.train[:: -(-len(capture.train) // _DECODED)]
    images.prefetch(some)
    pictures = Pictures([], [], [], [], {})
    points, colors = (sampled(column, len(capture.cameras)) for column in (capture.points, capture.colors))
    for index in some:
        try:
            image, mask = images.get(index).numpy(), images.mask(index)
        except (OSError, ValueError) as error:
            # What the check of all files has found is raised for every photograph.
            if str(error) not in pictures.unread:
                pictures.unread.append(str(error))
            continue
        camera = capture.cameras[index]
        pictures.likeness[camera.name] = _likeness(camera, image, mask, points, colors)
        step = max(1, min(image.shape[:2]) // 256)
        pixels = image[::step, ::step]
        if mask is not None:
            counts = mask.numpy()[::step, ::step] > 0
            pictures.masked.append(1 - float(counts.mean()))
            pixels = pixels[counts]
        if pixels.size:
            pictures.means.append(float(pixels.mean()))
            pictures.black.append(pictures.means[-1] < _BLACK or np.quantile(pixels, 0.99) < _DIM)
    return pictures


def _likeness(camera: Camera, image: UInt8, mask: Tensor | None, points: Float64, colors: UInt8) -> float:
    """Return the correlation of the brightness of points and of their pixels; NaN: it says nothing."""
    seen, (x, y, depth) = points_seen(camera, points)
    column, row = x.astype(int), y.astype(int)
    # Of the points in a cell, the nearest hides the others.
    cells = row * _CELLS // camera.height * _CELLS + column * _CELLS // camera.width
    order = np.argsort(depth)
    keep = order[np.unique(cells[order], return_index=True)[1]]
    if mask is not None:
        keep = keep[mask.numpy()[row[keep], column[keep]] != 0]
    if len(keep) < _LEAST_POINTS:
        return math.nan
    shown, expected = image[row[keep], column[keep]].mean(axis=1), colors[seen[keep]].mean(axis=1)
    if min(shown.std(), expected.std()) < _LEAST_CONTRAST:
        return math.nan
    return float(np.corrcoef(shown, expected)[0, 1])


def _warn_of_pictures(capture: Capture, pictures: Pictures, near: float) -> None:
    """Warn if most photographs, the colours of the points, or most views give a black or white picture."""
    means = np.array(pictures.means)
    for what, hit, cause in (
        ("black", np.array(pictures.black), "is their alpha 0 everywhere, or do 16 bits hold 12 or 10?"),
        ("saturated", means > _SATURATED, "are they overexposed, or is model.background white behind alpha?"),
    ):
        if 2 * hit.sum() > len(means):
            warn(
                f"{int(hit.sum())} of {len(means)} photographs that were looked at are {what}, and so will "
                f"the model be: {cause}"
            )
    if len(means) and not capture.about.random_points and _BLACK <= float(np.median(means)) <= _SATURATED:
        mean = float(capture.colors.mean())
        if not _BLACK <= mean <= _SATURATED:
            what = "black" if mean < _BLACK else "saturated"
            warn(
                f"the points' colours are {what} (mean {mean:.0f} of 255), and the photographs are not: "
                "the model starts with a wrong picture; are the colours read from the right fields?"
            )
    known = {name: likeness for name, likeness in pictures.likeness.items() if not math.isnan(likeness)}
    middle = float(np.median(list(known.values()))) if known else 0.0
    unlike = [name for name, likeness in known.items() if likeness < max(_ALIKE, _AS_OTHERS * middle)]
    is_clear = middle > _CLEAR or len(unlike) > _MANY * len(known)
    if unlike and is_clear and not capture.about.random_points:
        warn(
            f"{len(unlike)} of {len(known)} photographs that were looked at show other colours than the "
            f"points where these should be (first: {unlike[0]}): are they the photographs of these poses, "
            "not turned, cropped or renamed since, and the points those of the scene?"
        )
    views = capture.train[:_PROJECTED]
    points = sampled(capture.points, len(capture.cameras))
    depths = [depths_seen(capture.cameras[i], points) for i in views]
    cut = sum(len(d) > 0 and bool(d.max() <= near) for d in depths)
    if 2 * cut > len(views):
        warn(
            f"{cut} of the first {len(views)} training views have all their points in front of the near "
            f"plane ({near:.4g}) and will be black: lower model.near, or set it to 0 for a plane by depths"
        )


def _photographs(capture: Capture) -> str:
    about = capture.about
    left_out = {
        "without a camera": about.without_camera,
        "in no list of the capture's split": about.unused,
        "not on disk": about.missing,
        "damaged": about.damaged,
    }
    used = f"{len(capture.cameras)} used: {len(capture.train)} to train, {len(capture.test)} held out"
    return "; ".join([used, *(f"{count} {text}" for text, count in left_out.items() if count)])


def _held_out(capture: Capture) -> str:
    why, source = capture.about.split, capture.about.split_from
    if source and why == "the capture's own split":
        why = f"{why}, {source}"
    if not capture.test:
        return f"none ({why})"
    return f"{why}: {_first_few(capture.cameras[i].name for i in capture.test)}"


def _first_few(names: Iterable[str]) -> str:
    return ", ".join(name if k < 4 else "..." for k, name in enumerate(itertools.islice(names, 5)))


def _strays(capture: Capture) -> str:
    strays = capture.about.strays
    if not strays:
        return "none"
    names = {camera.name for camera in capture.cameras}
    shown = _first_few(f"{stray.name} at {stray.distance:.6g}" for stray in strays)
    state = "kept" if any(stray.name in names for stray in strays) else "left out"
    return f"{len(strays)} {state}: {shown} (the others are within {strays[0].others:.6g})"


def _sizes(capture: Capture, downscale: float) -> str:
    sizes = sorted({(camera.width, camera.height) for camera in capture.cameras})
    shown = " to ".join(f"{w} x {h}" for w, h in (sizes if len(sizes) < 2 else (sizes[0], sizes[-1])))
    more = f" (data.downscale={downscale:g})" if downscale > 1 else ""
    return f"{shown} pixels{more}" + (f", {len(sizes)} sizes" if len(sizes) > 1 else "")


def _masks(capture: Capture, pictures: Pictures) -> str:
    files = sum(camera.mask_path is not None for camera in capture.cameras)
    borders = sum(camera.rectification.has_invalid for camera in capture.cameras)
    if not files and not borders:
        return "none"
    parts = [f"{files} of {len(capture.cameras)} photographs have one"] if files else []
    parts += [f"{borders} have masked borders (data.undistort=mask)"] if borders else []
    if some := pictures.masked:
        parts.append(f"mean share excluded {np.mean(some):.1%} of {len(some)} looked at")
    return "; ".join(parts)


def _alpha(capture: Capture, config: Config) -> str:
    if not capture.has_alpha:
        return "none"
    colour = ", ".join(f"{value:g}" for value in config.model.background or BLACK)
    about = capture.about
    extra = f"; a further band of {about.extra_bands} is not used" if about.extra_bands else ""
    if config.model.random_background and not is_opaque(capture):
        extra += "; model.random_background has no effect"
    return f"{about.with_alpha} photographs have it; composited over model.background ({colour}){extra}"


def _points(capture: Capture) -> str:
    if capture.about.random_points:
        return f"none; {len(capture.points):,} random ones"
    about, colours = capture.about, capture.colors
    shown = f"mean colour {colours.mean():.0f} of 255"
    if (colours == colours[:1]).all():
        shown = f"all of colour {tuple(colours[0].tolist())}"
    blind = f"; {about.blind} views see none" if about.blind else ""
    colours_from = f"colours from {about.colors_from}" if about.colors_from else "no colours in the file"
    return f"{len(capture.points):,} of {about.points_from}, {colours_from}, {shown}{blind}"


def _exposure(pictures: Pictures) -> str:
    if not pictures.means:
        return f"unknown: {pictures.unread[0]}" if pictures.unread else "unknown: all pixels are masked"
    means = np.array(pictures.means)
    stops = float(np.log2(max(means.max(), 1.0) / max(means.min(), 1.0))) * 2.2  # of linear light, by sRGB
    lost = f"; {len(pictures.unread)} cannot be read: {pictures.unread[0]}" if pictures.unread else ""
    span = f"{means.min():.0f} to {means.max():.0f} of 255 ({stops:.1f} stops)"
    return f"means of {len(means)} photographs {span}{lost}"


def _why_near(config: Config, capture: Capture) -> str:
    if config.model.near:
        return f"model.near={config.model.near:g} x extent"
    if capture.near == NEAR_OF_EXTENT * capture.extent:
        return f"{NEAR_OF_EXTENT:g} x extent, well before the points"
    return "a quarter of the depth of the nearest points"


# With fewer views for each rank, a step takes a rank's host longer than its GPU (docs/city.md).
VIEWS_PER_RANK = 4
# Pixels of a photograph from which a hint names `data.downscale`, and those that the named factor leaves at
# most, by the kind of the device.
LARGE = {"cpu": 2_000_000, "cuda": 16_000_000}
COMFORTABLE = {"cpu": 1_000_000, "cuda": 4_000_000}


def hints_of(state: TrainingState) -> list[str]:
    """Return the hints for a run at its start, or where it is resumed."""
    capture, ranks, data = state.capture, state.ranks, state.config.data
    factors = [factor for factor, _ in state.config.schedule.resolution]
    hints = [
        undistortion_note(capture),
        sharing_hint(capture, data.cache_bytes, ranks.local_world_size, factors),
    ]
    if state.config.model.exposure and state.stepper.exposures is None:
        hints.append("model.exposure: the photographs have the same exposure, so none is modelled")
    if state.progress.step == 0:  # a resumed run keeps its batches and images
        hints.append(large_images_hint(capture, data.downscale, ranks.device.type))
        hints.append(small_batch_hint(state.schedule.batch_size, ranks.world_size))
    return [hint for hint in hints if hint is not None]


def undistortion_note(capture: Capture) -> str | None:
    """Return the sizes of the photographs before and after their lenses are undistorted; None: none are.

    Both are sizes before `data.downscale`, whose pixels no lens takes.
    """
    sizes = Counter(
        ((form.lens.width, form.lens.height), (form.width, form.height))
        for camera in capture.cameras
        if not (form := camera.rectification).is_identity
    )
    if not sizes:
        return None
    ((width, height), (new_width, new_height)), count = sizes.most_common(1)[0]
    share = new_width * new_height / (width * height)
    more = f"; {len(sizes) - 1} other sizes" if len(sizes) > 1 else ""
    loss = " (data.undistort=mask keeps all of them)" if share < 0.9 else ""
    return (
        f"lenses are undistorted: {count:,} photographs from {width} x {height} to {new_width} x "
        f"{new_height}, {share:.0%} of the pixels{loss}{more}"
    )


def large_images_hint(capture: Capture, downscale: float, device: str) -> str | None:
    """Return how to train on smaller photographs if they are large for the device; None if they are not."""
    sizes = [(capture.cameras[index].width, capture.cameras[index].height) for index in capture.train]
    pixels = sum(width * height for width, height in sizes) / len(sizes)
    if pixels <= LARGE.get(device, math.inf):
        return None
    factor = math.ceil(math.sqrt(pixels / COMFORTABLE[device]))
    what = "a CPU" if device == "cpu" else "one step"
    return (
        f"photographs of {largest_size(capture)} are large for {what}: the time of a step grows with their "
        f"pixels; --data.downscale={factor * downscale:g} trains with {factor**2} times fewer"
    )


def small_batch_hint(batch_size: int, world_size: int) -> str | None:
    """Return what to do if a step has too few views for several ranks; None if it has enough."""
    enough = VIEWS_PER_RANK * world_size
    if world_size == 1 or batch_size >= enough:
        return None
    return (
        f"a step of {batch_size} view{'s' * (batch_size > 1)} may be no faster on {world_size} ranks than on "
        f"one: try --schedule.batch_size={enough}, which also scales the learning rates"
    )


def largest_size(capture: Capture) -> str:
    """Return the size of the training images, of the largest if they differ, as text."""
    cameras = [capture.cameras[index] for index in capture.train]
    sizes = {(camera.width, camera.height) for camera in cameras}
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    return f"{'at most ' if len(sizes) > 1 else ''}{width} x {height}"


# Python with torch and the other packages, resident in the host's memory.
_PROGRAM_BYTES, _CUDA_PROGRAM_BYTES = 400_000_000, 2_000_000_000
# A row: float32 parameters of 11 values and the SH coefficients, each with two moments, and bookkeeping.
_OTHER_VALUES, _BOOKKEEPING_BYTES = 11, 42
# A step: splats with their lists and gradients, for each Gaussian, and images and the sums of the loss, for
# each pixel of its views.
_STEP_BYTES, _PIXEL_BYTES = 500, 100
# Rough speeds of one CPU core and of one data-centre GPU: seconds of a step, for each megapixel and million
# Gaussians of the model, as measured with one view a step.
_CPU_SECONDS, _GPU_SECONDS = (0.0, 0.3, 0.6), (0.003, 0.004, 0.004)
# The octree begins with more Gaussians than points.
_FIRST_PER_POINT = 1.3
# Without a limit, density control makes about so many Gaussians of a point.
_DENSITY_GROWTH = 5


@dataclass(frozen=True)
class Estimate:
    """What a training takes, within a factor of 2 to 3."""

    gaussians: int  # at most
    kept: int  # in the end
    device_bytes: int  # memory of the GPU; 0 on a CPU
    host_bytes: int  # memory of the host
    minutes: float  # of training
    images: int  # that the run trains on

    def __str__(self) -> str:
        most, kept = (f"{round(n, 2 - len(str(n))):,}" for n in (self.gaussians, self.kept))
        in_the_end = f" ({kept} in the end)" if self.kept < self.gaussians else ""
        device = f"{self.device_bytes / 1e9:.1f} GB on the GPU, " if self.device_bytes else ""
        return (
            f"about {most} Gaussians at most{in_the_end}, {device}{self.host_bytes / 1e9:.1f} GB of memory "
            f"and {max(1, round(self.minutes)):,} minutes for {self.images:,} images (rough: time within a "
            "factor of 3, memory of 2)"
        )


def estimate(config: Config, capture: Capture, on_gpu: bool, cores: int) -> Estimate:
    """Return roughly what a training takes on one data-centre GPU, or on `cores` cores of a CPU.

    A Gaussian takes 4 * 3 * (11 + 3 (degree + 1)^2) + 42 bytes for its row, a copy of its widest column in a
    density event, and 500 bytes in a step; a pixel of a step takes 100 bytes. The host holds the program, the
    decoded photographs up to `data.cache_bytes`, and on a CPU all of the above. A step takes
    a + b megapixels + c million Gaussians, with the mean number over the run.
    """
    sizes = [capture.cameras[i].width * capture.cameras[i].height for i in capture.train]
    population, coefficients = config.population, (config.model.sh_degree + 1) ** 2
    limit = growth_limit(population, sum(sizes), len(capture.points), None)
    first = int(_FIRST_PER_POINT * len(capture.points))
    if population.max_gaussians > 0:
        first = min(first, population.max_gaussians)
    # A limit ends the growth; but for `max_gaussians` it removes nothing.
    most = max(first, limit.count if limit is not None else _DENSITY_GROWTH * len(capture.points))
    schedule = Schedule(stretched(config.schedule, len(capture.train)))
    has_pass = population.importance and len(capture.train) >= population.pass2_views
    share = population.pass2_keep if has_pass else 1.0
    if population.strategy == "relocation":
        most, mean = _grown(first, most, population.growth, share, schedule)
    else:
        mean = most
    pixels = schedule.batch_size * max(sizes)
    row = 4 * 3 * (_OTHER_VALUES + 3 * coefficients) + _BOOKKEEPING_BYTES + 4 * 3 * max(1, coefficients - 1)
    model = most * (row + _STEP_BYTES) + pixels * _PIXEL_BYTES
    photographs = min(3 * sum(sizes), config.data.cache_bytes)
    fixed, per_megapixel, per_million = _GPU_SECONDS if on_gpu else _CPU_SECONDS
    image = fixed + (per_megapixel * sum(sizes) / len(sizes) + per_million * mean) / 1e6
    minutes = schedule.iterations * image / (1 if on_gpu else max(1, cores)) / 60
    program = _CUDA_PROGRAM_BYTES if on_gpu else _PROGRAM_BYTES
    return Estimate(
        gaussians=most,
        kept=int(share * most),
        device_bytes=model if on_gpu else 0,
        host_bytes=program + photographs + (0 if on_gpu else model),
        minutes=config.schedule.minutes or minutes,
        images=schedule.iterations,
    )


def _grown(first: int, most: int, growth: float, share: float, schedule: Schedule) -> tuple[int, float]:
    """Return the largest and the mean number of Gaussians of a run.

    Density events add the share `growth`, and the second importance pass keeps `share`.
    """
    count, total, begin, peak = float(first), 0.0, 0, 0.0
    for event in schedule.events(0, schedule.iterations):
        if event.kind in ("densify", "pass_2"):
            total += count * (event.time - begin)
            grown = min(float(max(most, first)), count * (1 + growth))
            begin, count = event.time, grown if event.kind == "densify" else share * count
            peak = max(peak, count)
    return int(max(peak, first)), (total + count * (schedule.iterations - begin)) / schedule.iterations
