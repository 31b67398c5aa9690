# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of one rank: a table of columns whose rows are added, removed and moved together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.blocks import (
    BLOCK_ROWS,
    SECTOR_WORDS,
    WORD_BITS,
    put_rows_,
    rows_of_sectors,
    sectors_of_rows,
    take_rows,
)

# A column that has to be moved to become longer gets memory for this many times its rows.
GROWTH = 1.25
# The same for a shard that has more rows than its share of the most.
_PAST_MOST = 1.02
# The learned parameters, before activation: log scales, opacity logits, unnormalised quaternions.
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")
EXP_AVGS = tuple(f"exp_avg.{name}" for name in PARAMETERS)
EXP_AVG_SQS = tuple(f"exp_avg_sq.{name}" for name in PARAMETERS)
# What new rows have in a column: values that the caller gives, or zeros. For columns that are added to a
# table later, the caller gives the values of the parents (`inherited`).
REQUIRED = (*PARAMETERS, "last_step", "id", "parent", "birth", "level")
ZERO_AT_BIRTH = (*EXP_AVGS, *EXP_AVG_SQS, "moment_step", "grad_sum", "grad_count", "max_radii")
# A step asks for these columns several times; one call finds all of a group.
_PARAMETERS_OF, _EXP_AVGS_OF, _EXP_AVG_SQS_OF = (
    itemgetter(*names) for names in (PARAMETERS, EXP_AVGS, EXP_AVG_SQS)
)
NO_PARENT = -1
# The cull matrix, from the first importance pass on: which views leave a row out, bits [N, words]. It is
# stored by blocks of rows (`blitzgs.ops.blocks.sectors_of_rows`), as kernels read it; all others row by row.
CULL = "cull"


