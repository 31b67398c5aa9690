# SPDX-License-Identifier: Apache-2.0
"""Gathers rows of a column and of new rows behind it into a new column."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@torch.no_grad()
def take_rows(column: Tensor, rows: Tensor, fresh: Tensor | None = None) -> Tensor:
    """Return the rows `rows` of the concatenation of a column and new rows.

    The result equals `torch.cat([column, fresh]).index_select(0, rows)`. Rows may have any size. For rows
    whose size is a multiple of 16 bytes, torch's `index_select` is slower, because it uses a whole block of
    threads for each.

    Args:
        column: [N, ...], any dtype.
        rows: int64 [N'], from 0 to N + M - 1; not checked.
        fresh: new rows [M, ...], of the dtype and row shape of `column`; None: rows of zeros.

    Returns:
        [N', ...].

    Raises:
        RuntimeError: shapes or dtypes do not fit.
    """
    return torch.ops.blitzgs.take_rows(column, rows, fresh)


@torch.library.register_fake("blitzgs::take_rows")
def _(column: Tensor, rows: Tensor, fresh: Tensor | None) -> Tensor:
    return column.new_empty((len(rows), *column.shape[1:]))
