# SPDX-License-Identifier: Apache-2.0
"""Gradients that backward passes hand to an optimiser, which takes its step without sparse tensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.sparse_rows import sparse_rows


class Handed(NamedTuple):
    """The gradients of one backward pass; rows that are missing have the gradient zero.

    Attributes:
        rows: int64 [U], ascending, each once.
        gradients: [U, ...] of each parameter that needs one.
    """

    rows: Tensor
    gradients: Mapping[Tensor, Tensor]


@torch.no_grad()
def move_to_grad(handed: list[Handed], params: Iterable[Tensor]) -> None:
    """Add handed gradients to `.grad` of the given parameters, and empty the list."""
    for param in params:
        for rows, gradients in handed:
            if (values := gradients.get(param)) is not None:
                gradient = sparse_rows(rows, values, param.shape)
                param.grad = gradient if param.grad is None else param.grad + gradient
    handed.clear()


def only_handed(members: Sequence[tuple[Any, dict[str, Any], int]]) -> tuple[Tensor, list[Tensor]] | None:
    """Return the rows and gradients of members of a `Joint` if one backward pass handed over all of them."""
    first = members[0][0].handed
    if len(first) != 1:
        return None
    ((rows, gradients),) = first
    found = []
    for optimizer, group, place in members:
        param, handed = group["params"][place], optimizer.handed
        values = gradients.get(param)
        if values is None or param.grad is not None or len(handed) != 1 or handed[0].rows is not rows:
            return None
        found.append(values)
    return rows, found
