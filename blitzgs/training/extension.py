# SPDX-License-Identifier: Apache-2.0
"""Makes the schedule of a finished run longer, so that it can be trained on (`blitzgs train --extend`)."""

from __future__ import annotations

import math
from dataclasses import replace

from blitzgs.config.fields import Config
from blitzgs.config.files import ConfigError
from blitzgs.config.ranges import problems
from blitzgs.config.schedule import Schedule

# From this number on, `by` counts images; below, it is a factor.
LEAST_IMAGES = 100


def extended(config: Config, step: int, by: float) -> Config:
    """Return the configuration of a finished run with a longer schedule.

    The times of all events stay, so the new part of the run has no density events and no importance passes.
    Learning rates stay at their final values.

    Args:
        config: the run's own configuration.
        step: number of steps that the run has taken.
        by: number of images to add, if at least `LEAST_IMAGES`; else the factor of the run's length.

    Raises:
        ConfigError: the run is not finished, or would become too long.
    """
    schedule = Schedule(config.schedule)
    if step < schedule.steps:
        raise ConfigError(
            f"the run is not finished ({step * schedule.batch_size:,} of {schedule.iterations:,} images): "
            "continue it with --resume instead of --extend"
        )
    images = by if by >= LEAST_IMAGES else (by - 1) * schedule.iterations
    iterations = config.schedule.iterations + math.ceil(images / schedule.pace.scale)
    # The pace that the run has measured stays as it is.
    longer = replace(config.schedule, iterations=iterations, minutes=0.0, images_per_view=0.0)
    config = replace(config, schedule=longer)
    for problem in problems(config):
        raise ConfigError(problem)
    return config
