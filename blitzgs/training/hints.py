# SPDX-License-Identifier: Apache-2.0
"""What a run says at its start about settings that may not fit its photographs, machine and ranks."""

from __future__ import annotations

import math
from collections import Counter

from blitzgs.capture.capture import Capture
from blitzgs.training.inputs import sharing_hint
from blitzgs.training.state import TrainingState

# With fewer views for each rank, a step takes a rank's host longer than its GPU (docs/city.md).
VIEWS_PER_RANK = 4
# Pixels of a photograph from which a hint names `data.downscale`, and those that the named factor leaves at
# most, by the kind of the device.
LARGE = {"cpu": 2_000_000, "cuda": 16_000_000}
COMFORTABLE = {"cpu": 1_000_000, "cuda": 4_000_000}


def hints_of(state: TrainingState) -> list[str]:
    """Return the hints for a run at its start, or where it is resumed."""
    capture, ranks = state.capture, state.ranks
    hints = [
        undistortion_note(capture),
        sharing_hint(
            capture,
            state.config.data.cache_bytes,
            ranks.local_world_size,
            [factor for factor, _ in state.config.schedule.resolution],
        ),
    ]
    if state.progress.step == 0:  # a resumed run keeps its batches and images
        hints.append(large_images_hint(capture, state.config.data.downscale, ranks.device.type))
        hints.append(small_batch_hint(state.schedule.batch_size, ranks.world_size))
    return [hint for hint in hints if hint is not None]


def undistortion_note(capture: Capture) -> str | None:
    """Return the sizes of the photographs before and after their lenses are undistorted; None: none are."""
    sizes = Counter(
        ((form.lens.width, form.lens.height), (camera.width, camera.height))
        for camera in capture.cameras
        if not getattr(form := camera.rectification, "is_identity", True)
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
        f"a step of {batch_size} views may be no faster on {world_size} ranks than on one: try "
        f"--schedule.batch_size={enough}, which also scales the learning rates"
    )


def largest_size(capture: Capture) -> str:
    """Return the size of the training images, of the largest if they differ, as text."""
    cameras = [capture.cameras[index] for index in capture.train]
    sizes = {(camera.width, camera.height) for camera in cameras}
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    return f"{'at most ' if len(sizes) > 1 else ''}{width} x {height}"
