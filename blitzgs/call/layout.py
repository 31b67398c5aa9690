# SPDX-License-Identifier: Apache-2.0
"""Arranges a call's splats for `meta`: one after the other, or as [..., C, N, ...] for all Gaussians.

The ops order splats by Gaussian, then view; packed `meta` orders them by image, then Gaussian. As in gsplat,
the image depends on the tensors in `meta`, so that these get gradients. Its kernels nevertheless read the
splats in the order in which they are, and only gradients pass through the arrangement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.derivatives import linear_map
from blitzgs.ops.projection_types import ProjectedSplats


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


class Layout:
    """The arrangement of P splats in `meta`.

    Attributes:
        splats: the splats; camera_ids number all images of the call, gaussian_ids the Gaussians of a scene.
        packed: whether `meta` has only the visible splats, or else an entry for every Gaussian and view.
        places: where each splat is in `meta`; None: the order is unchanged.
    """

    def __init__(self, splats: ProjectedSplats, shape: tuple[int, ...], packed: bool) -> None:
        """Compute the arrangement.

        Args:
            splats: as the attribute.
            shape: batch dimensions, C, and the Gaussians N of a scene.
            packed: as the attribute.
        """
        self.splats, self.packed = splats, packed
        self.places: Places | None = None
        if not packed:
            self.places = Places((splats.camera_ids, splats.gaussian_ids), shape)
        elif math.prod(shape[:-1]) > 1:
            order = torch.sort(splats.camera_ids, stable=True)[1]
            self.places = Places((order,), tuple(order.shape))

    def arrange(self, *columns: Tensor, under: Tensor | None = None) -> tuple[Tensor, ...]:
        """Arrange columns of splats as `Places.arrange` does."""
        return columns if self.places is None else self.places.arrange(columns, under)

    def gather(self, *arranged: Tensor) -> tuple[Tensor, ...]:
        """Gather the columns of the splats from arranged ones; the inverse of `arrange`."""
        return arranged if self.places is None else self.places.gather(arranged)

    def rendered_columns(self, under: Tensor | None) -> dict[str, Tensor]:
        """Arrange the columns that the image depends on.

        Args:
            under: opacities of the Gaussians, [..., N], where they have no splat; None: zero.
        """
        splats = self.splats
        columns = (splats.means2d, splats.conics, splats.depths, splats.opacities)
        means2d, conics, depths, opacities = self.arrange(*columns, under=under)
        return {"means2d": means2d, "conics": conics, "opacities": opacities, "depths": depths}

    def absgrad_store(self, means2d: Tensor) -> Callable[[Tensor], None]:
        """Set `means2d.absgrad` to 0; return a function that fills it with the splats' gradients, [P, 2]."""
        absgrad = torch.zeros_like(means2d)
        means2d.absgrad = absgrad  # type: ignore[attr-defined]

        def store(gradient: Tensor) -> None:
            absgrad.copy_(self.arrange(gradient)[0])

        return store
