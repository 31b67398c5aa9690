# SPDX-License-Identifier: Apache-2.0
"""The LOD gate that a run, or the model it made, has at some point."""

from __future__ import annotations

import math

from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.training.config import Config
from blitzgs.training.run import Progress
from blitzgs.view.gate import LodGate, SceneGate


def lod_gate(config: Config, progress: Progress) -> LodGate | None:
    """Return the LOD gate of a run at some point; None: it is not open."""
    if progress.finest_level is None:
        return None
    return LodGate(
        progress.reference_distance,
        config.lod.fork,
        progress.level_count,
        progress.finest_level,
        config.view.smooth,
    )


def scene_gate(config: Config, progress: Progress, table: GaussianTable, ranks: Ranks) -> SceneGate | None:
    """Return the LOD gate of a model for any camera; None: it is not open. Collective.

    Args:
        config: of the run.
        progress: where the run stands.
        table: this rank's Gaussians, caught up.
        ranks: the job.
    """
    gate = lod_gate(config, progress)
    if gate is None:
        return None
    # A view without the gate beside one with it would be the jump that smooth levels are to avoid.
    most_kept = math.inf if gate.smooth else config.view.most_kept
    return SceneGate(gate, most_kept, table, ranks)
