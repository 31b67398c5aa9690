# SPDX-License-Identifier: Apache-2.0
"""Lineage: every birth and death of a Gaussian, logged as Parquet and reconciled with the live population.

Each rank writes parts of two tables into one folder, which hold what happened up to the optimiser step in
their names:

- births: id, parent (-1: of the initial model), x, y, z, and the spawn features of `candidates.FEATURES`
  (NaN for the initial model but for `time`, 0);
- deaths: id, time (in images), cause (`Cause`).

A Gaussian without a death is alive. At each checkpoint, births - deaths must equal the live population, in
number and in the sum of the hashes of all ids, or the run fails. A run that is resumed from a checkpoint
deletes the parts written after it.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import re
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import hash_keys
from blitzgs.output import new_file, write_file
from blitzgs.population.candidates import FEATURES

# File that describes the run: the capture's name and fingerprint, and the schedule.
ABOUT = "about.json"
_PART = re.compile(r"(births|deaths)_(\d{8})_(\d{4})_(\d{4})\.parquet")
# Number of rows, some 60 bytes each, that are kept in device memory before a thread writes them during
# training. The remaining rows are written at a checkpoint, which waits for them.
_MOST_PENDING = 1 << 17
# The columns of each table, in order: those that are kept as int64, with their types in the log, and those of
# float32.
_INTS: dict[str, dict[str, torch.dtype]] = {
    "births": {"id": torch.int64, "parent": torch.int64},
    "deaths": {"id": torch.int64, "time": torch.int32, "cause": torch.uint8},
}
_FLOATS: dict[str, tuple[str, ...]] = {"births": ("x", "y", "z", *FEATURES), "deaths": ()}


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
    """Gaussians born on this rank, M of them.

    Attributes:
        ids: int64 [M].
        parents: int64 [M].
        means: float32 [M, 3].
        features: float32 [M, F], features of the candidates.
    """

    ids: Tensor
    parents: Tensor
    means: Tensor
    features: Tensor


@dataclass(frozen=True)
class Ledger:
    """Totals of births and deaths so far, over all ranks; part of a checkpoint.

    Attributes:
        births: number of births.
        deaths: number of deaths.
        id_sum: sum of the hashed ids of births less that of deaths, modulo 2^64, as a signed integer.
    """

    births: int = 0
    deaths: int = 0
    id_sum: int = 0


class Lineage:
    """Logs births and deaths of one rank."""

    def __init__(
        self, folder: Path, ranks: Ranks, step: int, ledger: Ledger, about: dict[str, Any] | None = None
    ) -> None:
        """Begin a log, or continue one from a checkpoint. Collective.

        Args:
            folder: folder of the parts of all ranks, made if missing.
            ranks: the job.
            step: optimiser step of the checkpoint; parts of later steps are deleted. 0: all parts are.
            ledger: ledger of the checkpoint.
            about: description of the run, for the file `ABOUT`.

        Raises:
            ImportError: pyarrow is not installed.
        """
        self._parquet = import_pyarrow()
        self._folder, self._ranks, self.ledger = folder, ranks, ledger
        if ranks.rank == 0:
            folder.mkdir(parents=True, exist_ok=True)
            for path in list(folder.iterdir()):
                name = _PART.fullmatch(path.name)
                if path.name.startswith(".") or (name and (step == 0 or int(name[2]) > step)):
                    path.unlink()
            self.describe(about or {})
        ranks.barrier()
        self._sums = torch.zeros(3, dtype=torch.int64, device=ranks.device)
        self._pending: dict[str, list[_Block]] = {name: [] for name in _INTS}
        self._rows, self._parts = 0, 0
        self._writer = ThreadPoolExecutor(1, "lineage")
        self._writing: list[Future[None]] = []
        self._unwritten: list[tuple[str, dict[str, Tensor], OSError]] = []

    def describe(self, about: dict[str, Any]) -> None:
        """Write the description of the run to the file `ABOUT`; one rank calls this."""
        write_file(self._folder / ABOUT, json.dumps(about, indent=1) + "\n")

    def born(self, births: Births, step: int) -> None:
        """Log births at the end of an optimiser step."""
        self._count(births.ids, births=True)
        floats = torch.cat((births.means, births.features), 1)
        self._log("births", (births.ids, births.parents), floats, step)

    def died(self, ids: Tensor, causes: Tensor, time: int, step: int) -> None:
        """Log deaths.

        Args:
            ids: int64 [M].
            causes: [M], values of `Cause`.
            time: time of the event, in images.
            step: optimiser step.
        """
        self._count(ids, births=False)
        columns = ids, torch.full_like(ids, time), causes.long()
        self._log("deaths", columns, torch.empty(len(ids), 0, device=ids.device), step)

    def flush_and_check(self, ids: Tensor, step: int) -> Ledger:
        """Write all pending rows and check that births - deaths is the population. Collective.

        Call this before a checkpoint is written.

        Args:
            ids: int64 [N], ids of this rank's live Gaussians.
            step: optimiser step.

        Returns:
            The present ledger.

        Raises:
            LineageError: on every rank, when births - deaths is not the live population.
            OSError: on every rank, when one could not write a part; a later call tries that part again.
        """
        self.flush(step)
        self._wait()
        unwritten, self._unwritten = self._unwritten, []
        for name, columns, _ in unwritten:
            self._write(name, columns)
        texts = [str(error) for _, _, error in self._unwritten]
        problems = [text for part in self._ranks.all_gather_object(texts) for text in part]
        if problems:
            raise OSError(f"the lineage could not be written: {problems[0]}")
        live = torch.stack((torch.tensor(len(ids), device=ids.device), hash_keys(ids).sum()))
        totals = self._ranks.all_reduce(torch.cat((self._sums, live.to(self._sums.device)))).tolist()
        self._sums.zero_()
        ledger = Ledger(
            self.ledger.births + totals[0],
            self.ledger.deaths + totals[1],
            _wrapped(self.ledger.id_sum + totals[2]),
        )
        if ledger.births - ledger.deaths != totals[3] or ledger.id_sum != totals[4]:
            raise LineageError(
                f"lineage: {ledger.births:,} births less {ledger.deaths:,} deaths is not the live population "
                f"of {totals[3]:,} Gaussians{_same_number(ledger, totals[3])}; the log in {self._folder} is "
                "not to be trusted. Please report this; population.lineage=false trains without it."
            )
        self.ledger = ledger
        return ledger

    def _wait(self) -> None:
        for writing in self._writing:
            writing.result()
        self._writing.clear()

    def close(self) -> None:
        """Stop writing; rows since the last `flush_and_check` are lost, as is the training since then."""
        self._writer.shutdown(wait=True, cancel_futures=True)

    def _count(self, ids: Tensor, births: bool) -> None:
        sign = 1 if births else -1
        self._sums[0 if births else 1] += len(ids)
        self._sums[2] += sign * hash_keys(ids).sum()

    def _log(self, table: str, ints: tuple[Tensor, ...], floats: Tensor, step: int) -> None:
        # Keep copies on the device, so that the host waits once for many rows and not at every event.
        self._pending[table].append(_Block(torch.stack(ints, 1), floats))
        self._rows += len(floats)
        if self._rows > _MOST_PENDING:
            self.flush(step)

    def flush(self, step: int) -> None:
        """Let another thread write the pending rows."""
        for table, blocks in self._pending.items():
            if not blocks:
                continue
            name = f"{table}_{step:08d}_{self._ranks.rank:04d}_{self._parts:04d}.parquet"
            self._parts += 1
            self._writing.append(self._writer.submit(self._write, name, _columns(table, blocks)))
            blocks.clear()
        self._rows = 0

    def _write(self, name: str, columns: dict[str, Tensor]) -> None:
        arrow, parquet = self._parquet
        try:
            # The file must be on disk when `flush_and_check` returns, because the checkpoint refers to it.
            with new_file(self._folder / name) as partial:
                table = arrow.table({key: column.numpy() for key, column in columns.items()})
                # Ids and floats hardly repeat, so a dictionary would take time and save nothing.
                parquet.write_table(table, partial, compression="zstd", use_dictionary=False)
        except OSError as error:
            self._unwritten.append((name, columns, error))


class _Block(NamedTuple):
    """Rows of a table: int64 [M, ...] and float32 [M, ...], see `_INTS` and `_FLOATS`."""

    ints: Tensor
    floats: Tensor


def _columns(table: str, blocks: list[_Block]) -> dict[str, Tensor]:
    """Copy rows to the CPU and return them as the columns of the log."""
    ints = torch.cat([block.ints for block in blocks]).t().contiguous().cpu()
    floats = torch.cat([block.floats for block in blocks]).t().contiguous().cpu()
    typed = {name: column.to(dtype) for (name, dtype), column in zip(_INTS[table].items(), ints, strict=True)}
    return typed | dict(zip(_FLOATS[table], floats, strict=True))


def read_lineage(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the log of a run.

    Args:
        folder: that of the parts.

    Returns:
        {"births": columns, "deaths": columns}, numpy arrays by name.

    Raises:
        FileNotFoundError: there is no log.
        ImportError: pyarrow is not installed.
    """
    arrow, parquet = import_pyarrow()
    tables = {}
    for table in ("births", "deaths"):
        paths = sorted(path for path in folder.glob(f"{table}_*.parquet") if _PART.fullmatch(path.name))
        if not paths and table == "births":
            raise FileNotFoundError(
                f"{folder} holds no lineage: train with --population.lineage=true to log it"
            )
        parts = [parquet.read_table(path) for path in paths]
        if parts:
            joined = arrow.concat_tables(parts)
            tables[table] = {name: joined[name].to_numpy() for name in joined.column_names}
        else:
            tables[table] = {
                name: torch.empty(0, dtype=torch.int64).numpy() for name in ("id", "time", "cause")
            }
    return tables


def initial_births(ids: Tensor, parents: Tensor, means: Tensor) -> Births:
    """Return the births of a model's first Gaussians, whose features are NaN."""
    features = torch.full((len(ids), len(FEATURES)), torch.nan, device=ids.device)
    features[:, FEATURES.index("time")] = 0
    return Births(ids, parents, means, features)


def ledger_of(state: dict[str, int] | None) -> Ledger:
    """Read a ledger back from a checkpoint."""
    return Ledger(**(state or {}))


def ledger_state(ledger: Ledger) -> dict[str, int]:
    """Return a ledger for a checkpoint."""
    return dataclasses.asdict(ledger)


def _wrapped(value: int) -> int:
    """Return an integer modulo 2^64, as a signed integer."""
    return (value + (1 << 63)) % (1 << 64) - (1 << 63)


def _same_number(ledger: Ledger, live: int) -> str:
    return " (their numbers agree, their ids do not)" if ledger.births - ledger.deaths == live else ""


def import_pyarrow() -> tuple[ModuleType, ModuleType]:
    """Return pyarrow and pyarrow.parquet; raise ImportError with the remedy if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("lineage is logged as Parquet: install pyarrow (pip install pyarrow)") from error
    return pyarrow, pyarrow.parquet
