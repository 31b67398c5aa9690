# SPDX-License-Identifier: Apache-2.0
"""Lineage: every birth and death of a Gaussian, logged as Parquet and reconciled with the live population.

Each rank writes parts of two tables into one folder, Parquet files that hold what happened up to the
optimiser step in their names:

- births: id, parent (-1: of the initial model), x, y, z, and the spawn features of `candidates.FEATURES`
  (NaN for the initial model but for `time`, 0);
- deaths: id, time (in images), cause (`Cause`).

A Gaussian without a death is alive. At each checkpoint, births - deaths must equal the live population, in
number and in the sum of the hashes of all ids, or the run fails. A run that is resumed from a checkpoint
deletes the parts written after it.

An event only queues work on the device that makes its rows. Another thread copies the rows and writes them.
"""

from __future__ import annotations

import enum
import json
import re
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import hash_keys
from blitzgs.ops.host import current_stream
from blitzgs.spawn.candidates import FEATURES
from blitzgs.util.errors import optional_package
from blitzgs.util.output import PARTIAL, new_file, write_file

# File that describes the run: the capture's name and fingerprint, and the schedule.
ABOUT = "about.json"
PART_NAME = re.compile(r"(births|deaths)_(\d{8})_(\d{4})_(\d{4,})\.parquet")
# The columns of each table. Those of one dtype are the rows of one tensor [columns, M], a group.
TABLES: dict[str, tuple[tuple[str, ...], ...]] = {
    "births": (("id", "parent"), ("x", "y", "z", *FEATURES)),  # int64, float32
    "deaths": (("id",), ("time",), ("cause",)),  # int64, int32, uint8
}
_Columns = dict[str, np.ndarray[Any, Any]]
# Number of rows, some 60 bytes each, that are kept on the device before they become parts. The remaining rows
# are written at a checkpoint, which waits for them.
_MAX_PENDING = 1 << 17


class Cause(enum.IntEnum):
    """Why a Gaussian died."""

    OPACITY = 1  # too transparent at a density event
    SIZE = 2  # too large there, on screen or in the world
    SPLIT = 3  # replaced by its children
    PASS_1 = 4  # not drawn by the first importance pass
    PASS_2 = 5  # outside the mass that the second pass keeps
    LATE_OPACITY = 6  # within it, but too transparent
    RELOCATED = 7  # dead at a density event, where a copy of a live one took its place


class LineageError(RuntimeError):
    """Births and deaths do not add up to the live population."""


@dataclass(frozen=True)
class Births:
    """Gaussians born on this rank, M of them."""

    ids: Tensor  # int64 [M]
    parents: Tensor  # int64 [M]
    means: Tensor  # float32 [M, 3]
    features: Tensor  # float32 [M, F], features of the candidates


@dataclass(frozen=True)
class Ledger:
    """Totals of births and deaths so far, over all ranks; part of a checkpoint."""

    births: int = 0  # number of births
    deaths: int = 0  # number of deaths
    id_sum: int = 0  # sum of the hashed ids of births less that of deaths, modulo 2^64, as a signed integer
    # Number of parts that each rank has written, the largest of all ranks; 0 in old checkpoints.
    parts: int = 0


