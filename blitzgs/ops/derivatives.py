# SPDX-License-Identifier: Apache-2.0
"""Makes second derivatives an error: the kernels implement first derivatives only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def first_only(
    op: str, compute: Callable[[], Sequence[Tensor | None]], inputs: Sequence[Tensor | None]
) -> Sequence[Tensor | None]:
    """Return the gradients that `compute` returns, so that they cannot be differentiated again.

    Autograd sees no connection between a hand-written gradient and the op's inputs, so a second derivative
    would silently be zero. When torch records the backward pass (`create_graph=True`), this function
    therefore connects the gradients with all inputs through a function whose backward pass raises an error.

    Args:
        op: name of the op, for the error.
        compute: returns gradients of the op's inputs; autograd records nothing of it.
        inputs: tensors that the gradients depend on: the op's inputs and the gradients of its outputs.
    """
    if not torch.is_grad_enabled():
        return compute()
    with torch.no_grad():
        gradients = compute()
    wanted = [gradient for gradient in gradients if gradient is not None]
    given = [tensor for tensor in inputs if tensor is not None]
    marked = iter(_FirstOnly.apply(op, len(wanted), *wanted, *given))  # type: ignore[no-untyped-call]
    return tuple(None if gradient is None else next(marked) for gradient in gradients)


class _FirstOnly(torch.autograd.Function):
    """Returns its first `count` tensors; its backward pass raises an error."""

    @staticmethod
    def forward(ctx: Any, op: str, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.op = op
        return tuple(tensor.detach() for tensor in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise RuntimeError(
            f"blitzgs: {ctx.op} has first derivatives only, and a second one was asked for (a Hessian, a "
            "gradient penalty, or backward() through a gradient that was made with create_graph=True)"
        )
