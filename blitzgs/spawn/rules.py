# SPDX-License-Identifier: Apache-2.0
"""Opens the spawn gate of a run and compares it with the run's configuration and capture."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any

from blitzgs.capture.capture import Capture, capture_fingerprint
from blitzgs.config.fields import Config
from blitzgs.config.files import to_dict, without_effect
from blitzgs.distributed.group import Ranks
from blitzgs.spawn.candidates import Veto
from blitzgs.spawn.gate import (
    RANDOM,
    GateError,
    RandomVeto,
    RankVeto,
    SampledVeto,
    SpawnGate,
    gate_file,
    info_path,
)

# The sections whose fields decide how long Gaussians live, each with the fields that do not. The effect of
# `schedule.minutes` is in `schedule.pace`, once it is measured.
_IDLE: dict[str, tuple[str, ...]] = {
    "schedule": ("checkpoint_every", "evaluate_every", "gate_from", "minutes"),
    "population": ("lineage", "gate", "gate_rate", "gate_rule"),
    "optimiser": (),
    "loss": (),
    "model": ("deterministic",),
    "lod": (),
    "view": (),
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


def lineage_subject(config: Config, capture: Capture) -> dict[str, Any]:
    """Return the description of a run for its lineage's file `blitzgs.spawn.lineage.ABOUT`."""
    return {
        "name": Path(config.data.path).resolve().name,
        "scene": capture_fingerprint(capture),
        "schedule": life_fields(config),
    }


def open_spawn_gate(config: Config, capture: Capture, ranks: Ranks, known: str) -> tuple[Veto | None, str]:
    """Open the gate that a configuration names, and warn if it does not suit the run. Collective.

    `known` is the digest of the gate that the run has used so far, if that is known. Returns the veto (None:
    no gate) and the digest of the gate's files (empty: no gate, or a random veto). GateError: its files are
    missing, damaged, of another kind, or do not have the digest `known`.
    """
    population = config.population
    if population.gate is None:
        return None, ""
    if population.gate == RANDOM:
        return RandomVeto(population.gate_rate, config.seed), ""
    path = gate_file(population.gate)
    gate = SpawnGate(path)
    digest = hashlib.sha256(path.read_bytes() + info_path(path).read_bytes()).hexdigest()
    ranks.compare_across_ranks({"the spawn gate's files": digest})
    if known not in ("", digest):
        raise GateError(
            f"{path} or {info_path(path).name} beside it has changed since the checkpoint (SHA-256 of both "
            f"{known[:12]}..., now {digest[:12]}...): put the files back, or start another run"
        )
    if ranks.rank == 0:
        for problem in reasons_against(gate, config, capture):
            warnings.warn(f"spawn gate {path}: {problem}", stacklevel=2)
    if population.gate_rule == "sample":
        return SampledVeto(gate, population.gate_rate, config.seed), digest
    return RankVeto(gate, population.gate_rate), digest


def reasons_against(gate: SpawnGate, config: Config, capture: Capture) -> list[str]:
    """List the reasons why a gate does not suit a run."""
    found = []
    scene = capture_fingerprint(capture)
    if known := [name for name, other in gate.info.scenes.items() if other == scene]:
        found.append(f"it was fitted on this very capture ({', '.join(known)}): its figures say nothing here")
    # A field that the gate's file lacks is newer than the file; its default is the earlier behaviour.
    given = gate.info.schedule
    old = {name: value for name, value in given.items() if not without_effect(name, value, given)}
    fields, fitted = life_fields(config), life_fields(Config()) | old
    if different := sorted(name for name in fields | fitted if fields.get(name) != fitted.get(name)):
        listed = ", ".join(f"{name} ({fitted.get(name)}, here {fields.get(name)})" for name in different)
        found.append(f"it was fitted under another schedule, and survival follows the schedule: {listed}")
    if config.schedule.minutes > 0:
        found.append(
            "with schedule.minutes the run finds its pace while it trains, so that its schedule is not known "
            "yet, and survival follows the schedule"
        )
    return found
