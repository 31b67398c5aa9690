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
# Bytes of pinned memory through which rows come from the GPU. More rows take several copies.
_STAGING_BYTES = 8 << 20

_Columns = dict[str, np.ndarray[Any, Any]]


class PartWriter:
    """Writes parts of a lineage in the order in which they were added, without keeping their caller waiting.

    One thread copies rows from the device in a stream of its own, and another writes them. So a slow disk
    delays no copy, and rows leave the device's memory soon.
    """

    def __init__(self, folder: Path, device: torch.device) -> None:
        """Start the threads, which wait for parts (ImportError: pyarrow is not installed)."""
        self._parquet = import_pyarrow()
        self._folder = folder
        self._to_host = _HostArrays(device)
        self._copier = ThreadPoolExecutor(1, "lineage copy")
        self._writer = ThreadPoolExecutor(1, "lineage")
        self._copying: list[Future[Future[None]]] = []
        self._failed: list[tuple[str, _Columns, OSError]] = []

    def add(self, name: str, table: str, groups: Sequence[Tensor]) -> None:
        """Have a part written; it is on disk when `finish` has returned without messages.

        Groups are columns as in `TABLES`, contiguous; they must not change any more.
        """
        ready = None
        if groups[0].is_cuda:
            ready = torch.cuda.Event()
            ready.record(current_stream(groups[0].device))
        self._copying.append(self._copier.submit(self._copy, name, table, groups, ready))

    def finish(self) -> list[OSError]:
        """Wait until all parts are written, and try those again that could not be; return what went wrong."""
        for copying in self._copying:
            copying.result().result()
        self._copying.clear()
        failed, self._failed = self._failed, []
        for name, columns, _ in failed:
            self._write(name, columns)
        return [error for _, _, error in self._failed]

    def close(self) -> None:
        """Finish the part that is being written, and drop those behind it."""
        self._copier.shutdown(wait=True, cancel_futures=True)
        self._writer.shutdown(wait=True, cancel_futures=True)

    def _copy(
        self, name: str, table: str, groups: Sequence[Tensor], ready: torch.cuda.Event | None
    ) -> Future[None]:
        """Copy rows to the host and hand them to the thread that writes them."""
        columns: _Columns = {}
        for names, group in zip(TABLES[table], groups, strict=True):
            columns |= dict(zip(names, self._to_host(group, ready), strict=True))
        return self._writer.submit(self._write, name, columns)

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


class _HostArrays:
    """Copies tensors from a GPU to the host, in a stream of its own and through pinned memory.

    The pinned memory is allocated once, because an allocation makes the whole device wait.
    """

    def __init__(self, device: torch.device) -> None:
        is_gpu = device.type == "cuda"
        self._stream = torch.cuda.Stream(device) if is_gpu else None
        self._staging = torch.empty(_STAGING_BYTES if is_gpu else 0, dtype=torch.uint8, pin_memory=is_gpu)

    def __call__(self, source: Tensor, ready: torch.cuda.Event | None) -> np.ndarray[Any, Any]:
        """Return the values of a contiguous tensor, which exist when `ready` happens; None: they exist.

        An array of a tensor on the CPU shares its memory.
        """
        if self._stream is None or ready is None:
            return source.numpy()
        flat = source.view(-1).view(torch.uint8)
        target = np.empty(len(flat), dtype=np.uint8)
        with torch.cuda.stream(self._stream):
            self._stream.wait_event(ready)
            for begin in range(0, len(flat), _STAGING_BYTES):
                piece = flat[begin : begin + _STAGING_BYTES]
                self._staging[: len(piece)].copy_(piece, non_blocking=True)
                # Only after this wait may the caller drop `source`, whose memory belongs to another stream.
                self._stream.synchronize()
                # NumPy copies in this thread alone; torch would start a team of threads for it.
                target[begin : begin + len(piece)] = self._staging[: len(piece)].numpy()
        dtype = torch.empty(0, dtype=source.dtype).numpy().dtype
        return target.view(dtype).reshape(tuple(source.shape))


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
