# SPDX-License-Identifier: Apache-2.0
"""Columns that a table stores in another form than row by row, because kernels read them so."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from blitzgs.ops.blocks import BLOCK_ROWS, SECTOR_WORDS, WORD_BITS, rows_of_sectors, sectors_of_rows

# The cull matrix, from the first importance pass on: which views leave a row out.
CULL = "cull"


class BitSectors:
    """Bits [N, words] by blocks of rows, as `blitzgs.ops.blocks` has them: [256 ceil(N / 256), words]."""

    def stored(self, column: Tensor) -> Tensor:
        """Return the stored form of a column [N, words]."""
        return sectors_of_rows(column).view(-1, column.shape[1])

    def rows(self, stored: Tensor, count: int) -> Tensor:
        """Return the column [count, words] of a stored form."""
        return rows_of_sectors(sectors_in(stored), count)

    def length(self, count: int) -> int:
        """Return the length of the stored form of `count` rows."""
        return -(-count // BLOCK_ROWS) * BLOCK_ROWS


def sectors_in(stored: Tensor) -> Tensor:
    """View the stored form of `BitSectors` as the kernels take it, int32 [ceil(N / 256), columns, 8]."""
    return stored.view(-1, WORD_BITS * stored.shape[1], SECTOR_WORDS)


# All other columns are stored row by row.
LAYOUTS: Mapping[str, BitSectors] = {CULL: BitSectors()}
