# SPDX-License-Identifier: Apache-2.0
"""Copies columns of splats into the arrangement of `meta` and back, several in one launch, differentiably."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.derivatives import linear_map


class Places(NamedTuple):
    """Where P splats are in an arrangement.

    Attributes:
        indices: (order,), int64 [P]: entry i is splat order[i], and each splat has one entry; or (images,
            gaussians), int32 [P] each: a splat is the entry [image, Gaussian] of an arrangement of all
            Gaussians in all images, and no two splats have the same entry.
        shape: dimensions of the arrangement, [P] or [..., C, N], where the images are counted through
            [..., C].
    """

    indices: tuple[Tensor, ...]
    shape: tuple[int, ...]

    def flat(self) -> Tensor:
        """Return the place of each splat in the flat arrangement, int64 [P]."""
        if len(self.indices) == 1:
            (order,) = self.indices
            return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
        images, gaussians = self.indices
        return images.long() * self.shape[-1] + gaussians

    def arrange(self, columns: Sequence[Tensor], under: Tensor | None = None) -> tuple[Tensor, ...]:
        """Arrange columns of splats.

        Args:
            columns: [P, ...] each, with elements of 4 or 8 bytes.
            under: values of the Gaussians, [..., N], that entries of the last column have if they have no
                splat; None: zeros, as in the other columns.

        Returns:
            The columns, [*shape, ...].
        """
        if torch.compiler.is_compiling():  # torch differentiates them, and tracing a Function is fragile
            return self._arranged_by_torch(columns, under)
        if not torch.is_grad_enabled():
            return tuple(torch.ops.blitzgs.arrange_splats(columns, self.indices, self.shape, under))
        shape = self.shape
        return linear_map(
            lambda under, *columns: tuple(
                torch.ops.blitzgs.arrange_splats(columns, self.indices, shape, under)
            ),
            lambda saved, needed, v: _gradients_of_arranged(Places(tuple(saved), shape), needed, v),
            [under, *columns],
            self.indices,
        )

    def gather(self, arranged: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the columns of the splats, [P, ...], of arranged ones, [*shape, ...]."""
        if torch.compiler.is_compiling():
            places, first = self.flat(), len(self.shape)
            return tuple(t.reshape(-1, *t.shape[first:]).index_select(0, places) for t in arranged)
        if not torch.is_grad_enabled():
            return tuple(torch.ops.blitzgs.splats_of_arranged(arranged, self.indices, self.shape))
        shape = self.shape
        return linear_map(
            lambda *arranged: tuple(torch.ops.blitzgs.splats_of_arranged(arranged, self.indices, shape)),
            lambda saved, _, v: _given(Places(tuple(saved), shape).arrange, v),
            arranged,
            self.indices,
        )

    def _arranged_by_torch(self, columns: Sequence[Tensor], under: Tensor | None) -> tuple[Tensor, ...]:
        places, found = self.flat(), []
        for i, column in enumerate(columns):
            over = under is not None and i == len(columns) - 1
            arranged = column.new_zeros(*self.shape, *column.shape[1:])
            if over:
                assert under is not None
                arranged = under[..., None, :].expand(self.shape).clone(memory_format=torch.contiguous_format)
            arranged.view(-1, *column.shape[1:]).index_copy_(0, places, column)
            found.append(arranged)
        return tuple(found)


def _given(
    function: Callable[[list[Tensor]], tuple[Tensor, ...]], columns: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Apply a function of several columns to those that are not None."""
    given = [column for column in columns if column is not None]
    found = iter(function(given) if given else ())
    return [None if column is None else next(found) for column in columns]


def _gradients_of_arranged(
    places: Places, needed: Sequence[bool], v_arranged: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Return the gradients of `under` and of the columns; no two splats have the same place."""
    v_under, v_columns = None, _given(places.gather, v_arranged)
    v_last, v_of_splats = v_arranged[-1], v_columns[-1]
    if needed[0] and v_last is not None and v_of_splats is not None:
        v_under = (v_last - places.arrange([v_of_splats])[0]).sum(dim=-2)
    return [v_under, *v_columns]
