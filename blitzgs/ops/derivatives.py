# SPDX-License-Identifier: Apache-2.0
"""Gradients of our own: linear maps with their adjoints, sparse gradients, second derivatives as an error."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import mark_coalesced, raw_indices, raw_values, refusing_derivatives

# Maps which inputs need a gradient, and the gradients of the outputs, to those of the inputs.
Adjoint = Callable[[Sequence[bool], Sequence[Tensor | None]], Sequence[Tensor | None]]


def first_only(
    op: str, compute: Callable[[], Sequence[Tensor | None]], inputs: Sequence[Tensor | None]
) -> Sequence[Tensor | None]:
    """Return the gradients that `compute` returns, so that they cannot be differentiated again.

    Autograd sees no connection between a hand-written gradient and the op's inputs, so a second derivative
    would silently be zero. When torch records the backward pass (`create_graph=True`), this function
    therefore connects the gradients with `inputs`, the op's and the gradients of its outputs, through a
    function whose backward pass raises an error. `op`: its name. RuntimeError: the backward pass runs under
    vmap.
    """
    recorded = torch.is_grad_enabled()
    try:
        with torch.no_grad():
            gradients = compute()
    except RuntimeError as error:
        if "Batching rule not implemented" not in str(error):  # torch's words; its mode is not public
            raise
        raise RuntimeError(
            f"blitzgs: {op} has no gradients under vmap (is_grads_batched=True, or a vectorised Jacobian): "
            "call torch.autograd.grad once for each gradient, with retain_graph=True"
        ) from error
    if not recorded:
        return gradients
    wanted = [gradient for gradient in gradients if gradient is not None]
    given = [tensor for tensor in inputs if tensor is not None and tensor.requires_grad]
    message = (
        f"blitzgs: {op} has first derivatives only, and a second one was asked for (a Hessian, a gradient "
        "penalty, or backward() through a gradient that was made with create_graph=True)"
    )
    marked = iter(refusing_derivatives(message, wanted, given))
    return tuple(None if gradient is None else next(marked) for gradient in gradients)


def linear_map(
    forward: Callable[..., tuple[Tensor, ...]],
    adjoint: Adjoint,
    inputs: Sequence[Tensor | None],
) -> tuple[Tensor, ...]:
    """Apply a linear map, of which autograd records nothing, with the gradient that its adjoint gives."""
    outputs: tuple[Tensor, ...] = _LinearMap.apply(forward, adjoint, *inputs)  # type: ignore[no-untyped-call]
    return outputs


class _LinearMap(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        forward: Callable[..., tuple[Tensor, ...]],
        adjoint: Adjoint,
        *inputs: Tensor | None,
    ) -> tuple[Tensor, ...]:
        ctx.adjoint = adjoint
        ctx.set_materialize_grads(False)
        return forward(*inputs)

    @staticmethod
    def backward(ctx: Any, *v_outputs: Tensor | None) -> Any:
        return None, None, *ctx.adjoint(ctx.needs_input_grad[2:], v_outputs)


def sparse_rows(indices: Tensor, values: Tensor, shape: torch.Size) -> Tensor:
    """Return a sparse table of which only some rows, int64 [1, U], ascending, each once, are not zero."""
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
    indices = ids[None]

    def full(gradient: Tensor, shape: torch.Size, is_sparse: bool) -> Tensor:
        if is_sparse:
            return sparse_rows(indices, gradient, shape)
        return gradient.new_zeros(shape).index_copy_(0, ids, gradient)

    every = zip(gradients, shapes, sparse, strict=True)
    return [None if v is None else full(v, shape, is_sparse) for v, shape, is_sparse in every]


def rows_of_tables(
    tables: Sequence[Tensor],  # [N, ...] each: four, and parts [N, L, 3] of the SH, if there are any
    ids: Tensor,  # int64 [U], ascending, each once
    sparse: bool,  # whether the gradients of the tables are sparse
    found: Sequence[Tensor] | None = None,  # the result, if it is already known
) -> tuple[Tensor, ...]:
    """Return the rows `ids` of tables, [U, ...] each, with the parts of the SH joined to one.

    The tables are not saved: their gradients do not depend on their values, which may change.
    """
    shapes, lengths = [table.shape for table in tables], [part.shape[1] for part in tables[4:]]

    def gather(*tables: Tensor) -> tuple[Tensor, ...]:
        if found is not None:
            return tuple(found)
        rows = [table.index_select(0, ids) for table in tables]
        return (*rows[:4], *([torch.cat(rows[4:], dim=1)] if lengths else []))

    def spread(needed: Sequence[bool], v: Sequence[Tensor | None]) -> list[Tensor | None]:
        gradients = list(v)
        if len(lengths) > 1 and v[4] is not None:
            # Autograd would copy a gradient that is not contiguous, and its indices with it. Torch adds to an
            # empty sparse gradient in place, so parts share no memory.
            parts = v[4].split_with_sizes(lengths, 1)
            gradients[4:] = [part.clone(memory_format=torch.contiguous_format) for part in parts]
        elif lengths:
            gradients[4:] = [v[4]] * len(lengths)
        wanted = [gradient if need else None for gradient, need in zip(gradients, needed, strict=True)]
        return full_gradients(ids, wanted, shapes, [sparse] * len(shapes))

    return linear_map(gather, spread, tables)


def distinct_rows(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rows int64 [1, U], each once, and the values [U, ...] of a sparse tensor.

    `table`: a tensor whose only sparse dimension is the first.
    """
    if not table.is_coalesced():
        table = table.coalesce()
    return raw_indices(table), raw_values(table)


def of_shape(table: Tensor, shape: Sequence[int]) -> Tensor:
    """Return a table with rows of another shape and as many values, whose gradient may be sparse.

    `table`: [N, ...]. `shape`: (N, ...).
    """

    def back(_needed: Any, v: Sequence[Tensor | None]) -> list[Tensor | None]:
        if v[0] is None or not v[0].is_sparse:
            return [None if v[0] is None else v[0].reshape(table.shape)]
        values = raw_values(v[0])
        return [sparse_rows(raw_indices(v[0]), values.reshape(len(values), *table.shape[1:]), table.shape)]

    (reshaped,) = linear_map(lambda rows: (rows.reshape(tuple(shape)),), back, [table])
    return reshaped


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
