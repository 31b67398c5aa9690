# SPDX-License-Identifier: Apache-2.0
"""Fits spawn gates on lineage, and evaluates them: do a candidate's children survive to the final model?"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from blitzgs.spawn.candidates import FEATURES
from blitzgs.spawn.gate import GateInfo, SpawnGate, check_no_other, write_info
from blitzgs.spawn.lineage import ABOUT, read_lineage
from blitzgs.util.charts import line_chart, maps
from blitzgs.util.errors import optional_package
from blitzgs.util.output import OutputFolder, write_file

# Largest number of births that a fit takes from a scene, drawn evenly.
MAX_ROWS = 4_000_000
XGBOOST_PARAMETERS = {
    "objective": "binary:logistic",
    "tree_method": "hist",
    "max_depth": 5,
    "eta": 0.05,
    "colsample_bytree": 0.5,
    "subsample": 0.8,
    "base_score": 0.5,
}
ROUNDS = 150
# Smallest share of the rows for a leaf. Leaves with fewer rows fit peculiarities of a scene, which lowers the
# AUC on other scenes.
LEAF_SHARE = 1 / 500
AXES = ("x", "y", "z")  # columns with the positions
# With a single scene: share of its births, by parent, that are held out to evaluate the fit on the others.
HELD_OUT = 0.25


@dataclass(frozen=True)
class Spawns:
    """The spawns of one run, K of them, without its initial Gaussians."""

    name: str  # name of the run
    scene: str  # fingerprint of its capture
    schedule: dict[str, Any]  # fields of its configuration that decide how long Gaussians live
    # float32 [K, F], see `candidates.FEATURES`; NaN where the log is older than a feature.
    features: NDArray[np.float32]
    survived: NDArray[np.bool_]  # bool [K]
    parents: NDArray[np.int64]  # int64 [K]
    positions: NDArray[np.float32]  # float32 [K, 3], where they were born
    initial_survival: float = math.nan  # share of the run's initial Gaussians that reached its final model

    @property
    def times(self) -> NDArray[np.float32]:
        """When they were born, images."""
        return self.features[:, FEATURES.index("time")]

    def only(self, rows: NDArray[Any]) -> Spawns:
        """Return some of the spawns."""
        columns = ("features", "survived", "parents", "positions")
        return dataclasses.replace(self, **{name: getattr(self, name)[rows] for name in columns})


def read_spawns(folder: Path, gaussians: int | None = None) -> Spawns:
    """Read the spawns of a finished run, of a number of Gaussians if that is known, from its lineage.

    FileNotFoundError: there is no lineage. ValueError: a file is damaged or lost, there are no spawns, or all
    or none of them survived.
    """
    tables = read_lineage(folder)
    about = read_about((folder / ABOUT).read_bytes(), folder / ABOUT)
    births, deaths = tables["births"], tables["deaths"]
    spawned = births["parent"] >= 0
    alive = ~np.isin(births["id"], deaths["id"])
    if not np.isin(deaths["id"], births["id"]).all() or gaussians not in (None, int(alive.sum())):
        raise ValueError(f"{folder} is not complete: a file of its births or deaths is lost")
    columns = {name: column[spawned] for name, column in births.items()} | {"survived": alive[spawned]}
    return spawns_of(about | {"initial_survival": float(alive[~spawned].mean())}, columns, folder)


def spawns_of(about: dict[str, Any], columns: Mapping[str, NDArray[Any]], source: Path) -> Spawns:
    """Return spawns from the description of their run and their columns by name.

    Features without a column are NaN. ValueError: all or none survived; names `source`.
    """
    survived = columns["survived"].astype(bool)
    check_outcomes(survived, source)
    unknown = np.full(len(survived), np.nan, np.float32)
    return Spawns(
        name=about["name"],
        scene=about["scene"],
        schedule=about["schedule"],
        features=np.stack([columns.get(name, unknown).astype(np.float32) for name in FEATURES], 1),
        survived=survived,
        parents=columns["parent"],
        positions=np.stack([columns[axis] for axis in AXES], 1),
        initial_survival=about.get("initial_survival", math.nan),
    )


def read_about(text: bytes | str, file: Path) -> dict[str, Any]:
    """Read the description of a run that is stored with its spawns (ValueError: `file` is damaged)."""
    try:
        about = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: the description of the run is damaged: {error}") from error
    kinds = {"name": str, "scene": str, "schedule": dict}
    if not isinstance(about, dict) or not all(isinstance(about.get(k), kind) for k, kind in kinds.items()):
        raise ValueError(f"{file}: the description of the run is damaged: it has no {', '.join(kinds)}")
    return about


def check_outcomes(survived: NDArray[np.bool_], source: object) -> None:
    """Check that some spawns survived and some did not (ValueError: this is not so; names `source`)."""
    if not 0 < survived.sum() < len(survived):
        raise ValueError(
            f"{source}: {int(survived.sum()):,} of {len(survived):,} spawns survived; a gate needs a "
            "finished run in which some did and some did not"
        )


def with_distinct_names(runs: Sequence[Spawns]) -> list[Spawns]:
    """Number runs that have the same name (of their capture's folder): `capture`, `capture_2`."""
    names: list[str] = []
    for run in runs:
        possible = itertools.chain([run.name], (f"{run.name}_{number}" for number in itertools.count(2)))
        names.append(next(name for name in possible if name not in names))
    return [dataclasses.replace(run, name=name) for run, name in zip(runs, names, strict=True)]


def auc(scores: NDArray[Any], positive: NDArray[np.bool_]) -> float:
    """Return the area under the ROC curve, from the sum of ranks (Mann and Whitney 1947).

    It is the probability that a positive scores higher than a negative; ties count half. Some are positive,
    bool [K], and some are not.
    """
    _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ends = counts.cumsum()
    ranks = (ends - (counts - 1) / 2)[inverse]
    n_positive = int(positive.sum())
    n_negative = len(positive) - n_positive
    return float((ranks[positive].sum() - n_positive * (n_positive + 1) / 2) / (n_positive * n_negative))


def best_feature(spawns: Spawns) -> tuple[str, float]:
    """Return the single feature that separates best by itself, in either direction, and its AUC."""
    found = [(name, auc(spawns.features[:, k], spawns.survived)) for k, name in enumerate(FEATURES)]
    return max(((name, max(value, 1 - value)) for name, value in found), key=lambda pair: pair[1])


def fit(runs: Sequence[Spawns], path: Path, gate_from: float = 0.0) -> dict[str, Any]:
    """Fit a gate on runs, and measure how well such a gate predicts on scenes that it was not fitted on.

    With several scenes, each scene is left out once: a gate is fitted on the runs of the other scenes and
    evaluated on the spawns of this one. With a single scene, a quarter of the parents is held out instead.
    The metadata, which are written beside the model `path`, get the returned figures: `judge` for each run
    held out. ValueError: the runs are of different schedules, or a run has too few spawns. FileExistsError:
    one of the two files exists and belongs to no gate.
    """
    xgboost = optional_package("xgboost", "gate", "fitting a gate")
    check_no_other(path)
    runs = with_distinct_names(runs)
    _check_same_schedule(runs)
    several = len({run.scene for run in runs}) > 1
    figures = []
    for run in runs:
        if several:
            held_out, others = run, [other for other in runs if other.scene != run.scene]
        else:
            held_out = run.only(_hash_uniform(run.parents) < HELD_OUT)
            others = [other.only(_hash_uniform(other.parents) >= HELD_OUT) for other in runs]
            for part in (held_out, *others):
                check_outcomes(part.survived, f"{part.name}, of which a part is held out")
        data = xgboost.DMatrix(held_out.features, feature_names=list(FEATURES))
        scores = _train(xgboost, others).predict(data, output_margin=True)
        figures.append(judge(held_out, scores, gate_from))
    protocol = "leave one scene out" if several else "a quarter of the parents held out"
    result = {"protocol": protocol, "held_out": figures}
    write_file(path, bytes(_train(xgboost, runs).save_raw("json")))
    write_info(path, GateInfo(FEATURES, runs[0].schedule, {run.name: run.scene for run in runs}, auc=result))
    return result


def judge(run: Spawns, scores: NDArray[Any], gate_from: float = 0.0) -> dict[str, Any]:
    """Return how scores [K] separate the spawns of a run that survived from the others.

    Returns the AUC of the scores, that of the best single feature and its name, the number of spawns, and the
    share that survived. `judged` has the same of the spawns from `gate_from` on (images), if this leaves some
    out and if some of these survived and some did not.
    """
    name, single = best_feature(run)
    found = {
        "run": run.name,
        "auc": auc(scores, run.survived),
        "best_feature": name,
        "best_feature_auc": single,
        "spawns": len(run.survived),
        "survived": float(run.survived.mean()),
    }
    late = run.times >= gate_from
    if not late.all() and 0 < run.survived[late].sum() < late.sum():
        found["judged"] = judge(run.only(late), scores[late])
    return found


def _check_same_schedule(runs: Sequence[Spawns]) -> None:
    first = runs[0]
    for run in runs[1:]:
        fields = sorted(first.schedule.keys() | run.schedule.keys())
        pairs = [(name, first.schedule.get(name), run.schedule.get(name)) for name in fields]
        if differing := [f"{name} ({mine!r} and {other!r})" for name, mine, other in pairs if mine != other]:
            raise ValueError(
                f"{first.name} and {run.name} were trained with different schedules, and need a gate each: "
                + ", ".join(differing)
            )


def _train(xgboost: ModuleType, runs: Sequence[Spawns]) -> Any:
    generator = np.random.default_rng(0)

    def drawn(run: Spawns) -> Spawns:
        if len(run.survived) <= MAX_ROWS:
            return run
        return run.only(np.sort(generator.choice(len(run.survived), MAX_ROWS, replace=False)))

    parts = list(map(drawn, runs))
    features = np.concatenate([part.features for part in parts])
    labels = np.concatenate([part.survived for part in parts])
    data = xgboost.DMatrix(features, labels, feature_names=list(FEATURES))
    # A row's weight in a leaf is p (1 - p), at most 1/4.
    least = {"min_child_weight": LEAF_SHARE * data.num_row() / 4}
    return xgboost.train(XGBOOST_PARAMETERS | least | {"seed": 0}, data, ROUNDS)


def _hash_uniform(ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """Map the ids of parents [K] to numbers in [0, 1); the children of a parent have the same number."""
    mixed = (ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(11)
    return mixed / 2.0**53


SURVIVAL = "survival.svg"
COHORTS = 15
# Cells of a map along its longer side, and the smallest number of spawns for which a cell has a value.
CELLS, LEAST_IN_CELL = 32, 30


def evaluate(
    gate: SpawnGate, runs: Sequence[Spawns], gate_from: Sequence[float], output: OutputFolder
) -> list[dict[str, Any]]:
    """Evaluate a gate on runs, whose schedules may differ, and draw survival.svg and regions_NAME.svg.

    Maps have only spawns from `gate_from` on, in images, for each run. Returns for each run: `fit.judge`,
    whether the gate was fitted on its scene, the share of initial Gaussians and of each birth cohort that
    survived, and `regions`.
    """
    results, curves = [], {}
    runs = with_distinct_names(runs)
    survival = output.root / SURVIVAL
    output.check(survival)
    pictures = output.paths([f"regions_{run.name}.svg" for run in runs], ".svg", flat=True)
    for run, begin, path in zip(runs, gate_from, pictures, strict=True):
        scores = gate.scores(torch.from_numpy(run.features)).double().numpy()
        late = run.times >= begin
        cohorts = survival_by_cohort(run)
        result = judge(run, scores, begin) | {
            "seen": run.scene in gate.info.scenes.values(),
            "initial_survival": run.initial_survival,
            "cohorts": cohorts,
        }
        if late.any():
            where, actual, predicted = region_rates(run.only(late), scores[late])
            result["regions"] = {"cells": int(where.sum()), "r": correlation(actual[where], predicted[where])}
            names = ("share that survived (orange: none, blue: all)", "share that the gate predicts")
            output.write(path, _utf8(maps(dict(zip(names, (actual, predicted), strict=True)))))
        curves[run.name] = [(entry["until"], entry["survived"]) for entry in cohorts]
        results.append(result)
    chart = line_chart(curves, "born at, images", "share that reaches the final model", most=1.0)
    output.write(survival, _utf8(chart))
    return results


def _utf8(picture: str) -> bytes:
    # The name of a capture's folder, which a picture shows, may have bytes that are not UTF-8.
    return picture.encode(errors="backslashreplace")


def survival_by_cohort(run: Spawns) -> list[dict[str, float]]:
    """Return, for equal stretches of birth time, how many were born and which share of them survived."""
    edges = np.linspace(run.times.min(), run.times.max(), COHORTS + 1)
    cohort = np.clip(np.searchsorted(edges, run.times, side="left") - 1, 0, COHORTS - 1)
    parts = [(float(edge), run.survived[cohort == k]) for k, edge in enumerate(edges[1:])]
    return [{"until": end, "born": len(own), "survived": float(own.mean())} for end, own in parts if len(own)]


def region_rates(
    run: Spawns, scores: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return survival by region, in the projection of the scene with the largest area.

    The predicted survivors are the spawns of the highest scores, as many as actually survived. Returns which
    cells have enough spawns, bool [rows, columns]; their actual and predicted shares of survivors, NaN in the
    others.
    """
    predicted = np.zeros(len(scores), bool)
    predicted[np.argsort(-scores, kind="stable")[: int(run.survived.sum())]] = True
    low, high = np.quantile(run.positions, (0.01, 0.99), axis=0)
    axes = np.sort(np.argsort(high - low)[1:])
    size = max(float((high - low)[axes].max()) / CELLS, 1e-12)
    shape = [max(1, math.ceil(float((high - low)[axis]) / size)) for axis in axes]
    columns, rows = (
        np.clip(((run.positions[:, axis] - low[axis]) / size).astype(int), 0, length - 1)
        for axis, length in zip(axes, shape, strict=True)
    )
    cell = rows * shape[0] + columns
    counts, actual, expected = (
        np.bincount(cell, weights, minlength=shape[0] * shape[1]).reshape(shape[1], shape[0])
        for weights in (None, run.survived.astype(float), predicted.astype(float))
    )
    where = counts >= LEAST_IN_CELL
    empty = np.where(where, counts, np.nan)
    return where, actual / empty, expected / empty


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
    """Return Pearson's correlation coefficient r; None if one of the two is constant."""
    if len(a) < 2 or a.std() == 0 or b.std() == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])
