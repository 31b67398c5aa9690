# SPDX-License-Identifier: Apache-2.0
"""Evaluates how well a gate predicts survival in other runs: AUC, survival by birth time and by region."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from blitzgs.spawn.fit import Spawns, judge, with_distinct_names
from blitzgs.spawn.gate import SpawnGate
from blitzgs.util.charts import line_chart, maps
from blitzgs.util.output import OutputFolder

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
            picture = maps(dict(zip(names, (actual, predicted), strict=True)))
            output.write(path, _utf8(picture))
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
    found = []
    for k in range(COHORTS):
        mine = run.survived[cohort == k]
        if len(mine):
            found.append({"until": float(edges[k + 1]), "born": len(mine), "survived": float(mine.mean())})
    return found


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
