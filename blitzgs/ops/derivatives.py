# SPDX-License-Identifier: Apache-2.0
"""The kernels have first derivatives, written by hand. A second one is an error, never silently zero."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def first_only(
    op: str, gradients: Sequence[Tensor | None], inputs: Sequence[Tensor | None]
) -> tuple[Tensor | None, ...]:
    """Return gradients that cannot be differentiated again.

    A gradient depends on the op's inputs even where its formula's result shows no trace of them, as under a
    linear loss. So where torch records the backward pass (`create_graph=True`), the gradients are made to
    depend on all inputs through a function that raises.

    Args:
        op: name of the op, for the error.
        gradients: of its inputs, from its formula, which was run without being recorded.
        inputs: what the gradients depend on: the op's inputs and the gradients of its outputs.
    """
    if not torch.is_grad_enabled():
        return tuple(gradients)
    wanted = [gradient for gradient in gradients if gradient is not None]
    given = [tensor for tensor in inputs if tensor is not None]
    marked = iter(_FirstOnly.apply(op, len(wanted), *wanted, *given))  # type: ignore[no-untyped-call]
    return tuple(None if gradient is None else next(marked) for gradient in gradients)


class _FirstOnly(torch.autograd.Function):
    """Its first tensors, as a function of all of them that has no derivative."""

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
