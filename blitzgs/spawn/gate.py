# SPDX-License-Identifier: Apache-2.0
"""The spawn gate: withholds the candidates that a predictor ranks lowest (BlitzGS, section 3.2).

A gate is a gradient-boosted tree model in XGBoost's JSON, `NAME.json`, and beside it `NAME.meta.json` with
what it was fitted on (`GateInfo`). Scores are only compared with each other: by their order, or by the ratios
of the odds. So one predictor suits scenes with very different numbers of candidates. BlitzGS evaluates the
trees itself, in integers, so the scores are the same on every device and at every world size, and training
does not need XGBoost.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from blitzgs.capture.capture import Capture, capture_fingerprint
from blitzgs.config.fields import Config
from blitzgs.config.files import to_dict, without_effect
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import decimal_share, smallest
from blitzgs.ops.counter_random import uniform
from blitzgs.ops.population import tree_sums
from blitzgs.spawn.candidates import FEATURES, Candidates, Veto
from blitzgs.util.errors import WRONG_CONTENT, warn
from blitzgs.util.output import check_replaceable, write_file

FORMAT = 1
# Name of the gate that is included in BlitzGS, for configs/density.yaml.
DEFAULT = "default"
# Takes the place of a gate's name: vetoes at random, which a gate has to surpass.
RANDOM = "random"
_SHIPPED = Path(__file__).with_name("gates") / "compact.json"
# Leaf values are rounded to integers in units of 2^-32.
_LEAF_BITS = 32
# The draws of a veto are those of the event `time` + 2^40. An importance pass of the same time draws among
# the same Gaussians by their ids and `time` itself, and would prune those that the veto has just withheld.
_VETO_EVENTS = 1 << 40


class GateError(ValueError):
    """A gate's files are missing, damaged or of another kind; the message names the file and the reason."""


@dataclass(frozen=True)
class GateInfo:
    """What a gate was fitted on."""

    features: tuple[str, ...]  # names of the model's inputs, in order
    schedule: dict[str, Any]  # fields of the configurations of the runs that it was fitted on
    scenes: dict[str, str]  # {"name": fingerprint} of the captures
    auc: dict[str, Any] = field(default_factory=dict)  # measured figures, see `blitzgs.spawn.fit`


def gate_file(name: str) -> Path:
    """Return the model file of a gate: a path, or the shipped one for "default"."""
    return _SHIPPED if name == DEFAULT else Path(name)


def info_path(path: Path) -> Path:
    """Return the path of the metadata of a model file."""
    return path.with_suffix(".meta.json")


def write_info(path: Path, info: GateInfo) -> None:
    """Write the metadata beside a model file."""
    write_file(info_path(path), json.dumps({"format": FORMAT} | dataclasses.asdict(info), indent=1) + "\n")


def check_no_other(path: Path) -> None:
    """Refuse to replace files that are not a gate's, as its metadata show (FileExistsError, OSError)."""
    metadata, otherwise = info_path(path), " and does not belong to a gate"
    check_replaceable(metadata, (b'{\n "format"',), otherwise)  # as `write_info` begins
    check_replaceable(path)
    if path.exists() and not metadata.exists():
        raise FileExistsError(f"{path} exists{otherwise}: choose another name")


def read_info(path: Path) -> GateInfo:
    """Read a model file's metadata (GateError: missing, damaged, of another format or other features)."""
    if not path.name:
        raise GateError(f"{path}: no such gate; `blitzgs gate fit` makes one")
    beside = info_path(path)
    try:
        content = json.loads(beside.read_text())
        found = content.pop("format")
        info = GateInfo(**(content | {"features": tuple(content["features"])})) if found == FORMAT else None
        if info and not all(isinstance(part, dict) for part in (info.schedule, info.scenes, info.auc)):
            raise TypeError("schedule, scenes and auc must be objects")
    except FileNotFoundError:
        if not path.exists():
            raise GateError(f"{path}: no such gate; `blitzgs gate fit` makes one") from None
        raise GateError(f"{beside} is missing: a gate is a model and its metadata, keep both") from None
    except WRONG_CONTENT as error:
        raise GateError(f"{beside} is not the metadata of a gate: {error!r}") from error
    if info is None:
        raise GateError(f"{beside}: format {found}, this version reads {FORMAT}")
    if info.features != FEATURES:
        raise GateError(
            f"{beside}: the gate was fitted on the features {list(info.features)}, this version computes "
            f"{list(FEATURES)}; fit it anew"
        )
    return info


class SpawnGate:
    """A predictor of survival."""

    def __init__(self, path: Path) -> None:
        """Read a model in XGBoost's JSON and its metadata.

        GateError: a file is missing, damaged or of another kind; for UBJSON it says how to convert it.
        """
        self.info = read_info(path)  # what it was fitted on
        if path.suffix == ".ubj":
            raise GateError(
                f"{path}: only XGBoost's JSON is read: xgboost.Booster(model_file='{path.name}').save_model("
                f"'{path.stem}.json') converts it"
            )
        try:
            self._trees = _trees_of(json.loads(path.read_text()))
        except OSError as error:
            raise GateError(f"{path} cannot be read: {error.strerror or error}") from error
        except (*WRONG_CONTENT, RuntimeError) as error:
            raise GateError(f"{path} is not a binary classifier in XGBoost's JSON: {error!r}") from error

    def scores(self, features: Tensor) -> Tensor:
        """Score candidates by their chance to survive, from features float32 [M, F]; NaN: unknown.

        Returns int64 [M], the sum of the trees' leaves in units of 2^-32: log odds up to a constant.
        """
        device, (roots, nodes, leaves, depth) = features.device, self._trees
        return tree_sums(features, roots.to(device), nodes.to(device), leaves.to(device), depth)


