# SPDX-License-Identifier: Apache-2.0
"""Arranges a call's splats for `meta`: one after the other, or as [..., C, N, ...] for all Gaussians.

The ops order splats by Gaussian, then view; packed `meta` orders them by image, then Gaussian. As in gsplat,
the image is rendered from the tensors in `meta`, so that these get gradients: splats are first arranged for
`meta`, and the columns to render are gathered from there.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from blitzgs.ops.projection import ProjectedSplats


class Layout:
    """The arrangement of P splats in `meta`.

    Attributes:
        splats: the splats; camera_ids number all images of the call, gaussian_ids the Gaussians of a scene.
        packed: whether `meta` has only the visible splats, or else an entry for every Gaussian and view.
        places: int64 [P], flat index of each splat in `meta`; None: the order is unchanged.
        shape: leading dimensions in `meta`, before those of a splat's values.
    """

    def __init__(self, splats: ProjectedSplats, lead: tuple[int, ...], count: int, packed: bool) -> None:
        """Compute the arrangement.

        Args:
            splats: as the attribute.
            lead: batch dimensions, and C.
            count: Gaussians N of a scene.
            packed: as the attribute.
        """
        self.splats, self.packed = splats, packed
        self._images: Tensor | None = None
        self._gaussians: Tensor | None = None
        self.places: Tensor | None = None
        self.shape: tuple[int, ...] = tuple(splats.camera_ids.shape)
        if not packed:
            self.places = self.images * count + self.gaussians
            self.shape = (*lead, count)
        elif math.prod(lead) > 1:
            order = torch.argsort(self.images, stable=True)
            self.places = torch.empty_like(order)
            self.places[order] = torch.arange(len(order), device=order.device)

    # Computed on first use. functools.cached_property takes a lock, which torch.compile cannot trace.
    @property
    def images(self) -> Tensor:
        """The image of each splat, int64 [P]."""
        if self._images is None:
            self._images = self.splats.camera_ids.long()
        return self._images

    @property
    def gaussians(self) -> Tensor:
        """The Gaussian of each splat in its scene, int64 [P]."""
        if self._gaussians is None:
            self._gaussians = self.splats.gaussian_ids.long()
        return self._gaussians

    def arrange(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Arrange values of splats, [P, ...], as [*shape, ...]; entries without a splat are zero."""
        if self.places is None:
            return values
        if torch.compiler.is_compiling():  # torch differentiates them, and tracing a Function is fragile
            return tuple(_arranged(self.places, self.shape, v) for v in values)
        arranged: tuple[Tensor, ...] = _Arrange.apply(self.places, self.shape, *values)  # type: ignore[no-untyped-call]
        return arranged

    def gather(self, *arranged: Tensor) -> tuple[Tensor, ...]:
        """Gather the values of splats, [P, ...], from [*shape, ...]; the inverse of `arrange`."""
        if self.places is None:
            return arranged
        if torch.compiler.is_compiling():
            return tuple(_gathered(self.places, self.shape, t) for t in arranged)
        gathered: tuple[Tensor, ...] = _Gather.apply(self.places, self.shape, *arranged)  # type: ignore[no-untyped-call]
        return gathered

    def arrange_opacities(self, opacities: Tensor) -> Tensor:
        """Arrange the splats' opacities as [..., C, N].

        Entries without a splat have the given opacities, [..., N], as in gsplat.
        """
        assert self.places is not None  # the constructor computes them when all Gaussians are arranged
        if torch.compiler.is_compiling():
            return _arranged_over(self.places, self.shape, self.splats.opacities, opacities)
        arranged: Tensor = _ArrangeOver.apply(self.places, self.shape, self.splats.opacities, opacities)  # type: ignore[no-untyped-call]
        return arranged


def _arranged(places: Tensor, shape: tuple[int, ...], values: Tensor) -> Tensor:
    arranged = values.new_zeros(*shape, *values.shape[1:])
    arranged.view(-1, *values.shape[1:]).index_copy_(0, places, values)
    return arranged


def _arranged_over(places: Tensor, shape: tuple[int, ...], values: Tensor, under: Tensor) -> Tensor:
    arranged = under[..., None, :].expand(shape).clone(memory_format=torch.contiguous_format)
    arranged.view(-1).index_copy_(0, places, values)
    return arranged


def _gathered(places: Tensor, shape: tuple[int, ...], arranged: Tensor) -> Tensor:
    return arranged.reshape(-1, *arranged.shape[len(shape) :]).index_select(0, places)


class _Arrange(torch.autograd.Function):
    """`Layout.arrange`; no two splats have the same place, so the gradient is gathered from the places."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], *values: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(places)
        ctx.shape = shape
        ctx.set_materialize_grads(False)
        return tuple(_arranged(places, shape, v) for v in values)

    @staticmethod
    def backward(ctx: Any, *v_arranged: Tensor | None) -> Any:
        (places,) = ctx.saved_tensors
        return None, None, *(None if v is None else _gathered(places, ctx.shape, v) for v in v_arranged)


class _ArrangeOver(torch.autograd.Function):
    """`Layout.arrange_opacities`."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], values: Tensor, under: Tensor) -> Tensor:
        ctx.save_for_backward(places)
        ctx.shape = shape
        return _arranged_over(places, shape, values, under)

    @staticmethod
    def backward(ctx: Any, v_arranged: Tensor) -> Any:
        (places,) = ctx.saved_tensors
        v_values, v_under = _gathered(places, ctx.shape, v_arranged), None
        if ctx.needs_input_grad[3]:
            covered = v_arranged.clone(memory_format=torch.contiguous_format)
            covered.view(-1).index_fill_(0, places, 0)
            v_under = covered.sum(dim=-2)
        return None, None, v_values, v_under


class _Gather(torch.autograd.Function):
    """`Layout.gather`, the inverse of `_Arrange`."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], *arranged: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(places)
        ctx.shape = shape
        ctx.set_materialize_grads(False)
        return tuple(_gathered(places, shape, t) for t in arranged)

    @staticmethod
    def backward(ctx: Any, *v_gathered: Tensor | None) -> Any:
        (places,) = ctx.saved_tensors
        return None, None, *(None if v is None else _arranged(places, ctx.shape, v) for v in v_gathered)
