# SPDX-License-Identifier: Apache-2.0
"""Reads COLMAP's database, whichever COLMAP wrote it: photographs, their matches and positions."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.capture.colmap import Float64

_PAIR_IDS = 2147483647  # the id of a pair of images a < b is this number times a, plus b


@dataclass(frozen=True)
class Found:
    """What was found in a photograph: features, and verified matches with other photographs."""

    features: int = 0
    matches: int = 0
    neighbours: int = 0


def _rows(database: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


def read_found(database: Path) -> dict[str, Found]:
    """Return what was found in each photograph, by name."""
    features = dict(_rows(database, "SELECT image_id, rows FROM keypoints"))
    matches: dict[int, list[int]] = defaultdict(list)
    for pair, count in _rows(database, "SELECT pair_id, rows FROM two_view_geometries WHERE rows > 0"):
        for image in (pair // _PAIR_IDS, pair % _PAIR_IDS):
            matches[image].append(count)
    images = _rows(database, "SELECT image_id, name FROM images")
    return {name: Found(features.get(i, 0), sum(matches[i]), len(matches[i])) for i, name in images}


def read_positions(database: Path) -> dict[str, Float64]:
    """Return the positions by GPS, by name: latitude, longitude in degrees and altitude in metres [3].

    They are metres east, north and up once pycolmap has used them.
    """
    query = "SELECT name, position FROM pose_priors JOIN images ON image_id = corr_data_id"
    try:
        rows = _rows(database, query)
    except sqlite3.OperationalError:  # the table of a COLMAP before 4.0 has other columns
        return {}
    positions = {name: np.frombuffer(blob) for name, blob in rows if blob and len(blob) == 24}
    return {name: position for name, position in positions.items() if np.isfinite(position[:2]).all()}


def camera_of(database: Path, names: Sequence[str]) -> int | None:
    """Return the camera that an interrupted stage gave to one of the photographs, or None."""
    known = dict(_rows(database, "SELECT name, camera_id FROM images")) if database.exists() else {}
    return next((known[name] for name in names if name in known), None)
