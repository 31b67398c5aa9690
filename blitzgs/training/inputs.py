# SPDX-License-Identifier: Apache-2.0
"""Opens the capture of a run, and checks that all ranks have the same capture, code and configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import socket
from collections.abc import Hashable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, lru_cache, partial
from pathlib import Path

import numpy as np

import blitzgs
from blitzgs.capture import image_files
from blitzgs.capture.capture import Capture, MissingImagesError, capture_fingerprint, load_capture
from blitzgs.capture.images import ImageStore, decoded_shapes
from blitzgs.capture.masks import FindDamage, damaged
from blitzgs.capture.shared_images import SharedImages, size_of
from blitzgs.config.fields import BLACK, Config, DataConfig
from blitzgs.config.files import ConfigError, flat, to_dict
from blitzgs.distributed.group import Ranks
from blitzgs.util.memory import host_bytes
from blitzgs.view.views import Space

# Fields that may differ between the hosts of a job.
HOST_FIELDS = ("data.path", "data.cache_bytes")
# The least width and height of reduced photographs: a window of SSIM has 11 pixels.
LEAST_SIDE = 11
# Photographs whose alpha and mean colour are looked at before training, and pixels from one to the next.
_LOOKED_AT, _STRIDE = 8, 4


def read_ahead(data: DataConfig) -> Future[Capture] | None:
    """Begin to read a capture for `open_capture` in a thread; None: it is read by the ranks together."""
    if data.allow_missing or not data.path:
        return None
    pool = ThreadPoolExecutor(1, "blitzgs-capture")
    reading = pool.submit(load_configured, data)
    pool.shutdown(wait=False)
    return reading


def open_capture(
    config: Config,
    ranks: Ranks,
    remedy: str = "--data.allow_missing=true",
    reading: Future[Capture] | None = None,
) -> tuple[Capture, ImageStore]:
    """Load the capture that a configuration names, and open its images.

    The processes of one host share the budget for images in memory, which is at most half of its memory, and
    the decoded images if they all fit into half of that. Collective.

    `remedy`: the flag of the caller's command that leaves out views without a photograph, for the error
    message. `reading`: of `read_ahead`. ConfigError: `data.path` is not set. FileNotFoundError, ValueError:
    the capture is incomplete or damaged.
    """
    data = config.data
    if not data.path:
        raise ConfigError("data.path: no capture given; use --data DIR")
    try:
        capture = reading.result() if reading else load_configured(data, partial(_damaged_of_share, ranks))
    except MissingImagesError as error:
        raise MissingImagesError(f"{error} ({remedy})") from error
    budget = min(data.cache_bytes, host_bytes() // 2)
    factors = [factor for factor, _ in config.schedule.resolution]
    shared, taken = _share_decoded(decoded_shapes(capture, factors), budget // 2, ranks)
    left = max(0, budget - taken)  # this rank's budget may be below that of the rank which made the memory
    background = config.model.background or BLACK
    local = ranks.local_world_size
    threads = min(max(len(os.sched_getaffinity(0)) // local - 2, 2), 32)  # this rank's cores, less two
    return capture, ImageStore(capture, left // local, threads, background=background, shared=shared)


def load_configured(data: DataConfig, find_damage: FindDamage = damaged) -> Capture:
    """Call `load_capture` with the fields of a configuration."""
    fields = dataclasses.asdict(data)
    del fields["cache_bytes"]
    return load_capture(fields.pop("path"), **fields, find_damage=find_damage)


def _damaged_of_share(ranks: Ranks, files: Sequence[tuple[Path, Path | None]]) -> dict[int, str]:
    """Find damaged files; the ranks of a host, which may have its own copies, divide them. Collective."""
    begin, step = ranks.rank % ranks.local_world_size, ranks.local_world_size
    with ranks.watchdog.working("reading all photographs"):
        own = {begin + step * index: text for index, text in damaged(files[begin::step]).items()}
    return dict(sorted(item for found in ranks.all_gather_object(own) for item in found.items()))


def _share_decoded(
    shapes: Mapping[Hashable, tuple[int, ...]], budget: int, ranks: Ranks
) -> tuple[SharedImages | None, int]:
    """Open memory for decoded images of these shapes that the ranks of this host share. Collective.

    Returns the memory, and the bytes that it takes from this host. The memory is None if this is the host's
    only rank, the images would take more bytes than the budget, or the system does not let the ranks share
    memory; then every rank keeps those that it needs for itself. If the system only keeps this rank from the
    memory, the bytes count all the same.
    """
    if ranks.world_size == 1:
        return None, 0
    shared, offer, host = None, None, socket.gethostname()
    # The numbers of a host's ranks follow one another, so exactly one of them is a multiple of their count,
    # also where another host has another count.
    makes = ranks.rank % ranks.local_world_size == 0 and ranks.local_world_size > 1
    if makes and size_of(shapes) <= budget:
        with contextlib.suppress(OSError):
            shared, offer = SharedImages.create(shapes)
    gathered = ranks.all_gather_object((host, offer))
    # Containers on different hosts may have one name, so there may be several offers.
    offers = [other for name, other in gathered if name == host and other is not None]
    for other in offers:
        if shared is None:
            with contextlib.suppress(OSError):
                shared = SharedImages.join(other, shapes)
    return shared, size_of(shapes) if offers else 0


def sharing_hint(
    capture: Capture, cache_bytes: int, local_ranks: int, factors: Iterable[int] = ()
) -> str | None:
    """Return what to do if the decoded images are too many to be shared by the ranks of a host.

    `cache_bytes`: `DataConfig.cache_bytes`. `local_ranks`: number of ranks of the host. `factors`: by which
    images are reduced in addition. Returns None for a single rank, if the images fit already, or if they are
    too many for the host's memory.
    """
    size, memory = size_of(decoded_shapes(capture, factors)), host_bytes() // 2
    if local_ranks == 1 or size <= min(cache_bytes, memory) // 2 or size > memory // 2:
        return None
    gigabytes = -(-2 * size // 10**9)
    return (
        "each rank decodes the photographs for itself: with "
        f"--data.cache_bytes={gigabytes}_000_000_000, the ranks of a host would share them"
    )


def check_capture(space: Space, capture: Capture, folder: Path) -> None:
    """Check that a capture is the one of the run in `folder` (ValueError: its cameras are elsewhere)."""
    if Space.of(capture.offset, capture.extent) != space:
        raise ValueError(f"{capture.root} is not the capture of the run in {folder}: its cameras differ")


def _some(capture: Capture) -> list[int]:
    return capture.train[:: -(-len(capture.train) // _LOOKED_AT)]


@lru_cache(maxsize=1)
def is_opaque(capture: Capture) -> bool:
    """Tell whether training photographs, of which some are decoded, show something in every pixel."""
    for index in _some(capture) if capture.has_alpha else []:
        with contextlib.suppress(OSError, ValueError):  # a damaged one is left to the reader that needs it
            if not image_files.is_opaque(capture.cameras[index].image_path):
                return False
    return True


def mean_colour(capture: Capture, images: ImageStore) -> tuple[float, float, float]:
    """Return the mean colour of training photographs, of which some are read, RGB in [0, 1].

    Black if none of them can be read: the reader that needs them says so.
    """
    some = _some(capture)
    images.prefetch(some)
    means = []
    for index in some:
        with contextlib.suppress(OSError, ValueError):
            means.append(images.get(index).numpy()[::_STRIDE, ::_STRIDE].mean(axis=(0, 1)) / 255)
    red, green, blue = (round(float(value), 4) for value in np.mean(means, axis=0)) if means else BLACK
    return red, green, blue


def check_resolution(config: Config, capture: Capture) -> None:
    """Check that the photographs are large enough for `schedule.resolution` (else ConfigError)."""
    most = max((factor for factor, _ in config.schedule.resolution), default=1)
    sizes = {(capture.cameras[index].width, capture.cameras[index].height) for index in capture.train}
    width, height = min(sizes, key=min)
    if most > 1 and min(width, height) < LEAST_SIDE * most:
        raise ConfigError(
            f"schedule.resolution: divided by {most}, photographs must have at least {LEAST_SIDE} pixels in "
            f"width and height, got some of {width} x {height}: choose a smaller factor"
        )


def check_alike(config: Config, capture: Capture, ranks: Ranks, resume: bool, extend: float | None) -> None:
    """Check that all ranks run the same code with the same configuration and flags on the same capture.

    MismatchError: on every rank, naming the field and the ranks.
    """
    if ranks.world_size == 1:
        return
    fields = flat(to_dict(config)).items()
    ranks.compare_across_ranks(
        {"code version": code_fingerprint(), "capture": capture_fingerprint(capture)}
        | {"flag --resume": resume, "flag --extend": extend}
        | {f"configuration field {name}": value for name, value in fields if name not in HOST_FIELDS}
    )


@cache
def code_fingerprint() -> str:
    """Return the version of the package with a digest of its sources and kernels."""
    digest = hashlib.sha256()
    root = Path(blitzgs.__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.glob("_lib/libblitzgs_*.so")]):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return f"{blitzgs.__version__}+{digest.hexdigest()[:12]}"
