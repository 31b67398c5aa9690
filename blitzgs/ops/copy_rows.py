# SPDX-License-Identifier: Apache-2.0
"""Copies rows of a column, of any size, to other places."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


def take_rows(column: Tensor, rows: Tensor, out: Tensor | None = None) -> Tensor:
    """Return the rows `rows` of a column, as `column.index_select(0, rows)` does.

    For rows whose size is a multiple of 16 bytes, torch's op is slower, because it uses a whole block of
    threads for each.

    Args:
        column: [N, ...], any dtype.
        rows: int64 [M], from 0 to N - 1; not checked.
        out: [M, ...], contiguous, gets the rows; it may not overlap the column. None: a new tensor.

    Returns:
        [M, ...].

    Raises:
        RuntimeError: shapes or dtypes do not fit.
    """
    if out is None:
        out = column.new_empty((len(rows), *column.shape[1:]))
    torch.ops.blitzgs.take_rows_(out, column, rows)
    return out


def put_rows_(column: Tensor, rows: Tensor, fresh: Tensor | None = None) -> None:
    """Overwrite rows of a column, in place.

    Args:
        column: [N, ...], any dtype, contiguous.
        rows: int64 [M], from 0 to N - 1, each at most once; not checked.
        fresh: what the rows become, [M, ...], of the dtype and row shape of `column`; None: zeros.

    Raises:
        RuntimeError: shapes or dtypes do not fit.
    """
    torch.ops.blitzgs.put_rows_(column, rows, fresh)
