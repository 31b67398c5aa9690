# SPDX-License-Identifier: Apache-2.0
"""Gradients of our own: linear maps with their adjoints, and second derivatives as an error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import refusing_derivatives

# Maps saved tensors, which inputs need a gradient, and the gradients of the outputs to those of the inputs.
Adjoint = Callable[[Sequence[Tensor], Sequence[bool], Sequence[Tensor | None]], Sequence[Tensor | None]]


def first_only(
    op: str, compute: Callable[[], Sequence[Tensor | None]], inputs: Sequence[Tensor | None]
) -> Sequence[Tensor | None]:
    """Return the gradients that `compute` returns, so that they cannot be differentiated again.

    Autograd sees no connection between a hand-written gradient and the op's inputs, so a second derivative
    would silently be zero. When torch records the backward pass (`create_graph=True`), this function
    therefore connects the gradients with all inputs through a function whose backward pass raises an error.

    `op`: its name, for errors. `compute`: returns gradients of the op's inputs; autograd records nothing of
    it. `inputs`: what these depend on: the op's inputs and the gradients of its outputs. RuntimeError: the
    backward pass runs under vmap.
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
    saved: Sequence[Tensor] = (),
) -> tuple[Tensor, ...]:
    """Apply a linear map to tensors, with the gradient that its adjoint gives.

    Autograd records nothing of `forward`. `saved`: tensors without gradients for `adjoint`.
    """
    outputs: tuple[Tensor, ...] = _LinearMap.apply(forward, adjoint, saved, *inputs)  # type: ignore[no-untyped-call]
    return outputs


class _LinearMap(torch.autograd.Function):
    """See `linear_map`."""

    @staticmethod
    def forward(
        ctx: Any,
        forward: Callable[..., tuple[Tensor, ...]],
        adjoint: Adjoint,
        saved: Sequence[Tensor],
        *inputs: Tensor | None,
    ) -> tuple[Tensor, ...]:
        ctx.adjoint = adjoint
        ctx.save_for_backward(*saved)
        ctx.set_materialize_grads(False)
        return forward(*inputs)

    @staticmethod
    def backward(ctx: Any, *v_outputs: Tensor | None) -> Any:
        return None, None, None, *ctx.adjoint(ctx.saved_tensors, ctx.needs_input_grad[3:], v_outputs)
