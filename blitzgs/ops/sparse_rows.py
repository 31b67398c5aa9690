# SPDX-License-Identifier: Apache-2.0
"""Sparse gradients whose rows are unique, without torch's sort that would make sure of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

# Storages of the indices of the latest gradients. Autograd passes the indices tensor of a first gradient on
# unchanged but loses the mark that it is coalesced (each index once). A sum of gradients has an indices
# tensor of its own.
_distinct: deque[StorageWeakRef] = deque(maxlen=32)


class HandOver(NamedTuple):
    """Takes the gradients of parameters in place of autograd, to which the parameters are constants.

    Attributes:
        ticket: [0], requires a gradient and gets none. It stands for the parameters in autograd's graph, on
            their device: `backward` then lets the caller's stream wait for theirs, as it does for `.grad`.
        needed: which of the parameters need a gradient.
        give: called with rows, int64 [U], ascending, each once, and the gradients [U, ...] of all parameters,
            None for those that need none.
    """

    ticket: Tensor
    needed: Sequence[bool]
    give: Callable[[Tensor, Sequence[Tensor | None]], object]


def sparse_rows(ids: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    """Return a sparse tensor of a table in which only the given rows are not zero.

    Args:
        ids: int32 or int64 [U], ascending, each once.
        values: the rows, [U, ...].
        shape: shape of the table.
    """
    return _sparse_table(_indices_of(ids.long()), values, shape)


def _indices_of(ids: Tensor) -> Tensor:
    """Return the indices of sparse gradients, int64 [1, U], and remember that each is there once."""
    indices = ids[None]
    _distinct.append(StorageWeakRef(indices.untyped_storage()))
    return indices


def _sparse_table(indices: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    if indices.shape[1] == 0:
        # Torch adds to an empty gradient in place, and would change the indices of all that share them.
        indices = indices.clone()
    return torch.sparse_coo_tensor(
        indices, values, shape, device=values.device, is_coalesced=True, check_invariants=False
    )


def full_gradients(
    ids: Tensor,
    gradients: Sequence[Tensor | None],
    shapes: Sequence[torch.Size],
    sparse: Sequence[bool],
) -> list[Tensor | None]:
    """Return the gradients of whole parameters from those of their rows `ids`, as sparse or dense tensors.

    Args:
        ids: int32 or int64 [U], ascending, each once.
        gradients: [U, ...] of each parameter; None: it needs none.
        shapes: [N, ...], of each parameter.
        sparse: which of the results are sparse.
    """
    ids = ids.long()
    # All gradients share their indices, by which an optimiser sees that their rows are the same.
    indices = _indices_of(ids) if any(sparse) else ids
    found: list[Tensor | None] = []
    for gradient, shape, is_sparse in zip(gradients, shapes, sparse, strict=True):
        if gradient is None:
            found.append(None)
        elif is_sparse:
            found.append(_sparse_table(indices, gradient, shape))
        else:
            found.append(gradient.new_zeros(shape).index_copy_(0, ids, gradient))
    return found


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices int64 [1, U] and values [U, ...] of a sparse tensor, each index once.

    Args:
        table: a tensor whose only sparse dimension is the first.
    """
    if not table.is_coalesced():
        indices = table._indices()
        here = indices.untyped_storage()._cdata
        if any(known.cdata == here and not known.expired() for known in reversed(_distinct)):
            return indices, table._values()
        table = table.coalesce()
    return table.indices(), table.values()
