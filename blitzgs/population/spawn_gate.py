# SPDX-License-Identifier: Apache-2.0
"""The spawn gate: withholds the candidates of densification that a predictor ranks lowest (paper §3.2).

A gate is a gradient-boosted tree model in XGBoost's JSON, `NAME.json`, and beside it `NAME.meta.json` with
what it was fitted on (`GateInfo`). Only the order of its scores counts, so that one predictor serves scenes
with very different numbers of candidates. The trees are evaluated here, in integers: the same order on every
device and at every world size, and training needs no XGBoost.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import smallest
from blitzgs.ops.counter_random import uniform
from blitzgs.population.candidates import FEATURES, Candidates

FORMAT = 1
# Leaf values enter as integers in units of 2^-32.
_LEAF_BITS = 32
# Candidates x trees that are walked at once.
_CHUNK = 1 << 23


class GateError(ValueError):
    """A gate's files are missing, damaged or of another kind; says which and why."""


@dataclass(frozen=True)
class GateInfo:
    """What a gate was fitted on.

    Attributes:
        features: names of the model's inputs, in order.
        schedule: fields of the configuration under which its Gaussians lived.
        scenes: {"name": fingerprint} of the captures.
        auc: what was measured, see `blitzgs.population.gate_fit`.
    """

    features: tuple[str, ...]
    schedule: dict[str, Any]
    scenes: dict[str, str]
    auc: dict[str, Any] = field(default_factory=dict)


def info_path(path: Path) -> Path:
    """Return where the metadata of a model file lie."""
    return path.with_suffix(".meta.json")


def write_info(path: Path, info: GateInfo) -> None:
    """Write the metadata beside a model file."""
    info_path(path).write_text(json.dumps({"format": FORMAT} | dataclasses.asdict(info), indent=1) + "\n")


