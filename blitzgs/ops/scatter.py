# SPDX-License-Identifier: Apache-2.0
"""Rows of columns of any dtype to several ranks, and sums of what comes back."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# Rows that share an entry of `places`, see csrc/scatter/scatter.h.
RUN = 32


def scatter_rows(
    columns: Sequence[Tensor], masks: Tensor, group_sizes: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Copy rows into one group per rank.

    Args:
        columns: [P, ...] each, of any dtype of 2, 4 or 8 bytes; at most 8. Rows of an odd number of 2-byte
            elements are padded to whole words.
        masks: int64 [P]; bit m sends a row to rank m.
        group_sizes: rows for each of the M ranks, as the masks have them.

    Returns:
        packed int32 [words]: one group after the other, in each the columns one after the other; and places
        int64 [ceil(P / RUN), M], where in each group the rows are: what `sum_rows` needs. The order of the
        rows of a run is kept; on CUDA that of runs is not.

    Raises:
        RuntimeError: columns of different lengths, or too many.
    """
    packed, places = torch.ops.blitzgs.scatter_rows([words_of(c) for c in columns], masks, list(group_sizes))
    return packed, places


def gather_rows(packed: Tensor, like: Sequence[Tensor], group_sizes: Sequence[int]) -> list[Tensor]:
    """Take groups apart that `scatter_rows` put together.

    Args:
        packed: int32 [words], groups one after the other.
        like: the columns that were scattered, or others of their dtypes and row shapes.
        group_sizes: rows of each group.

    Returns:
        Columns [sum(group_sizes), ...] with the dtypes and row shapes of `like`.

    Raises:
        RuntimeError: the number of words is not what `like` needs.
    """
    widths = [words_per_row(column) for column in like]
    parts = torch.ops.blitzgs.gather_rows(packed, widths, list(group_sizes))
    return [as_column(part, column) for part, column in zip(parts, like, strict=True)]


def sum_rows(
    values: Tensor, places: Tensor, group_sizes: Sequence[int], rows: int, widths: Sequence[int]
) -> list[Tensor]:
    """Add up what came back for each row, in the order of ranks.

    Args:
        values: [sum(group_sizes), F], float32 (CPU also float64): rows where `scatter_rows` put them.
        places: from `scatter_rows`.
        group_sizes: as for `scatter_rows`.
        rows: P.
        widths: of the columns that the F values are; they add up to F.

    Returns:
        [P, width] each; zero for rows that went nowhere. Deterministic.

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    return torch.ops.blitzgs.sum_rows(values, places, list(group_sizes), rows, list(widths))


def runs_of(rows: int) -> int:
    """Entries of `places` for each rank."""
    return -(-rows // RUN)


def words_per_row(column: Tensor) -> int:
    """32-bit words that a row of a column takes."""
    return -(-math.prod(column.shape[1:]) * column.element_size() // 4)


def words_of(column: Tensor) -> Tensor:
    """View a column [P, ...] as int32 [P, words]."""
    flat = column.reshape(len(column), math.prod(column.shape[1:]))
    if flat.element_size() == 2 and flat.shape[1] % 2:
        flat = torch.nn.functional.pad(flat, (0, 1))
    if flat.stride() != (flat.shape[1], 1):
        # Stricter than `contiguous`, as viewing dtypes is: even a single row needs its own stride.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.int32)


def as_column(words: Tensor, like: Tensor) -> Tensor:
    """Undo `words_of`: int32 [R, words] as [R, ...] with the dtype and row shape of `like`."""
    values = words.view(like.dtype)[:, : math.prod(like.shape[1:])]
    return values.reshape(-1, *like.shape[1:])


@torch.library.register_fake("blitzgs::scatter_rows")
def _(columns: Sequence[Tensor], masks: Tensor, group_sizes: Sequence[int]) -> tuple[Tensor, Tensor]:
    words = sum(column.shape[1] for column in columns) * sum(group_sizes)
    runs = runs_of(masks.shape[0])
    packed = masks.new_empty(words, dtype=torch.int32)
    return packed, masks.new_empty((runs, len(group_sizes)))


@torch.library.register_fake("blitzgs::gather_rows")
def _(packed: Tensor, widths: Sequence[int], group_sizes: Sequence[int]) -> list[Tensor]:
    return [packed.new_empty((sum(group_sizes), width)) for width in widths]


@torch.library.register_fake("blitzgs::sum_rows")
def _(
    values: Tensor,
    places: Tensor,
    group_sizes: Sequence[int],
    rows: int,
    widths: Sequence[int],
) -> list[Tensor]:
    return [values.new_empty((rows, width)) for width in widths]
