# SPDX-License-Identifier: Apache-2.0
"""How much memory and time a training will take, before it begins."""

from __future__ import annotations

from dataclasses import dataclass

from blitzgs.capture.capture import Capture
from blitzgs.config.fields import Config
from blitzgs.config.schedule import Schedule, stretched
from blitzgs.population.growth import growth_limit

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
    device_bytes: int  # memory of the GPU; 0 on a CPU
    host_bytes: int  # memory of the host
    minutes: float  # of training
    images: int  # that the run trains on

    def __str__(self) -> str:
        digits = max(0, len(str(self.gaussians)) - 2)
        memory = f"{self.host_bytes / 1e9:.1f} GB of memory"
        if self.device_bytes:
            memory = f"{self.device_bytes / 1e9:.1f} GB on the GPU, {memory}"
        return (
            f"about {round(self.gaussians, -digits):,} Gaussians at most, {memory} and "
            f"{max(1, round(self.minutes)):,} minutes for {self.images:,} images (rough: time within a "
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
    limit = growth_limit(
        population.max_gaussians,
        sum(sizes),
        population.pixels_per_gaussian,
        len(capture.points),
        population.gaussians_per_point,
        None,
    )
    first = int(_FIRST_PER_POINT * len(capture.points))
    if population.max_gaussians > 0:
        first = min(first, population.max_gaussians)
    # A limit ends the growth; but for `max_gaussians` it removes nothing.
    most = max(first, limit.count if limit is not None else _DENSITY_GROWTH * len(capture.points))
    schedule = Schedule(stretched(config.schedule, len(capture.train)))
    if population.strategy == "relocation":
        most, mean = _grown(first, most, population.growth, schedule)
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
        device_bytes=model if on_gpu else 0,
        host_bytes=program + photographs + (0 if on_gpu else model),
        minutes=config.schedule.minutes or minutes,
        images=schedule.iterations,
    )


def _grown(first: int, most: int, growth: float, schedule: Schedule) -> tuple[int, float]:
    """Return the last and the mean number of Gaussians of a run whose events add a share `growth`."""
    count, total, begin = float(first), 0.0, 0
    for event in schedule.events(0, schedule.iterations):
        if event.kind == "densify":
            total += count * (event.time - begin)
            begin, count = event.time, min(float(max(most, first)), count * (1 + growth))
    return int(count), (total + count * (schedule.iterations - begin)) / schedule.iterations
