# SPDX-License-Identifier: Apache-2.0
"""Copies rows of columns, and makes sparse gradients of tables of which only some rows are not zero."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs._torch import mark_coalesced, raw_indices, raw_values
from blitzgs.ops.derivatives import linear_map


def take_rows(
    columns: Sequence[Tensor], rows: Tensor, out: Sequence[Tensor] | None = None
) -> Sequence[Tensor]:
    """Return the rows `rows` of each column, as `column.index_select(0, rows)` does.

    For rows whose size is a multiple of 16 bytes, torch's op is slower, because it uses a whole block of
    threads for each.

    Args:
        columns: [N, ...], any dtypes.
        rows: int64 [M], from 0 to N - 1; not checked.
        out: [M, ...], contiguous, get the rows; they may not overlap the columns. None: new tensors.

    Returns:
        [M, ...] of each column.
    """
    if out is None:
        out = [column.new_empty((len(rows), *column.shape[1:])) for column in columns]
    torch.ops.blitzgs.take_rows_(out, columns, rows)
    return out


def put_rows_(columns: Sequence[Tensor], rows: Tensor, fresh: Sequence[Tensor] = ()) -> None:
    """Overwrite rows of columns, in place.

    `columns`: [N, ...], any dtypes, contiguous. `rows`: int64 [M], from 0 to N - 1, each at most once; not
    checked. `fresh`: what the rows become, [M, ...], of the dtype and row shape of each column; none: zeros.
    """
    torch.ops.blitzgs.put_rows_(columns, rows, fresh)


def sparse_rows(ids: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    """Return a sparse tensor of a table in which only the given rows are not zero.

    `ids`: int32 or int64 [U], ascending, each once. `values`: the rows, [U, ...]. `shape`: shape of the
    table.
    """
    indices = ids.long()[None]
    if indices.shape[1] == 0:
        # Torch adds to an empty gradient in place, and would change the indices of all that share them.
        indices = indices.clone()
    return torch.sparse_coo_tensor(
        indices, values, shape, device=values.device, is_coalesced=True, check_invariants=False
    )


def full_gradients(
    ids: Tensor, gradients: Sequence[Tensor | None], shapes: Sequence[torch.Size], sparse: Sequence[bool]
) -> list[Tensor | None]:
    """Return the gradients of whole parameters from those of their rows, as sparse or dense tensors.

    `ids`: int32 or int64 [U], ascending, each once. `gradients`: [U, ...] of each parameter; None: it needs
    none. `shapes`: [N, ...] of each. `sparse`: which of the results are sparse.
    """
    ids = ids.long()
    return [
        None
        if gradient is None
        else sparse_rows(ids, gradient, shape)
        if is_sparse
        else gradient.new_zeros(shape).index_copy_(0, ids, gradient)
        for gradient, shape, is_sparse in zip(gradients, shapes, sparse, strict=True)
    ]


class KeptMarks:
    """Keeps the mark that a parameter's sparse gradient is coalesced, which autograd loses as it stores it.

    Without the mark, an optimiser has to look at all rows, for which the host waits on CUDA.
    """

    def __init__(self) -> None:
        self._parameters: dict[int, weakref.ref[Tensor]] = {}

    def of(self, param: Tensor) -> None:
        """Keep the marks of the gradients that `param`, a leaf, will receive."""
        key = id(param)
        known = self._parameters.get(key)
        if (known is not None and known() is param) or not (param.is_leaf and param.requires_grad):
            return
        arriving = [-1]

        def look(gradient: Tensor) -> None:
            whole = gradient.is_sparse and gradient.is_coalesced()
            arriving[0] = gradient._nnz() if whole else -1

        def mark(param: Tensor) -> None:
            gradient = param.grad
            # Torch appends the rows of a second gradient to those of the first.
            if gradient is not None and gradient.is_sparse and gradient._nnz() == arriving[0]:
                mark_coalesced(gradient)

        param.register_hook(look)
        param.register_post_accumulate_grad_hook(mark)
        self._parameters[key] = weakref.ref(param, lambda _: self._parameters.pop(key, None))


def of_shape(table: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a table with rows of another shape and as many values, whose gradient may be sparse.

    `table`: [N, ...]. `shape`: (N, ...).
    """

    def back(_saved: Any, _needed: Any, v: Sequence[Tensor | None]) -> list[Tensor | None]:
        if v[0] is None or not v[0].is_sparse:
            return [None if v[0] is None else v[0].reshape(table.shape)]
        values = raw_values(v[0])
        return [sparse_rows(raw_indices(v[0])[0], values.reshape(len(values), *table.shape[1:]), table.shape)]

    (reshaped,) = linear_map(lambda rows: (rows.reshape(tuple(shape)),), back, [table])
    return reshaped


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rows int64 [1, U], each once, and the values [U, ...] of a sparse tensor.

    `table`: a tensor whose only sparse dimension is the first.
    """
    if not table.is_coalesced():
        table = table.coalesce()
    return raw_indices(table), raw_values(table)
