# SPDX-License-Identifier: Apache-2.0
"""Packing: rows of columns of any dtype as one buffer of words for an exchange, and gradients added up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def pack_rows(columns: Sequence[Tensor], rows: Tensor) -> Tensor:
    """Gather rows of several columns into one buffer.

    Args:
        columns: [P, ...] each, of any dtype of 2, 4 or 8 bytes; at most 16. Rows of an odd number of 2-byte
            elements are padded to whole words.
        rows: int32 [S] in [0, P) (not checked).

    Returns:
        int32 [S, W], the rows' bytes as words, column after column.

    Raises:
        RuntimeError: columns of different lengths, or too many.
    """
    return torch.ops.blitzgs.pack_rows([_words(column) for column in columns], rows)


def unpack_rows(packed: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Undo `pack_rows`.

    Args:
        packed: int32 [S, W].
        like: the columns that were packed, or others of their dtypes and row shapes.

    Returns:
        Columns [S, ...] with the dtypes and row shapes of `like`.

    Raises:
        RuntimeError: W is not what `like` needs.
    """
    widths = [-(-_row_size(column) * column.element_size() // 4) for column in like]
    parts = torch.ops.blitzgs.unpack_rows(packed, widths)
    return [
        part.view(column.dtype)[:, : _row_size(column)].reshape(-1, *column.shape[1:])
        for part, column in zip(parts, like, strict=True)
    ]


def add_rows(values: Tensor, rows: Tensor, rows_per_rank: Sequence[int], n_rows: int) -> Tensor:
    """Add up values that came back in groups, one per rank, in the order of the groups.

    Args:
        values: [S, F], float32 (CPU also float64).
        rows: int32 [S] in [0, n_rows) (not checked); no row occurs twice in a group.
        rows_per_rank: sizes of the groups.
        n_rows: P.

    Returns:
        [P, F]; zero for rows that occur nowhere. Deterministic.

    Raises:
        RuntimeError: wrong shapes or dtypes, or groups that do not add up to S.
    """
    return torch.ops.blitzgs.add_rows(values, rows, list(rows_per_rank), n_rows)


def _row_size(column: Tensor) -> int:
    return math.prod(column.shape[1:])


def _words(column: Tensor) -> Tensor:
    """View a column [P, ...] as int32 [P, words]."""
    flat = column.reshape(len(column), _row_size(column))
    if flat.element_size() == 2 and flat.shape[1] % 2:
        flat = torch.nn.functional.pad(flat, (0, 1))
    if flat.stride(0) != flat.shape[1]:
        # Stricter than `contiguous`, as viewing dtypes is: even a single row needs its own stride.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.int32)


@torch.library.register_fake("blitzgs::pack_rows")
def _(columns: Sequence[Tensor], rows: Tensor) -> Tensor:
    return rows.new_empty((rows.shape[0], sum(column.shape[1] for column in columns)))


@torch.library.register_fake("blitzgs::unpack_rows")
def _(packed: Tensor, widths: Sequence[int]) -> list[Tensor]:
    return [packed.new_empty((packed.shape[0], width)) for width in widths]


@torch.library.register_fake("blitzgs::add_rows")
def _(values: Tensor, rows: Tensor, rows_per_rank: Sequence[int], n_rows: int) -> Tensor:
    return values.new_empty((n_rows, values.shape[1]))