class Lineage:
    """Logs births and deaths of one rank."""

    def __init__(
        self, folder: Path, ranks: Ranks, step: int, ledger: Ledger, about: dict[str, Any] | None = None
    ) -> None:
        """Begin a log, or continue one from the checkpoint of `step` and `ledger`. Collective.

        The folder is that of all ranks' parts; those that were written after the checkpoint are deleted, and
        all if the ledger has no births. `about` describes the run, for the file `ABOUT`. ImportError: pyarrow
        is not installed.
        """
        self._writer = PartWriter(folder, ranks.device)
        self._folder, self._ranks, self.ledger = folder, ranks, ledger
        if ranks.rank == 0:
            folder.mkdir(parents=True, exist_ok=True)
            for path in list(folder.iterdir()):
                name = PART_NAME.fullmatch(path.name)
                if PARTIAL.fullmatch(path.name) or (name and _is_later(name, step, ledger)):
                    path.unlink()
            self.describe(about or {})
        ranks.barrier()
        # Changes since the ledger.
        self._counts = dict.fromkeys(TABLES, 0)
        self._id_sum = torch.zeros((), dtype=torch.int64, device=ranks.device)
        self._pending: dict[str, list[tuple[Tensor, ...]]] = {table: [] for table in TABLES}
        # The events that a stop kept from happening write parts of the checkpoint's step, beside those of the
        # events before the stop.
        self._rows, self._parts = 0, ledger.parts

    def describe(self, about: dict[str, Any]) -> None:
        """Write the description of the run to the file `ABOUT`; one rank calls this."""
        write_file(self._folder / ABOUT, json.dumps(about, indent=1) + "\n")

    def born(self, births: Births, step: int) -> None:
        """Log births at the end of an optimiser step."""
        floats = torch.cat((births.means.t(), births.features.t()))
        self._log("births", (torch.stack((births.ids, births.parents)), floats), step)

    def died(self, ids: Tensor, causes: Tensor, time: int, step: int) -> None:
        """Log deaths: ids, int64 [M], and values of `Cause` [M], which must not change any more."""
        times = torch.full_like(ids, time, dtype=torch.int32)
        self._log("deaths", (ids[None], times[None], causes.to(torch.uint8)[None]), step)

    def flush_and_check(self, ids: Tensor, step: int) -> Ledger:
        """Write pending rows, before a checkpoint, and check that births less deaths are the population.

        Returns the present ledger. LineageError, on every rank: births - deaths is not the live population.
        OSError, on every rank: one could not write a part; a later call tries that part again.
        """
        self.flush(step)
        failed = [(error.errno, str(error)) for error in self._writer.finish()]
        found = self._ranks.all_gather_object((failed, self._parts))
        problems = [problem for part, _ in found for problem in part]
        if problems:
            error = OSError(f"the lineage could not be written: {problems[0][1]}")
            error.errno = problems[0][0]
            raise error
        self._parts = max(parts for _, parts in found)
        device = self._id_sum.device
        counts = torch.tensor([*self._counts.values(), len(ids)], device=device)
        hashes = torch.stack((self._id_sum, hash_keys(ids).sum().to(device)))
        births, deaths, live, change, id_sum = self._ranks.all_reduce(torch.cat((counts, hashes))).tolist()
        self._counts = dict.fromkeys(TABLES, 0)
        self._id_sum.zero_()
        ledger = Ledger(
            self.ledger.births + births,
            self.ledger.deaths + deaths,
            (self.ledger.id_sum + change + (1 << 63)) % (1 << 64) - (1 << 63),  # as int64 wraps around
            self._parts,
        )
        if ledger.births - ledger.deaths != live or ledger.id_sum != id_sum:
            same = " (their numbers agree, their ids do not)" if ledger.births - ledger.deaths == live else ""
            raise LineageError(
                f"lineage: {ledger.births:,} births less {ledger.deaths:,} deaths is not the live population "
                f"of {live:,} Gaussians{same}; the log in {self._folder} is "
                "not to be trusted. Please report this; population.lineage=false trains without it."
            )
        self.ledger = ledger
        return ledger

    def close(self) -> None:
        """Stop writing; rows since the last `flush_and_check` are lost, as is the training since then."""
        self._writer.close()

    def flush(self, step: int) -> None:
        """Let another thread write the pending rows."""
        for table, blocks in self._pending.items():
            if not blocks:
                continue
            groups = [torch.cat(parts, 1) for parts in zip(*blocks, strict=True)]
            blocks.clear()
            # Not at each event: hashes take many small kernels.
            ids, sign = groups[0][0], 1 if table == "births" else -1
            self._counts[table] += len(ids)
            self._id_sum += sign * hash_keys(ids).sum()
            name = f"{table}_{step:08d}_{self._ranks.rank:04d}_{self._parts:04d}.parquet"
            self._parts += 1
            self._writer.add(name, table, groups)
        self._rows = 0

    def _log(self, table: str, groups: tuple[Tensor, ...], step: int) -> None:
        self._pending[table].append(groups)
        self._rows += groups[0].shape[1]
        if self._rows > _MAX_PENDING:
            self.flush(step)


def initial_births(ids: Tensor, parents: Tensor, means: Tensor) -> Births:
    """Return the births of a model's first Gaussians, whose features are NaN."""
    features = torch.full((len(ids), len(FEATURES)), torch.nan, device=ids.device)
    features[:, FEATURES.index("time")] = 0
    return Births(ids, parents, means, features)


def _is_later(name: re.Match[str], step: int, ledger: Ledger) -> bool:
    """Tell whether a part was written after the checkpoint of `step` that has this ledger."""
    its_step, number = int(name[2]), int(name[4])
    if ledger.births == 0 or its_step > step:
        return True
    return its_step == step and 0 < ledger.parts <= number


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
            remedy = "train with --population.lineage=true to log it"
            raise FileNotFoundError(f"{folder} holds no lineage: {remedy}")
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
