# SPDX-License-Identifier: Apache-2.0
"""Sparse gradients of tables: some rows, each once. Torch forgets that, and would sort them to make sure."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

# Where the indices of the latest gradients lie. Autograd hands a first gradient's indices on as they are, but
# not the mark that each is there once; those of a sum of gradients lie elsewhere.
_distinct: deque[StorageWeakRef] = deque(maxlen=32)


def sparse_rows(ids: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    """Return a table that is zero but for some rows, as a sparse tensor.

    Args:
        ids: int32 or int64 [U], ascending, each once.
        values: the rows, [U, ...].
        shape: of the table.
    """
    indices = ids.long()[None]
    _distinct.append(StorageWeakRef(indices.untyped_storage()))
    return torch.sparse_coo_tensor(indices, values, shape, is_coalesced=True, check_invariants=False)


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices int64 [U] and values [U, ...] of a sparse tensor, each index once.

    Args:
        table: sparse in its first dimension alone.
    """
    if not table.is_coalesced():
        here = table._indices().untyped_storage()._cdata
        if any(known.cdata == here and not known.expired() for known in _distinct):
            return table._indices()[0], table._values()
        table = table.coalesce()
    return table.indices()[0], table.values()
