# SPDX-License-Identifier: Apache-2.0
"""The spawn gate of a run: opened, and compared with what the run is."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any

from blitzgs.distributed.group import Ranks
from blitzgs.population.spawn_gate import RankVeto, SpawnGate, info_path
from blitzgs.scene.capture import Capture
from blitzgs.training.config import Config
from blitzgs.training.config_io import to_dict
from blitzgs.training.inputs import capture_fingerprint

# Fields of these sections that do not decide how long Gaussians live.
_IDLE = {
    "schedule": ("checkpoint_every", "evaluate_every", "gate_from", "minutes", "adaptive_limit", "placed"),
    "population": ("lineage", "gate", "gate_rate"),
}


def life_fields(config: Config) -> dict[str, Any]:
    """Return the fields of a configuration that decide how long Gaussians live, "section.field": value."""
    values = to_dict(config)
    return {
        f"{section}.{name}": value
        for section, idle in _IDLE.items()
        for name, value in values[section].items()
        if name not in idle
    }


def open_gate(config: Config, capture: Capture, ranks: Ranks) -> RankVeto | None:
    """Open the gate that a configuration names, and warn where it does not suit the run. Collective.

    Raises:
        GateError: its files are missing, damaged or of another kind.
        MismatchError: the ranks read different files.
    """
    population = config.population
    if population.gate is None:
        return None
    path = Path(population.gate)
    gate = SpawnGate(path)
    digest = hashlib.sha256(path.read_bytes() + info_path(path).read_bytes()).hexdigest()
    ranks.compare_across_ranks({"the spawn gate's files": digest})
    if ranks.rank == 0:
        for problem in misfits(gate, config, capture):
            warnings.warn(f"spawn gate {path}: {problem}", stacklevel=2)
    return RankVeto(gate, population.gate_rate)


def misfits(gate: SpawnGate, config: Config, capture: Capture) -> list[str]:
    """Say in what a gate does not suit a run."""
    found = []
    scene = capture_fingerprint(capture)
    if known := [name for name, other in gate.info.scenes.items() if other == scene]:
        found.append(f"it was fitted on this very capture ({', '.join(known)}): its figures say nothing here")
    fields, fitted = life_fields(config), gate.info.schedule
    if different := sorted(name for name in fields | fitted if fields.get(name) != fitted.get(name)):
        listed = ", ".join(f"{name} ({fitted.get(name)}, here {fields.get(name)})" for name in different)
        found.append(f"it was fitted under another schedule, and survival follows the schedule: {listed}")
    return found
