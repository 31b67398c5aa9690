# SPDX-License-Identifier: Apache-2.0
"""Makes the LOD gate of a run, or of its model, from its configuration and progress."""

from __future__ import annotations

import math

from blitzgs.config.fields import FORK, Config
from blitzgs.distributed.group import Ranks
from blitzgs.runs.run_files import Progress
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import LodGate, ModelGate
from blitzgs.view.levels import FOOTPRINT_STEPS

# Views that would keep at least this share of all Gaussians are rendered with all of them.
MOST_KEPT = 0.8
# Gaussians move after the training views were chosen, and held-out views see a little more or less.
_SLACK = 0.9


def lod_gate(config: Config, progress: Progress) -> LodGate | None:
    """Return the LOD gate at a point of a run; None if it is not open, or no training view has it.

    If every training view is rendered with all Gaussians (`MOST_KEPT`), the coarse levels have never
    been trained to stand alone. A view from farther away would then show holes where it leaves out the fine
    ones. Smooth levels fade in every training view.
    """
    if progress.finest_level is None:
        return None
    if progress.gated_views and "1" not in progress.gated_views:
        return None
    return LodGate(
        progress.reference_distance, level_fork(config), progress.level_count, progress.finest_level,
        config.view.lod == "smooth",
    )  # fmt: skip


def level_fork(config: Config) -> float:
    """Return the ratio of the distances of neighbouring levels of the LOD gate."""
    return FORK ** (1 / FOOTPRINT_STEPS) if config.view.footprint > 0 else FORK


def model_gate(config: Config, progress: Progress, table: GaussianTable, ranks: Ranks) -> ModelGate | None:
    """Return a model's LOD gate for any camera; None: it is not open. No step may be pending. Collective."""
    gate = lod_gate(config, progress)
    if gate is None:
        return None
    # With smooth levels every view has the gate: a change from a view with it to one without would be a
    # visible jump.
    if gate.smooth:
        return ModelGate(gate, math.inf, table, ranks)
    return ModelGate(gate, MOST_KEPT, table, ranks, _SLACK * progress.least_kept)
