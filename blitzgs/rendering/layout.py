# SPDX-License-Identifier: Apache-2.0
"""Arranges a call's splats for `meta`: one after the other, or as [..., C, N, ...] for all Gaussians.

The ops order splats by Gaussian, then view; packed `meta` orders them by image, then Gaussian. As in gsplat,
the image is rendered from the tensors in `meta`, so that these get gradients: splats are first arranged for
`meta`, and the columns to render are taken from there.
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

    def lay(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Arrange values of splats, [P, ...], as [*shape, ...]; entries without a splat are zero."""
        if self.places is None:
            return values
        if torch.compiler.is_compiling():  # torch differentiates them, and tracing a Function is fragile
            return tuple(_laid(self.places, self.shape, v) for v in values)
        laid: tuple[Tensor, ...] = _Lay.apply(self.places, self.shape, *values)  # type: ignore[no-untyped-call]
        return laid

    def take(self, *laid: Tensor) -> tuple[Tensor, ...]:
        """Take the values of splats, [P, ...], from [*shape, ...]; the inverse of `lay`."""
        if self.places is None:
            return laid
        if torch.compiler.is_compiling():
            return tuple(_taken(self.places, self.shape, t) for t in laid)
        taken: tuple[Tensor, ...] = _Take.apply(self.places, self.shape, *laid)  # type: ignore[no-untyped-call]
        return taken

    def lay_opacities(self, opacities: Tensor) -> Tensor:
        """Arrange the splats' opacities as [..., C, N].

        Entries without a splat have the given opacities, [..., N], as in gsplat.
        """
        assert self.places is not None  # they are given where all Gaussians are laid out
        if torch.compiler.is_compiling():
            return _laid_over(self.places, self.shape, self.splats.opacities, opacities)
        laid: Tensor = _LayOver.apply(self.places, self.shape, self.splats.opacities, opacities)  # type: ignore[no-untyped-call]
        return laid


def _laid(places: Tensor, shape: tuple[int, ...], values: Tensor) -> Tensor:
    laid = values.new_zeros(*shape, *values.shape[1:])
    laid.view(-1, *values.shape[1:]).index_copy_(0, places, values)
    return laid


def _laid_over(places: Tensor, shape: tuple[int, ...], values: Tensor, under: Tensor) -> Tensor:
    laid = under[..., None, :].expand(shape).clone(memory_format=torch.contiguous_format)
    laid.view(-1).index_copy_(0, places, values)
    return laid


def _taken(places: Tensor, shape: tuple[int, ...], laid: Tensor) -> Tensor:
    return laid.reshape(-1, *laid.shape[len(shape) :]).index_select(0, places)


class _Lay(torch.autograd.Function):
    """`Layout.lay`; no two splats have the same place, so the gradient is gathered from the places."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], *values: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(places)
        ctx.shape = shape
        ctx.set_materialize_grads(False)
        return tuple(_laid(places, shape, v) for v in values)

    @staticmethod
    def backward(ctx: Any, *v_laid: Tensor | None) -> Any:
        (places,) = ctx.saved_tensors
        return None, None, *(None if v is None else _taken(places, ctx.shape, v) for v in v_laid)


class _LayOver(torch.autograd.Function):
    """`Layout.lay_opacities`."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], values: Tensor, under: Tensor) -> Tensor:
        ctx.save_for_backward(places)
        ctx.shape = shape
        return _laid_over(places, shape, values, under)

    @staticmethod
    def backward(ctx: Any, v_laid: Tensor) -> Any:
        (places,) = ctx.saved_tensors
        v_values, v_under = _taken(places, ctx.shape, v_laid), None
        if ctx.needs_input_grad[3]:
            covered = v_laid.clone(memory_format=torch.contiguous_format)
            covered.view(-1).index_fill_(0, places, 0)
            v_under = covered.sum(dim=-2)
        return None, None, v_values, v_under


class _Take(torch.autograd.Function):
    """`Layout.take`, the inverse of `_Lay`."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, shape: tuple[int, ...], *laid: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(places)
        ctx.shape = shape
        ctx.set_materialize_grads(False)
        return tuple(_taken(places, shape, t) for t in laid)

    @staticmethod
    def backward(ctx: Any, *v_taken: Tensor | None) -> Any:
        (places,) = ctx.saved_tensors
        return None, None, *(None if v is None else _laid(places, ctx.shape, v) for v in v_taken)
