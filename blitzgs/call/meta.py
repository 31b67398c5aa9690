# SPDX-License-Identifier: Apache-2.0
"""Makes the `meta` of `blitzgs.rasterization`, with gsplat's keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians
from blitzgs.call.finite import non_finite
from blitzgs.call.layout import Layout
from blitzgs.call.lazy_dict import LateMapping, Later, LazyDict
from blitzgs.ops.projection_types import ProjectedSplats


@dataclass
class Lists:
    """The splats that each tile of all images composites.

    Attributes:
        splats: int32, splat indices; entries past the last offset are undefined.
        offsets: int64 [I T + 1], where each tile's list begins.
        width: image width in px.
        height: image height in px.
        tile_size: edge of a tile in px.
    """

    splats: Tensor
    offsets: Tensor
    width: int
    height: int
    tile_size: int
    _listed: Tensor | None = None

    @property
    def tiles_x(self) -> int:
        """Number of tiles in a row."""
        return -(-self.width // self.tile_size)

    @property
    def tiles_y(self) -> int:
        """Number of tiles in a column."""
        return -(-self.height // self.tile_size)

    def listed(self) -> Tensor:
        """Return `splats` without the undefined entries, which exist if splats are hidden."""
        if torch.compiler.is_compiling():  # `intersect` has counted the entries: none are undefined
            return self.splats
        if self._listed is None:  # once, because it waits for the device
            self._listed = self.splats[: int(self.offsets[-1])]
        return self._listed


def make_meta(
    gaussians: Gaussians,
    layout: Layout,
    arranged: dict[str, Tensor],
    lists: Lists,
    lead: tuple[int, ...],
    arrived: ProjectedSplats | None,
) -> dict[str, Any]:
    """Return `meta`; entries that the image did not need are computed when they are first read.

    Under `torch.compile` it is a plain dict, and the compiler removes entries that the caller does not read.

    Args:
        gaussians: the checked arguments of the call.
        layout: arrangement of the splats.
        arranged: the rendered columns in this arrangement.
        lists: the tile lists.
        lead: batch dimensions, and the number of views that are rendered here.
        arrived: the splats that `lists` refers to, if ranks have exchanged splats; None: those of `layout`.
    """
    splats, packed = layout.splats, layout.packed
    views = gaussians.views

    def flatten_ids() -> Tensor:
        if layout.places is None or arrived is not None:
            return lists.listed()
        return layout.places.flat().index_select(0, lists.listed()).int()

    def batch_ids() -> Tensor:
        if len(gaussians.scenes) == 1:
            return torch.zeros_like(splats.camera_ids, dtype=torch.int64)
        return layout.arrange(layout.images // views)[0]

    def camera_ids() -> Tensor:
        ids = splats.camera_ids.long()
        return layout.arrange(ids if len(gaussians.scenes) == 1 else ids % views)[0]

    entries: dict[str, Any] = {
        "batch_ids": Later(batch_ids) if packed else None,
        "camera_ids": Later(camera_ids) if packed else None,
        "gaussian_ids": Later(lambda: layout.arrange(layout.gaussians)[0]) if packed else None,
        "radii": Later(lambda: layout.arrange(splats.radii)[0]),
        **arranged,
        "tile_width": lists.tiles_x,
        "tile_height": lists.tiles_y,
        "tiles_per_gauss": Later(lambda: layout.arrange(splats.tiles_touched)[0]),
        "isect_ids": Later(lambda: _isect_ids((arrived or splats).depths, lists, math.prod(lead))),
        "flatten_ids": Later(flatten_ids),
        "isect_offsets": Later(lambda: lists.offsets[:-1].reshape(*lead, lists.tiles_y, lists.tiles_x)),
        "width": lists.width,
        "height": lists.height,
        "tile_size": lists.tile_size,
        "n_batches": len(gaussians.scenes),
        "n_cameras": lead[-1],
    }
    if torch.compiler.is_compiling():
        return {key: value.compute() if isinstance(value, Later) else value for key, value in entries.items()}
    entries["non_finite"] = LateMapping(lambda: non_finite(gaussians))
    return LazyDict(entries)


def _isect_ids(depths: Tensor, lists: Lists, images: int) -> Tensor:
    """Return gsplat's sort keys, int64: image | tile | float32 depth bits, from high to low."""
    depths = depths.detach().index_select(0, lists.listed())
    entries = torch.arange(len(depths), device=depths.device)
    keys = torch.searchsorted(lists.offsets[1:], entries, right=True)
    n_tiles = lists.tiles_x * lists.tiles_y
    if images > 1:
        keys = keys + keys // n_tiles * ((1 << n_tiles.bit_length()) - n_tiles)
    return keys.bitwise_left_shift(32).bitwise_or(depths.float().view(torch.int32))
