# SPDX-License-Identifier: Apache-2.0
"""The Parquet files of a lineage: threads write them during the training, and `read_lineage` reads them.

A file holds the rows of one table from one rank, and has in its name up to which optimiser step it goes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blitzgs.ops.host import current_stream
from blitzgs.spawn.candidates import FEATURES
from blitzgs.util.errors import optional_package
from blitzgs.util.output import new_file

PART_NAME = re.compile(r"(births|deaths)_(\d{8})_(\d{4})_(\d{4,})\.parquet")
# The columns of each table. Those of one dtype are the rows of one tensor [columns, M], a group.
TABLES: dict[str, tuple[tuple[str, ...], ...]] = {
    "births": (("id", "parent"), ("x", "y", "z", *FEATURES)),  # int64, float32
    "deaths": (("id",), ("time",), ("cause",)),  # int64, int32, uint8
}
_Columns = dict[str, np.ndarray[Any, Any]]


class PartWriter:
    """Writes parts of a lineage in the order in which they were added, without keeping their caller waiting.

    A thread copies rows from the device, in a stream of its own, and writes them.
    """

    def __init__(self, folder: Path, device: torch.device) -> None:
        """Start the thread, which waits for parts (ImportError: pyarrow is not installed)."""
        self._parquet = import_pyarrow()
        self._folder = folder
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._thread = ThreadPoolExecutor(1, "lineage")
        self._writing: list[Future[None]] = []
        self._failed: list[tuple[str, _Columns, OSError]] = []

    def add(self, name: str, table: str, groups: Sequence[Tensor]) -> None:
        """Have a part written; it is on disk when `finish` has returned without messages.

        Groups are columns as in `TABLES`, contiguous; they must not change any more.
        """
        ready = None if self._stream is None else current_stream(groups[0].device).record_event()
        self._writing.append(self._thread.submit(self._copy_and_write, name, table, groups, ready))

    def finish(self) -> list[OSError]:
        """Wait until all parts are written, and try those again that could not be; return what went wrong."""
        for writing in self._writing:
            writing.result()
        self._writing.clear()
        failed, self._failed = self._failed, []
        for name, columns, _ in failed:
            self._write(name, columns)
        return [error for _, _, error in self._failed]

    def close(self) -> None:
        """Finish the part that is being written, and drop those behind it."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _copy_and_write(
        self, name: str, table: str, groups: Sequence[Tensor], ready: torch.cuda.Event | None
    ) -> None:
        columns: _Columns = {}
        with torch.cuda.stream(self._stream):  # so that copies wait for no later work
            if ready is not None:
                ready.wait()
            for names, group in zip(TABLES[table], groups, strict=True):
                columns |= dict(zip(names, group.cpu().numpy(), strict=True))
        self._write(name, columns)

    def _write(self, name: str, columns: _Columns) -> None:
        arrow, parquet = self._parquet
        try:
            # The file must be on disk when `finish` returns, because a checkpoint refers to it.
            # pyarrow takes no path that is not UTF-8, so it gets the open file.
            with new_file(self._folder / name) as partial, partial.open("wb") as file:
                # Ids and floats hardly repeat, so a dictionary would take time and save nothing.
                parquet.write_table(arrow.table(columns), file, compression="zstd", use_dictionary=False)
        except OSError as error:
            self._failed.append((name, columns, error))


def read_lineage(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the log of a run: {"births": columns, "deaths": columns}, numpy arrays by name.

    FileNotFoundError: there is no log. ValueError: a file is damaged. ImportError: pyarrow is not installed.
    """
    arrow, _ = import_pyarrow()
    tables = {}
    for table in ("births", "deaths"):
        found = (path for path in folder.glob(f"{table}_*.parquet") if PART_NAME.fullmatch(path.name))
        paths = sorted(path for path in found if path.is_file())
        if not paths and table == "births":
            raise FileNotFoundError(
                f"{folder} holds no lineage: train with --population.lineage=true to log it"
            )
        # A log of an older version lacks some of the features.
        needed = [name for group in TABLES[table] for name in group if name not in FEATURES]
        parts = [read_numbers(path) for path in paths]
        for part, path in zip(parts, paths, strict=True):
            check_columns(part, needed, path)
        if parts:
            try:
                joined = arrow.concat_tables(parts)
            except arrow.ArrowInvalid as error:
                raise ValueError(f"{folder}: the files of its {table} have different columns") from error
            tables[table] = {name: joined[name].to_numpy() for name in joined.column_names}
        else:
            tables[table] = {name: np.empty(0, np.int64) for name in ("id", "time", "cause")}
    return tables


def read_numbers(path: Path) -> Any:
    """Read a Parquet file whose columns are numbers or truth values, none of them missing, as pyarrow has it.

    ValueError: it is no such file, or is damaged; names the file.
    """
    arrow, parquet = import_pyarrow()
    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
    except (OSError, arrow.ArrowException) as error:
        raise ValueError(f"{path} is not a Parquet file, or is damaged: {error}") from error
    kinds = arrow.types
    for field, column in zip(table.schema, table.columns, strict=True):
        is_number = kinds.is_integer(field.type) or kinds.is_floating(field.type)
        if column.null_count or not (is_number or kinds.is_boolean(field.type)):
            raise ValueError(f"{path}: the column {field.name} has values that are not numbers")
    return table


def check_columns(table: Any, needed: Iterable[str], path: Path) -> None:
    """Check that a table has all columns of those names; raise ValueError with the file's path."""
    if lost := [name for name in needed if name not in table.column_names]:
        raise ValueError(f"{path} is damaged: it has no column {', '.join(lost)}")


def import_pyarrow() -> tuple[ModuleType, ModuleType]:
    """Return pyarrow and pyarrow.parquet; raise ImportError with the remedy if they are not installed."""
    what = "logging lineage as Parquet"
    return optional_package("pyarrow", "lineage", what), optional_package("pyarrow.parquet", "lineage", what)
