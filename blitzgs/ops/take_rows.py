# SPDX-License-Identifier: Apache-2.0
"""A new column of a table, made of old and new rows."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@torch.no_grad()
def take_rows(column: Tensor, rows: Tensor, fresh: Tensor | None = None) -> Tensor:
    """Return the rows `rows` of a column that is followed by new rows.

    The result is that of `index_select` on both. Torch's op is slower, because it gives each row of a
    multiple of 16 bytes a whole block of threads.

    Args:
        column: [N, ...], any dtype.
        rows: int64 [N'], from 0 to N + M - 1; not checked.
        fresh: new rows [M, ...], like those of `column`; None: zeros.

    Returns:
        [N', ...].

    Raises:
        RuntimeError: shapes or dtypes do not fit.
    """
    return torch.ops.blitzgs.take_rows(column, rows, fresh)


@torch.library.register_fake("blitzgs::take_rows")
def _(column: Tensor, rows: Tensor, fresh: Tensor | None) -> Tensor:
    return column.new_empty((len(rows), *column.shape[1:]))
