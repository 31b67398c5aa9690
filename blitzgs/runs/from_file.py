# SPDX-License-Identifier: Apache-2.0
"""Puts the Gaussians of a file into the trained world of a capture."""

from __future__ import annotations

import math
import re

import numpy as np
import torch
from torch import Tensor

from blitzgs.config.fields import Config
from blitzgs.config.files import changed
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import Gaussians
from blitzgs.formats.models import offset_of
from blitzgs.runs.files import Progress, TrainedModel
from blitzgs.view.draw import table_of_parameters
from blitzgs.view.gate import LodGate
from blitzgs.view.views import Space


def trained_columns(found: Gaussians, space: Space, ranks: Ranks) -> dict[str, Tensor]:
    """Return this rank's Gaussians as columns of a table, on the CPU: rank m of M gets the rows m, m + M, ...

    `found` has the capture's coordinates, or those less the offset of its header.
    """
    rows = slice(ranks.rank, None, ranks.world_size)
    shift = torch.from_numpy(np.array(offset_of(found.comments)) - np.array(space.offset))
    levels = torch.zeros(len(found)) if found.levels is None else found.levels
    columns = {
        "means": ((found.means[rows].double() + shift) / space.unit).float(),
        "quats": found.quats[rows],
        # A file may have flat Gaussians and opacities of 0 or 1; no gradient would move them.
        "scales": found.scales[rows].clamp(min=-30) - math.log(space.unit),
        "opacities": found.opacities[rows].clamp(-15, 15),
        "sh": found.sh[rows],
        "level": levels[rows].clamp(0, 255).to(torch.uint8),
        "id": torch.arange(len(found))[rows],
    }
    return {name: column.contiguous() for name, column in columns.items()}


def gate_of(found: Gaussians, unit: float) -> LodGate | None:
    """Return the LOD gate in a header of `blitzgs export`; `unit` is a trained unit in the file's."""
    pattern = r"comment lod reference_distance (\S+) fork (\S+) levels (\d+) finest (\d+)( smooth)?"
    matches = [match for line in found.comments if (match := re.fullmatch(pattern, line.strip()))]
    if not matches or found.levels is None:
        return None
    distance, fork, count, finest, smooth = matches[0].groups()
    return LodGate(float(distance) / unit, float(fork), int(count), int(finest), smooth is not None)


def model_of_file(found: Gaussians, config: Config, space: Space, near: float, ranks: Ranks) -> TrainedModel:
    """Return a model to be rendered in the views of a capture; `near` is in the capture's unit."""
    columns = trained_columns(found, space, ranks)
    table = table_of_parameters({name: column.to(ranks.device) for name, column in columns.items()})
    progress = Progress(step=0, sh_degree=found.degree, level_count=1, peak_gaussians=len(found), seconds=0.0)
    near /= space.unit * space.extent
    return TrainedModel(changed(config, "model", near=near), progress, space, table)
