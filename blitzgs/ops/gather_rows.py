# SPDX-License-Identifier: Apache-2.0
"""Gathers the same rows of several columns in one launch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@torch.no_grad()
def gather_rows(columns: Sequence[Tensor], joined: Sequence[Tensor], ids: Tensor) -> list[Tensor]:
    """Return rows of columns as `index_select` does, and rows of further columns side by side.

    Args:
        columns: [N, ...] each, any dtypes of 4 or 8 bytes.
        joined: [N, L, ...] each, of one dtype and alike behind their second dimension; none or more. At most
            8 columns together with `columns`.
        ids: int32 [U], rows from 0 to N - 1; not checked.

    Returns:
        [U, ...] for each of `columns`; then, if there are `joined`, one tensor [U, sum of L, ...].

    Raises:
        RuntimeError: shapes or dtypes do not fit.
    """
    found: list[Tensor] = torch.ops.blitzgs.gather_rows(columns, joined, ids)
    return found


def split_rows(rows: Tensor, lengths: Sequence[int]) -> list[Tensor]:
    """Return the parts of rows [U, K, ...] along their second dimension, each in memory of its own.

    Args:
        rows: elements of 4 or 8 bytes.
        lengths: of at most 8 parts; their sum is K.

    Raises:
        RuntimeError: the lengths do not fit.
    """
    parts: list[Tensor] = torch.ops.blitzgs.split_rows(rows, lengths)
    return parts


@torch.library.register_fake("blitzgs::split_rows")
def _(rows: Tensor, lengths: Sequence[int]) -> list[Tensor]:
    return [rows.new_empty(len(rows), length, *rows.shape[2:]) for length in lengths]


@torch.library.register_fake("blitzgs::gather_rows")
def _(columns: Sequence[Tensor], joined: Sequence[Tensor], ids: Tensor) -> list[Tensor]:
    rows = [column.new_empty((len(ids), *column.shape[1:])) for column in columns]
    if joined:
        length = sum(part.shape[1] for part in joined)
        rows.append(joined[0].new_empty((len(ids), length, *joined[0].shape[2:])))
    return rows
