# SPDX-License-Identifier: Apache-2.0
"""Arranges a call's splats: one after the other or for all Gaussians for `meta`, and as lists of tiles.

The ops order splats by Gaussian, then view; packed `meta` orders them by image, then Gaussian. As in gsplat,
the image depends on the tensors in `meta`, so that these get gradients. Its kernels nevertheless read the
splats in the order in which they are, and only gradients pass through the arrangement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.call.extras import Pixels
from blitzgs.ops.derivatives import linear_map
from blitzgs.ops.intersect import TILE_SIZE, TileGrid
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions
from blitzgs.ops.rasterize import MetaGeometry


class Places(NamedTuple):
    """Where P splats are in an arrangement."""

    # (order,), int64 [P]: entry i is splat order[i], each splat once; or (images, gaussians), int32 [P] each:
    # each splat has its own entry [image, Gaussian] of an arrangement of all Gaussians in all images.
    indices: tuple[Tensor, ...]
    shape: tuple[int, ...]  # of the arrangement: [P], or [..., C, N] with images counted by [..., C]

    def flat(self) -> Tensor:
        """Return the place of each splat in the flat arrangement, int64 [P]."""
        if len(self.indices) == 1:
            (order,) = self.indices
            return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
        images, gaussians = self.indices
        return images.long() * self.shape[-1] + gaussians

    def arrange(self, columns: Sequence[Tensor], under: Tensor | None = None) -> tuple[Tensor, ...]:
        """Arrange columns of splats, [P, ...] with elements of 4 or 8 bytes; return [*shape, ...] of each.

        `under`: values of the Gaussians, [..., N], that entries of the last column have if they have no
        splat; None: zeros, as in the other columns.
        """
        if torch.compiler.is_compiling():  # torch differentiates them, and tracing a Function is fragile
            return self._arranged_by_torch(columns, under)

        def run(under: Tensor | None, *columns: Tensor) -> tuple[Tensor, ...]:
            return tuple(torch.ops.blitzgs.arrange_splats(columns, self.indices, self.shape, under))

        def back(needed: Sequence[bool], v: Sequence[Tensor | None]) -> list[Tensor | None]:
            v_columns, v_under = _given(self.gather, v), None
            v_last, v_of_splats = v[-1], v_columns[-1]
            if needed[0] and v_last is not None and v_of_splats is not None:
                # No two splats have the same place.
                v_under = (v_last - self.arrange([v_of_splats])[0]).sum(dim=-2)
            return [v_under, *v_columns]

        return linear_map(run, back, [under, *columns]) if torch.is_grad_enabled() else run(under, *columns)

    def gather(self, arranged: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the columns of the splats, [P, ...], of arranged ones, [*shape, ...]."""
        if torch.compiler.is_compiling():
            places, first = self.flat(), len(self.shape)
            return tuple(t.reshape(-1, *t.shape[first:]).index_select(0, places) for t in arranged)

        def run(*arranged: Tensor) -> tuple[Tensor, ...]:
            return tuple(torch.ops.blitzgs.splats_of_arranged(arranged, self.indices, self.shape))

        if not torch.is_grad_enabled():
            return run(*arranged)
        return linear_map(run, lambda _, v: _given(self.arrange, v), arranged)

    def _arranged_by_torch(self, columns: Sequence[Tensor], under: Tensor | None) -> tuple[Tensor, ...]:
        places = self.flat()
        found = [column.new_zeros(*self.shape, *column.shape[1:]) for column in columns]
        if under is not None:
            found[-1] = under[..., None, :].expand(self.shape).clone(memory_format=torch.contiguous_format)
        for arranged, column in zip(found, columns, strict=True):
            arranged.view(-1, *column.shape[1:]).index_copy_(0, places, column)
        return tuple(found)