def read_info(path: Path) -> GateInfo:
    """Read the metadata of a model file.

    Raises:
        GateError: they are missing, damaged, of another format, or of other features.
    """
    beside = info_path(path)
    try:
        content = json.loads(beside.read_text())
        found = content.pop("format")
        if found != FORMAT:
            raise GateError(f"{beside}: format {found}, this version reads {FORMAT}")
        info = GateInfo(**(content | {"features": tuple(content["features"])}))
    except FileNotFoundError:
        raise GateError(f"{beside} is missing: a gate is a model and its metadata, keep both") from None
    except (json.JSONDecodeError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise GateError(f"{beside} is not the metadata of a gate: {error!r}") from error
    if info.features != FEATURES:
        raise GateError(
            f"{beside}: the gate was fitted on the features {list(info.features)}, this version computes "
            f"{list(FEATURES)}; fit it anew"
        )
    return info


class SpawnGate:
    """A predictor of survival.

    Attributes:
        info: what it was fitted on.
    """

    def __init__(self, path: Path) -> None:
        """Read a model and its metadata.

        Args:
            path: a model in XGBoost's JSON, or in UBJSON where xgboost is installed.

        Raises:
            GateError: a file is missing, damaged or of another kind.
        """
        self.info = read_info(path)
        try:
            self._trees = _Trees.of(_read_model(path))
        except (OSError, KeyError, TypeError, IndexError, ValueError) as error:
            raise GateError(f"{path} is not a binary classifier in XGBoost's JSON: {error!r}") from error

    def scores(self, features: Tensor) -> Tensor:
        """Score candidates by their chance to survive.

        Args:
            features: float32 [M, 8], see `FEATURES`; NaN: unknown.

        Returns:
            int64 [M], the sum of the trees' leaves in units of 2^-32: log odds up to a constant.
        """
        self._trees = self._trees.to(features.device)
        return self._trees.sum(features)


class RankVeto:
    """Vetoes the share of the candidates, clones and splits apart, with the lowest scores over all ranks."""

    def __init__(self, gate: SpawnGate, rate: float) -> None:
        """Veto by a gate's scores; `rate` is the share, in [0, 1]."""
        self._gate, self._rate = gate, rate

    def __call__(self, candidates: Candidates, ranks: Ranks) -> Tensor:
        """Tell which candidates are vetoed, bool [M]; ties go to the smaller id. Collective."""
        return veto_lowest(self._gate.scores(candidates.features).float(), candidates, self._rate, ranks)


class RandomVeto:
    """Vetoes as many candidates at random, the same ones at every world size."""

    def __init__(self, rate: float, seed: int) -> None:
        """Veto a share `rate` of the candidates."""
        self._rate, self._seed = rate, seed

    def __call__(self, candidates: Candidates, ranks: Ranks) -> Tensor:
        """Tell which candidates are vetoed, bool [M]. Collective."""
        draws = uniform(self._seed, candidates.time, candidates.parents).float()
        return veto_lowest(draws, candidates, self._rate, ranks)


def veto_lowest(scores: Tensor, candidates: Candidates, rate: float, ranks: Ranks) -> Tensor:
    """Mark the ceil(rate n) lowest of all ranks' n clones, and likewise of their splits.

    Args:
        scores: float32 [M].
        candidates: of this rank.
        rate: in [0, 1]; its decimal value counts.
        ranks: the job; every rank calls this.

    Returns:
        bool [M], the same candidates at every world size; ties go to the smaller parent id.
    """
    vetoed = torch.zeros_like(candidates.is_split)
    for group in (~candidates.is_split, candidates.is_split):
        rows = group.nonzero().squeeze(1)
        count = int(ranks.all_reduce(torch.tensor(len(rows), device=rows.device)))
        k = math.ceil(Fraction(repr(float(rate))) * count)
        vetoed[rows] = smallest(scores[rows], candidates.parents[rows], k, ranks)
    return vetoed


def _read_model(path: Path) -> dict[str, Any]:
    """Read a model as XGBoost's JSON."""
    if path.suffix == ".json":
        content: dict[str, Any] = json.loads(path.read_text())
        return content
    try:
        import xgboost
    except ImportError as error:
        raise GateError(
            f"{path}: only .json is read without xgboost (pip install xgboost); save the model as .json"
        ) from error
    booster = xgboost.Booster(model_file=str(path))
    content = json.loads(booster.save_raw("json"))
    return content


@dataclass(frozen=True)
class _Trees:
    """All nodes of all trees, one after the other; a leaf's children are the leaf itself.

    Attributes:
        roots: int32 [T], the first node of each tree.
        features: int32 [nodes], which input is compared; 0 for leaves.
        thresholds: float32 [nodes]; an input below goes left.
        left, right: int32 [nodes].
        unknown_left: bool [nodes], where NaN goes.
        leaves: int64 [nodes], in units of 2^-32.
        depth: of the deepest tree.
    """

    roots: Tensor
    features: Tensor
    thresholds: Tensor
    left: Tensor
    right: Tensor
    unknown_left: Tensor
    leaves: Tensor
    depth: int

    @classmethod
    def of(cls, model: dict[str, Any]) -> _Trees:
        """Take the trees out of a model."""
        learner = model["learner"]
        objective, count = learner["objective"]["name"], int(learner["learner_model_param"]["num_feature"])
        if objective != "binary:logistic" or count != len(FEATURES):
            raise ValueError(f"objective {objective} with {count} features")
        columns: dict[str, list[Any]] = {name: [] for name in ("f", "t", "l", "r", "u", "v")}
        roots, depth = [], 0
        for tree in learner["gradient_booster"]["model"]["trees"]:
            first = len(columns["f"])
            roots.append(first)
            depth = max(depth, _depth(tree["left_children"], tree["right_children"]))
            for node, left in enumerate(tree["left_children"]):
                leaf = left < 0
                value = tree["split_conditions"][node]
                columns["f"].append(0 if leaf else tree["split_indices"][node])
                columns["t"].append(0.0 if leaf else value)
                columns["l"].append(first + (node if leaf else left))
                columns["r"].append(first + (node if leaf else tree["right_children"][node]))
                columns["u"].append(bool(tree["default_left"][node]))
                columns["v"].append(round(value * 2**_LEAF_BITS) if leaf else 0)
        ints = {name: torch.tensor(columns[name], dtype=torch.int32) for name in ("f", "l", "r")}
        return cls(
            torch.tensor(roots, dtype=torch.int32),
            ints["f"],
            torch.tensor(columns["t"], dtype=torch.float32),
            ints["l"],
            ints["r"],
            torch.tensor(columns["u"]),
            torch.tensor(columns["v"]),
            depth,
        )

    def to(self, device: torch.device) -> _Trees:
        """Return the trees on a device."""
        if self.roots.device == device:
            return self
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return dataclasses.replace(self, **moved)  # type: ignore[arg-type]

    def sum(self, features: Tensor) -> Tensor:
        """Return the sum of the leaves that each row reaches, int64 [M]."""
        length = max(1, _CHUNK // max(1, len(self.roots)))
        parts = [self._sum(part) for part in features.split(length)]
        return torch.cat(parts) if parts else self.leaves.new_zeros(0)

    def _sum(self, features: Tensor) -> Tensor:
        count, width = features.shape
        flat = features.contiguous().view(-1)
        first = torch.arange(0, count * width, width, dtype=torch.int32, device=flat.device)
        rows = first[:, None].expand(count, len(self.roots)).reshape(-1)
        nodes = self.roots.repeat(count)
        for _ in range(self.depth):
            values = flat.index_select(0, rows + self.features.index_select(0, nodes))
            left = values < self.thresholds.index_select(0, nodes)
            left |= values.isnan() & self.unknown_left.index_select(0, nodes)
            nodes = torch.where(left, self.left.index_select(0, nodes), self.right.index_select(0, nodes))
        return self.leaves.index_select(0, nodes).view(count, len(self.roots)).sum(1)


def _depth(left: list[int], right: list[int]) -> int:
    """Return how many comparisons the longest path through a tree has."""
    depth, level = 0, [0]
    while level := [child for node in level for child in (left[node], right[node]) if left[node] >= 0]:
        depth += 1
    return depth