# The following three are vetoes once the arguments before `candidates` are given (`functools.partial`). Each
# withholds a share `rate`, in [0, 1], of the clones and of the splits, the same ones at every world size.


def rank_veto(gate: SpawnGate, rate: float, candidates: Candidates, ranks: Ranks) -> Tensor:
    """Veto those with the lowest scores over all ranks, bool [M]; ties go to the smaller id. Collective."""
    return veto_lowest(gate.scores(candidates.features).float(), candidates, rate, ranks)


def sampled_veto(gate: SpawnGate, rate: float, seed: int, candidates: Candidates, ranks: Ranks) -> Tensor:
    """Veto at random, the likelier the lower a gate's scores, bool [M]. Collective.

    The kept candidates are drawn without replacement, in proportion to the odds that the gate gives them. A
    candidate of low rank, which `rank_veto` would withhold at event after event, is thus kept now and then.
    """
    log_odds = gate.scores(candidates.features).double() * 2.0**-_LEAF_BITS
    # The order of exponential races, whose keys are -log(u) / odds, by the logarithms of the keys: the odds
    # themselves may exceed the range of numbers.
    races = (-veto_draws(candidates, seed).log()).log() - log_odds
    return veto_lowest((-races).float(), candidates, rate, ranks)


def random_veto(rate: float, seed: int, candidates: Candidates, ranks: Ranks) -> Tensor:
    """Veto at random, bool [M]. Collective."""
    return veto_lowest(veto_draws(candidates, seed).float(), candidates, rate, ranks)


def veto_draws(candidates: Candidates, seed: int) -> Tensor:
    """Draw a number for each candidate, float64 [M] uniform in (0, 1), from (seed, time, parent) alone."""
    return uniform(seed, candidates.time + _VETO_EVENTS, candidates.parents)


def veto_lowest(scores: Tensor, candidates: Candidates, rate: float, ranks: Ranks) -> Tensor:
    """Mark the ceil(rate n) lowest of all ranks' n clones, and likewise of their splits. Collective.

    Scores are float32 [M]; of the rate, in [0, 1], the decimal value counts. Returns bool [M], the same
    candidates at every world size; ties go to the smaller parent id.
    """
    vetoed = torch.zeros_like(candidates.is_split)
    for group in (~candidates.is_split, candidates.is_split):
        rows = group.nonzero().squeeze(1)
        count = int(ranks.all_reduce(torch.tensor(len(rows), device=rows.device)))
        k = math.ceil(decimal_share(rate) * count)
        vetoed[rows] = smallest(scores[rows], candidates.parents[rows], k, ranks)
    return vetoed


def _trees_of(model: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return roots, nodes, leaves and depth of all trees of a model, as `tree_sums` takes them."""
    learner = model["learner"]
    objective, count = learner["objective"]["name"], int(learner["learner_model_param"]["num_feature"])
    if objective != "binary:logistic" or count != len(FEATURES):
        raise ValueError(f"objective {objective} with {count} features")
    roots: list[int] = []
    thresholds: list[float] = []
    splits: list[tuple[int, int, int]] = []
    leaves: list[int] = []
    depth = 0
    for tree in learner["gradient_booster"]["model"]["trees"]:
        first = len(leaves)
        roots.append(first)
        depth = max(depth, _depth(tree["left_children"], tree["right_children"]))
        for node, left in enumerate(tree["left_children"]):
            value = tree["split_conditions"][node]
            if left < 0:
                splits.append((0, -1, -1))
            else:
                feature, unknown = tree["split_indices"][node], bool(tree["default_left"][node])
                if not (isinstance(feature, int) and 0 <= feature < count):
                    raise ValueError(f"a split of feature {feature}")
                if node in tree.get("categories_nodes", ()) or math.isnan(value):
                    raise ValueError(f"a split of feature {feature} without a threshold")
                splits.append((2 * feature + unknown, first + left, first + tree["right_children"][node]))
            thresholds.append(0.0 if left < 0 else value)
            leaves.append(round(value * 2**_LEAF_BITS) if left < 0 else 0)
    if not roots:
        raise ValueError("no trees")
    # The sum of the leaves that a row reaches is an integer of 64 bits.
    if sum(max(map(abs, leaves[first:end])) for first, end in pairwise([*roots, len(leaves)])) >= 2**63:
        raise ValueError("the leaves of its trees may add up to 2^31 or more")
    bits = torch.tensor(thresholds, dtype=torch.float32).view(torch.int32)
    nodes = torch.cat((bits[:, None], torch.tensor(splits, dtype=torch.int32).view(-1, 3)), 1)
    return torch.tensor(roots, dtype=torch.int32), nodes, torch.tensor(leaves), depth


def _depth(left: list[int], right: list[int]) -> int:
    """Return how many comparisons the longest path through a tree has."""
    depth, level, met = 0, [0], 1
    while level := [child for node in level for child in (left[node], right[node]) if left[node] >= 0]:
        depth, met = depth + 1, met + len(level)
        if met > len(left) or min(level) < 0 or max(level) >= len(left):
            raise ValueError("the nodes of a tree do not form one")
    return depth


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
        return partial(random_veto, population.gate_rate, config.seed), ""
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
            warn(f"spawn gate {path}: {problem}")
    if population.gate_rule == "sample":
        return partial(sampled_veto, gate, population.gate_rate, config.seed), digest
    return partial(rank_veto, gate, population.gate_rate), digest


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
