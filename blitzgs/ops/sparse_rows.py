# SPDX-License-Identifier: Apache-2.0
"""Sparse gradients whose rows are unique, without torch's sort that would make sure of it."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

# Storages of the indices of the latest gradients. Autograd passes the indices tensor of a first gradient on
# unchanged but loses the mark that it is coalesced (each index once). A sum of gradients has an indices
# tensor of its own.
_distinct: deque[StorageWeakRef] = deque(maxlen=32)


def sparse_rows(ids: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    """Return a sparse tensor of a table in which only the given rows are not zero.

    Args:
        ids: int32 or int64 [U], ascending, each once.
        values: the rows, [U, ...].
        shape: shape of the table.
    """
    indices = ids.long()[None]
    storage = indices.untyped_storage()
    # The gradients of one backward pass share their indices.
    if not _distinct or _distinct[-1].cdata != storage._cdata:
        _distinct.append(StorageWeakRef(storage))
    return torch.sparse_coo_tensor(indices, values, shape, is_coalesced=True, check_invariants=False)


def full_gradient(ids: Tensor, gradient: Tensor, shape: torch.Size, sparse: bool) -> Tensor:
    """Return the gradient of a whole parameter from that of its rows `ids`, as a sparse or a dense tensor.

    Args:
        ids: int64 [U], without duplicates.
        gradient: [U, ...].
        shape: [N, ...], of the parameter.
        sparse: return a sparse tensor.
    """
    if sparse:
        return sparse_rows(ids, gradient, shape)
    return gradient.new_zeros(shape).index_copy_(0, ids, gradient)


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices int64 [U] and values [U, ...] of a sparse tensor, each index once.

    Args:
        table: a tensor whose only sparse dimension is the first.
    """
    if not table.is_coalesced():
        here = table._indices().untyped_storage()._cdata
        if any(known.cdata == here and not known.expired() for known in reversed(_distinct)):
            return table._indices()[0], table._values()
        table = table.coalesce()
    return table.indices()[0], table.values()