@dataclass(frozen=True)
class Column:
    """The dtype of a column and the shape of one of its rows."""

    dtype: torch.dtype
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Bytes of one row."""
        return self.dtype.itemsize * math.prod(self.shape)

    def zeros(self, count: int, device: torch.device) -> Tensor:
        """Return zeros for so many rows, [count, ...]."""
        return torch.zeros((count, *self.shape), dtype=self.dtype, device=device)


class Placement(NamedTuple):
    """Which row of a table each new Gaussian gets, and which others move."""

    total: int  # number of rows afterwards
    new: Tensor  # int64 [M], the row of each new Gaussian
    moved_from: Tensor  # int64 [K], rows that move because the table becomes shorter
    moved_to: Tensor  # int64 [K], where they move


def schema(sh_degree: int) -> dict[str, Column]:
    """Return the columns of a table, in their order; `sh_degree`: the highest, of (D + 1)^2 coefficients."""
    f, i = torch.float32, torch.int32
    # Scales are logarithms, opacities logits.
    rows = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": ((sh_degree + 1) ** 2, 3)}
    columns = {name: Column(f, shape) for name, shape in rows.items()}
    for prefix in ("exp_avg", "exp_avg_sq"):  # Adam's moments
        columns |= {f"{prefix}.{name}": Column(f, shape) for name, shape in rows.items()}
    scalars = {
        "last_step": i,  # optimiser step up to which the row's parameters are current
        "moment_step": i,  # the same of its moments
        "id": torch.int64,  # persistent, unique over ranks
        "parent": torch.int64,  # an id; -1: none
        "birth": i,  # images seen when it was born
        "level": torch.uint8,  # octree level
        "grad_sum": f,  # this and the next two: statistics since the last density event
        "grad_count": i,
        "max_radii": f,  # pixels
    }
    return columns | {name: Column(dtype, ()) for name, dtype in scalars.items()}


def opacity_logit(opacity: float) -> float:
    """Return the value of the column `opacities` for an opacity in [0, 1); -inf for 0."""
    return math.log(opacity / (1.0 - opacity)) if opacity > 0 else -math.inf


def as_stored(name: str, column: Tensor) -> Tensor:
    """Return a column [N, ...] as `GaussianTable.columns` stores it: unchanged, or `CULL` by blocks."""
    return sectors_of_rows(column).view(-1, column.shape[1]) if name == CULL else column


def sectors_in(stored: Tensor) -> Tensor:
    """View the stored form of `CULL` as the kernels take it, int32 [ceil(N / 256), columns, 8]."""
    return stored.view(-1, WORD_BITS * stored.shape[1], SECTOR_WORDS)


def stored_rows(name: str, count: int) -> int:
    """Return the length of the stored form of a column with `count` rows."""
    return -(-count // BLOCK_ROWS) * BLOCK_ROWS if name == CULL else count


class GaussianTable:
    """One rank's Gaussians as named columns of equal length N.

    Operations act on all columns, one column at a time, so that peak memory exceeds the table by one column
    and not by a second table. `replace` touches only the rows that change; for that, columns that grow have
    memory for more rows than they hold. The column `CULL` is converted whenever it is set, read or moved.
    """

    def __init__(self, columns: Mapping[str, Tensor]) -> None:
        """Take over the given columns.

        `columns`: name -> tensor [N, ...]; at least those of `schema`, all on one device. ValueError: a
        column is missing, or its length, row shape, dtype or device does not fit.
        """
        if "sh" not in columns:
            raise ValueError(f"GaussianTable: column 'sh' is missing; got {sorted(columns)}")
        sh = columns["sh"]
        degree = round(sh.shape[1] ** 0.5) - 1 if sh.dim() == 3 else -1
        expected = schema(max(degree, 0))
        if missing := [name for name in expected if name not in columns]:
            raise ValueError(f"GaussianTable: columns {missing} are missing; got {sorted(columns)}")
        for name, tensor in columns.items():
            column = expected.get(name, Column(tensor.dtype, tuple(tensor.shape[1:])))
            wanted = (sh.shape[0], *column.shape)
            if tuple(tensor.shape) != wanted or tensor.dtype != column.dtype or tensor.device != sh.device:
                raise ValueError(
                    f"GaussianTable: column '{name}' must be {column.dtype} {list(wanted)} on {sh.device}, "
                    f"got {tensor.dtype} {list(tensor.shape)} on {tensor.device}"
                )
        # The columns by name, `CULL` in its stored form.
        self.columns: dict[str, Tensor] = {name: as_stored(name, column) for name, column in columns.items()}
        # The memory of columns that have more of it than rows; they are its first rows.
        self._memory: dict[str, Tensor] = {}

    @classmethod
    def create(cls, rows: Mapping[str, Tensor]) -> GaussianTable:
        """Build a table from copies of rows: `PARAMETERS`, and other columns of `schema`.

        Columns that are absent are those of first Gaussians: at step 0, with the ids 0 .. N - 1, without
        parents, born at time 0, at level 0, and zeros. ValueError: as the constructor; a parameter is
        missing, or a column is unknown.
        """
        expected = schema(round(rows["sh"].shape[1] ** 0.5) - 1)
        if missing := [name for name in PARAMETERS if name not in rows]:
            raise ValueError(f"GaussianTable: new rows lack the columns {missing}")
        if unknown := [name for name in rows if name not in expected]:
            raise ValueError(f"GaussianTable: the table has no columns {unknown}")
        count, device = len(rows["means"]), rows["means"].device
        columns = {
            name: rows[name].clone() if name in rows else column.zeros(count, device)
            for name, column in expected.items()
        }
        if "id" not in rows:
            columns["id"] = torch.arange(count, device=device)
        if "parent" not in rows:
            columns["parent"].fill_(NO_PARENT)
        return cls(columns)

    @classmethod
    def of_parameters(cls, columns: Mapping[str, Tensor]) -> GaussianTable:
        """Build a table for rendering from `PARAMETERS`, "level" and "id"; other columns take no memory."""
        sh = columns["sh"]
        count, known = len(sh), dict(columns)
        if "id" not in known:
            known["id"] = torch.arange(count, device=sh.device)
        for name, column in schema(round(sh.shape[1] ** 0.5) - 1).items():
            if name not in known:
                known[name] = sh.new_zeros((), dtype=column.dtype).expand(count, *column.shape)
        return cls(known)

    def __len__(self) -> int:
        return int(self.columns["means"].shape[0])

    def __getitem__(self, name: str) -> Tensor:
        column = self.columns[name]
        return rows_of_sectors(sectors_in(column), len(self)) if name == CULL else column

    def __delitem__(self, name: str) -> None:
        """Drop a column and free its memory."""
        del self.columns[name]
        self._memory.pop(name, None)

    def __setitem__(self, name: str, tensor: Tensor) -> None:
        """Replace or add a column of the table's length; it moves with the others from then on."""
        if tensor.shape[:1] != (len(self),):
            raise ValueError(
                f"GaussianTable: column '{name}' must have {len(self)} rows, got {list(tensor.shape)}"
            )
        self._store(name, tensor)

    def _store(self, name: str, tensor: Tensor) -> None:
        """Store a tensor as the column `name`; all operations store their new columns through this method."""
        self._store_raw(name, as_stored(name, tensor))

    def _to_change(self) -> list[str]:
        """Return the columns in the order in which they change: `CULL` while others tell N."""
        return sorted(self, key=lambda name: name != CULL)

    def release(self) -> dict[str, Tensor]:
        """Return all columns, [N, ...], and leave the table without any."""
        columns = {name: self[name] for name in self}
        self.columns, self._memory = {}, {}
        return columns

    def _store_raw(self, name: str, stored: Tensor) -> None:
        """Store a column that already has its stored form."""
        self.columns[name] = stored
        self._memory.pop(name, None)

    def _allocate(self, like: Tensor, rows: int) -> Tensor:
        return like.new_empty((rows, *like.shape[1:]))

    def _lengthen(self, name: str, count: int, most: int | None) -> Tensor:
        """Return a column of `count` rows that begins with the present ones, as many as fit.

        `CULL` is returned row by row, and has to be stored.
        """
        if name == CULL:
            old = self[name]
            return torch.cat((old, old.new_empty((max(0, count - len(old)), *old.shape[1:]))))
        old = self.columns[name]
        if len(old) == count:
            return old
        memory = self._memory.get(name, old)
        if len(memory) < count:
            room = int(GROWTH * count)
            if most is not None:
                room = min(room, max(most, int(_PAST_MOST * count)))
            memory = self._allocate(old, room)
            memory[: len(old)].copy_(old)
            self._memory[name], self.columns[name] = memory, memory[: len(old)]
        return memory[: max(count, len(old))]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def row_of(self, name: str) -> Column:
        """Return the dtype and the row shape of a column."""
        column = self.columns[name]
        return Column(column.dtype, tuple(column.shape[1:]))

    @property
    def row_bytes(self) -> dict[str, int]:
        """Bytes of one row, by column."""
        return {name: self.row_of(name).bytes for name in self}

    @property
    def memory_bytes(self) -> int:
        """Bytes of the memory of all columns, with that for rows to come."""
        return sum(column.untyped_storage().nbytes() for column in self.columns.values())

    @property
    def device(self) -> torch.device:
        """Device of the columns."""
        return self.columns["means"].device

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The five learned columns in the order of `PARAMETERS`."""
        return _PARAMETERS_OF(self.columns)

    @property
    def exp_avgs(self) -> tuple[Tensor, ...]:
        """Adam's first moments in the order of `PARAMETERS`."""
        return _EXP_AVGS_OF(self.columns)

    @property
    def exp_avg_sqs(self) -> tuple[Tensor, ...]:
        """Adam's second moments in the order of `PARAMETERS`."""
        return _EXP_AVG_SQS_OF(self.columns)

    def _check_new(self, rows: Mapping[str, Tensor]) -> None:
        """Check rows that are to be added."""
        if missing := [name for name in self if name not in rows and name not in ZERO_AT_BIRTH]:
            raise ValueError(f"GaussianTable: new rows lack the columns {missing}")
        if unknown := [name for name in rows if name not in self]:
            raise ValueError(f"GaussianTable: the table has no columns {unknown}")
        count = int(rows["means"].shape[0])
        for name, new in rows.items():
            column = self.row_of(name)
            wanted = (count, *column.shape)
            if tuple(new.shape) != wanted or new.dtype != column.dtype:
                raise ValueError(
                    f"GaussianTable: column '{name}' of new rows must be {column.dtype} {list(wanted)}, "
                    f"got {new.dtype} {list(new.shape)}"
                )

    def inherited(self, parents: Tensor) -> dict[str, Tensor]:
        """Return the columns that new rows inherit from their parents, the rows `parents` (int64 [M])."""
        added = [name for name in self if name not in REQUIRED and name not in ZERO_AT_BIRTH]
        return {name: self[name].index_select(0, parents) for name in added}

    def keep(self, mask: Tensor) -> None:
        """Keep the rows where `mask` (bool [N]) is true, in their order."""
        if mask.dtype != torch.bool or mask.shape != (len(self),):
            raise ValueError(
                f"GaussianTable.keep: mask must be bool [{len(self)}], got {mask.dtype} {list(mask.shape)}"
            )
        rows = mask.nonzero().squeeze(1)
        for name in self._to_change():
            self._store(name, *take_rows([self[name]], rows))

    def permute(self, order: Tensor) -> None:
        """Reorder the rows: row i becomes the old row `order[i]` (int64 [N], a permutation)."""
        if order.dtype != torch.int64 or order.shape != (len(self),):
            raise ValueError(
                f"GaussianTable.permute: order must be int64 [{len(self)}], "
                f"got {order.dtype} {list(order.shape)}"
            )
        for name in self._to_change():
            self._reorder(name, order)

    def _reorder(self, name: str, order: Tensor) -> None:
        """Permute a column, which keeps the room that it has for more rows, as far as `GROWTH` gives it."""
        old = self.columns[name]
        room = min(len(self._memory.get(name, old)), int(GROWTH * len(old)))
        if name == CULL or room == len(old):
            self._store(name, *take_rows([self[name]], order))
        else:
            memory = self._allocate(old, room)
            take_rows([old], order, [memory[: len(old)]])
            self._memory[name], self.columns[name] = memory, memory[: len(old)]

    def replace(self, placement: Placement, new: Mapping[str, Tensor], most: int | None = None) -> None:
        """Let rows leave and new ones join; all other rows stay where they are, except those that move.

        `placement`: of `blitzgs.table.placement.place`. `new`: name -> tensor [M, ...] of every column; those
        of `ZERO_AT_BIRTH` may be absent. `most`: about the most rows that the table will ever have; None:
        unknown. ValueError: a column is missing, an unknown one is given, or shapes or dtypes differ.
        """
        self._check_new(new)
        columns = {name: self._lengthen(name, placement.total, most) for name in self._to_change()}
        if len(placement.moved_from) > 0:
            every = list(columns.values())
            put_rows_(every, placement.moved_to, take_rows(every, placement.moved_from))
        put_rows_([columns[name] for name in new], placement.new, list(new.values()))
        put_rows_([column for name, column in columns.items() if name not in new], placement.new)
        for name, column in columns.items():
            if name == CULL:
                self._store(name, column[: placement.total])
            elif placement.total != len(self.columns[name]):
                self._memory.setdefault(name, column)
                self.columns[name] = column[: placement.total]

    def move_rows(self, destination_ranks: Tensor, ranks: Ranks) -> None:
        """Move each row to a rank, int64 [N]. Collective. Rows arrive ordered by source rank."""
        order = torch.argsort(destination_ranks, stable=True)
        counts = torch.bincount(destination_ranks, minlength=ranks.world_size)
        sent = counts.tolist()
        received = ranks.exchange_counts(counts).tolist()
        for name in self._to_change():
            (moved,) = take_rows([self[name]], order)
            del self[name]
            self._store(name, ranks.all_to_all(moved, sent, received))
