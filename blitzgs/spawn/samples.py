# SPDX-License-Identifier: Apache-2.0
"""Samples of spawns: reduces a run's lineage to one small file from which a gate can be fitted elsewhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from blitzgs.ops.counter_random import uniform
from blitzgs.spawn.candidates import FEATURES
from blitzgs.spawn.fit import AXES, Spawns, read_about, spawns_of
from blitzgs.spawn.lineage import check_columns, import_pyarrow, read_numbers
from blitzgs.util.output import check_replaceable, new_file

SUFFIX = ".parquet"
# Number of rows of a sample; a row takes some 40 bytes.
MAX_ROWS = 250_000
_ABOUT = b"blitzgs.spawns"
# Seed of the draw of parents; no other draw uses it.
_SEED = 0x5A3B1E


def write_sample(run: Spawns, path: Path, most: int = MAX_ROWS) -> float:
    """Write the spawns of some parents, drawn by the hash of their ids, so that siblings stay together.

    `most` is the expected number of rows. Returns the share of the parents that was drawn. FileExistsError:
    the file exists and is not a sample.
    """
    arrow, parquet = import_pyarrow()
    check_no_other(path)
    rate = min(1.0, most / len(run.survived))
    some = run.only((uniform(_SEED, torch.from_numpy(run.parents)) < rate).numpy())
    columns: dict[str, Any] = {"parent": some.parents, "survived": some.survived}
    columns |= dict(zip(AXES, some.positions.T, strict=True))
    columns |= dict(zip(FEATURES, some.features.T, strict=True))
    about = {name: getattr(run, name) for name in ("name", "scene", "schedule", "initial_survival")}
    about |= {"spawns": len(run.survived), "rate": rate}
    table = arrow.table({name: np.ascontiguousarray(column) for name, column in columns.items()})
    table = table.replace_schema_metadata({_ABOUT: json.dumps(about)})
    # pyarrow takes no path that is not UTF-8, so it gets the open file.
    with new_file(path) as partial, partial.open("wb") as file:
        parquet.write_table(table, file, compression="zstd", use_dictionary=False)
    return rate


def check_no_other(path: Path) -> None:
    """Refuse to replace a file of another kind, such as a part of a lineage (FileExistsError, OSError)."""
    check_replaceable(path)
    if not path.exists():
        return
    arrow, parquet = import_pyarrow()
    try:
        with path.open("rb") as file:
            known = _ABOUT in (parquet.read_schema(file).metadata or {})
    except (OSError, arrow.ArrowException):
        known = False
    if not known:
        raise FileExistsError(f"{path} exists and is not a sample of spawns: choose another --out")


def read_sample(path: Path) -> Spawns:
    """Read a sample back (FileNotFoundError: there is none; ValueError: it is none, or is damaged)."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such sample of spawns")
    table = read_numbers(path)
    content = (table.schema.metadata or {}).get(_ABOUT)
    if content is None:
        raise ValueError(f"{path} is not a sample of spawns: write one with blitzgs gate sample")
    check_columns(table, ("parent", "survived", *AXES), path)
    columns = {name: table[name].to_numpy() for name in table.column_names}
    return spawns_of(read_about(content, path), columns, path)
