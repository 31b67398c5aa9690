# SPDX-License-Identifier: Apache-2.0
"""Converts the cull mask between the layout by row, which moves with rows, and the layout of the kernels."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.blocks import BLOCK_ROWS

# Bits of a word of a mask. In the layout by row, each bit is of one column.
WORD_BITS = 32
SECTOR_WORDS = BLOCK_ROWS // WORD_BITS


@torch.no_grad()
def sectors_of_rows(rows: Tensor) -> Tensor:
    """Convert a mask from the layout by row to the layout by block and column (a column is a view).

    Args:
        rows: int32 [N, words]; bit v % 32 of word v / 32 is that of column v.

    Returns:
        int32 [ceil(N / 256), 32 words, 8]: for each block of 256 rows and column the 32 bytes of the rows'
        bits; bit r % 32 of word r / 32 is that of the block's row r. Rows beyond N have zeros.

    Raises:
        RuntimeError: a wrong shape or dtype.
    """
    return torch.ops.blitzgs.sectors_of_rows(rows)


@torch.no_grad()
def rows_of_sectors(sectors: Tensor, n: int) -> Tensor:
    """Convert a mask of N rows back to the layout by row, int32 [N, words]; the inverse of `sectors_of_rows`.

    Raises:
        RuntimeError: a wrong shape or dtype.
    """
    return torch.ops.blitzgs.rows_of_sectors(sectors, n)


@torch.library.register_fake("blitzgs::sectors_of_rows")
def _(rows: Tensor) -> Tensor:
    return rows.new_empty(-(-rows.shape[0] // BLOCK_ROWS), WORD_BITS * rows.shape[1], SECTOR_WORDS)


@torch.library.register_fake("blitzgs::rows_of_sectors")
def _(sectors: Tensor, n: int) -> Tensor:
    return sectors.new_empty(n, sectors.shape[1] // WORD_BITS)