def _given(
    function: Callable[[list[Tensor]], tuple[Tensor, ...]], columns: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Apply a function of several columns to those that are not None."""
    given = [column for column in columns if column is not None]
    found = iter(function(given) if given else ())
    return [None if column is None else next(found) for column in columns]


class Layout:
    """The arrangement of P splats in `meta`: the visible ones if `packed`, or else all of all views.

    Attribute `rendered` has the columns that the image depends on, arranged.
    """

    def __init__(
        self,
        splats: ProjectedSplats,  # camera_ids number all images, gaussian_ids the Gaussians of a scene
        shape: tuple[int, ...],  # batch dimensions, C, and the Gaussians N of a scene
        packed: bool,
        under: Tensor | None,  # opacities of Gaussians without a splat, [..., N]; None: zero
    ) -> None:
        self.splats, self.packed = splats, packed
        self.places: Places | None = None  # of each splat in `meta`; None: the order is unchanged
        if not packed:
            self.places = Places((splats.camera_ids, splats.gaussian_ids), shape)
        elif math.prod(shape[:-1]) > 1:
            order = torch.sort(splats.camera_ids, stable=True)[1]
            self.places = Places((order,), tuple(order.shape))
        columns = (splats.means2d, splats.conics, splats.depths, splats.opacities)
        means2d, conics, depths, opacities = self.arrange(*columns, under=under)
        self.rendered = {"means2d": means2d, "conics": conics, "depths": depths, "opacities": opacities}

    def arrange(self, *columns: Tensor, under: Tensor | None = None) -> tuple[Tensor, ...]:
        """Arrange columns of splats as `Places.arrange` does."""
        return columns if self.places is None else self.places.arrange(columns, under)

    def splats_to_composite(
        self, gathered: bool, depths: bool
    ) -> tuple[ProjectedSplats, MetaGeometry | None]:
        """Return the splats to composite, and the geometry that gets the gradients in their place.

        `gathered`: gather the splats from `rendered`, as under `torch.compile` and where splats are sent on.
        Otherwise the splats are as they are, and compositing arranges their gradients. `depths`: whether an
        image depends on the depths.
        """
        splats, places, rendered = self.splats, self.places, self.rendered
        if places is None:
            return splats, None
        if gathered:
            columns = places.gather(list(rendered.values()))
            return splats._replace(**dict(zip(rendered, columns, strict=True))), None
        if depths:
            splats = splats._replace(depths=places.gather([rendered["depths"]])[0])
        geometry = [rendered[name] for name in ("means2d", "conics", "opacities")]
        return splats, MetaGeometry(places.arrange, geometry)

    def absgrad_store(self) -> Callable[[Tensor], None]:
        """Zero means2d's `absgrad`; return a function that fills it with the splats' gradients, [P, 2]."""
        absgrad = torch.zeros_like(self.rendered["means2d"])
        self.rendered["means2d"].absgrad = absgrad  # type: ignore[attr-defined]

        def store(gradient: Tensor) -> None:
            absgrad.copy_(self.arrange(gradient)[0])

        return store


@dataclass
class Lists:
    """The splats that each tile of all images composites."""

    splats: Tensor  # int32, splat indices; entries past the last offset are undefined
    offsets: Tensor  # int64 [I T + 1], where each tile's list begins
    grid: TileGrid  # the tiles
    _listed: Tensor | None = None

    def listed(self) -> Tensor:
        """Return `splats` without the undefined entries, which exist if splats are hidden."""
        if torch.compiler.is_compiling():  # `intersect` has counted the entries: none are undefined
            return self.splats
        if self._listed is None:  # once, because it waits for the device
            self._listed = self.splats[: int(self.offsets[-1])]
        return self._listed


def lists_of(
    splats: ProjectedSplats, images: int, projection: ProjectionOptions, count: int, pixels: Pixels | None
) -> tuple[Lists, Lists]:
    """Return the tile lists for meta, and those to composite.

    `count`: number of entries of the lists for meta; -1: unknown. `pixels`: the pixels that are rendered;
    lists of tiles without any are empty, and others are those of the whole image, so that these pixels have
    the same bits. None: all.
    """

    def listed_by(edge: int, n_isects: int) -> Lists:
        grid = TileGrid(images, projection.width, projection.height, edge)
        if pixels is not None:
            return _lists_of_pixels(splats, grid, pixels)
        own = (splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids)
        entries, offsets = torch.ops.blitzgs.intersect(*own, None, *grid, n_isects, unchecked=True)
        return Lists(entries, offsets, grid)

    lists = listed_by(projection.tile_size, count)
    if not splats.means2d.is_cuda or projection.tile_size == TILE_SIZE:
        return lists, lists
    # The CUDA kernels composite tiles of one size alone: only meta's lists have that which was asked for.
    return lists, listed_by(TILE_SIZE, -1)


def _lists_of_pixels(splats: ProjectedSplats, grid: TileGrid, pixels: Pixels) -> Lists:
    edge, (columns, rows) = grid.tile_size, grid.tiles
    wanted = torch.zeros(grid.n_cameras, rows, columns, dtype=torch.bool, device=splats.means2d.device)
    wanted[pixels.images, pixels.rows // edge, pixels.columns // edge] = True
    near = _splats_near(splats, wanted, edge)
    own = (splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids)
    chosen = [column.detach().index_select(0, near) for column in own]
    listed, offsets = torch.ops.blitzgs.intersect(*chosen, None, *grid, -1, unchecked=True)
    lengths, count = offsets.diff(), int(offsets[-1])
    kept = wanted.view(-1).repeat_interleave(lengths, output_size=count)
    ends = (lengths * wanted.view(-1)).cumsum(0)
    entries = near.index_select(0, listed[:count][kept]).int()
    return Lists(entries, torch.cat([ends.new_zeros(1), ends]), grid)


def _splats_near(splats: ProjectedSplats, wanted: Tensor, edge: int) -> Tensor:
    """Return the splats whose box overlaps a wanted tile, int64 [Q], in their order."""
    images, rows, columns = wanted.shape
    # Sums over all tiles above and left give the number of wanted tiles in a box from its corners.
    sums = torch.zeros(images, rows + 1, columns + 1, dtype=torch.int64, device=wanted.device)
    sums[:, 1:, 1:] = wanted.long().cumsum(1).cumsum(2)
    reach = splats.radii + 1
    most = torch.tensor([columns, rows], device=wanted.device)
    means = splats.means2d.detach()
    low = ((means - reach) / edge).floor().clamp(min=0).minimum(most).long()
    high = (((means + reach) / edge).floor() + 1).clamp(min=0).minimum(most).long()
    image = splats.camera_ids.long()
    (x0, y0), (x1, y1) = low.unbind(1), high.unbind(1)
    count = sums[image, y1, x1] - sums[image, y0, x1] - sums[image, y1, x0] + sums[image, y0, x0]
    return count.nonzero()[:, 0]
