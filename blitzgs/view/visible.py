# SPDX-License-Identifier: Apache-2.0
"""Finds what views see of a model, whether its table is on the device or on the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.frame.render import RenderOptions
from blitzgs.ops.blocks import ActiveRows, gate_views_
from blitzgs.ops.projection_types import Views
from blitzgs.table.blocks import BlockIndex, Cameras
from blitzgs.table.pool import Pool
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import ModelGate
from blitzgs.view.views import Space

# The Gaussians that views are rendered from: a table on the device, or a table on the host with its pool.
TableOrPool = GaussianTable | Pool

# Depths are chosen among so many quantiles.
_DEPTHS = 64


@dataclass(frozen=True)
class Subject:
    """The model that is drawn, as it is at one moment."""

    # This rank's. Pending optimiser steps are not applied, so that looking at a training does not change it;
    # the rows that wait for them are off by far less than a pixel.
    gaussians: TableOrPool
    options: RenderOptions  # how the model is rendered, at its present spherical-harmonics degree
    space: Space  # maps the trained world to the capture's
    lod: ModelGate | None  # the LOD gate; None: there is none


class VisibleRows(NamedTuple):
    """The Gaussians to render for a batch of views."""

    table: GaussianTable  # a table on the device of the views
    active: ActiveRows  # rows of `table` to render, and the views of each
    rows_of: Callable[[Tensor], Tensor]  # maps rows of `table` to rows of the model, both int32


def table_of(gaussians: TableOrPool) -> GaussianTable:
    """Return the table of all of this rank's Gaussians."""
    return gaussians.table if isinstance(gaussians, Pool) else gaussians


class VisibleFinder:
    """Finds the Gaussians to render for batches of views of a model that stays as it is meanwhile.

    Blocks of Gaussians that no view of a batch may see are not read.
    """

    def __init__(self, gaussians: TableOrPool, lod: ModelGate | None = None) -> None:
        """Compute the bounds of blocks, unless a pool has them; no optimiser steps are pending."""
        self._gaussians, self._lod = gaussians, lod
        self._index = None if isinstance(gaussians, Pool) else BlockIndex(gaussians)

    def depths(self, views: Views, planes: Sequence[float], blocks: int) -> list[float]:
        """Divide the depths of one view such that about a number of blocks lies between two of them.

        `planes`: the near and the far plane, which begin and end the result. Only these if few blocks are in
        the view, or if the Gaussians are in a pool, which bounds the memory anyway.
        """
        near, far = planes
        if self._index is None or len(self._index.bounds) <= blocks:
            return [near, far]
        low, high = self._index.bounds[:, :3], self._index.bounds[:, 3:6]
        reach = (high - low).norm(dim=1) / 2
        x, y, z = ((low + high) / 2 @ views.viewmats[0, :3, :3].T + views.viewmats[0, :3, 3]).unbind(1)
        (fx, _, cx), (_, fy, cy), _ = views.Ks[0].unbind(0)
        inside = (z + reach > near) & (z - reach < far)
        for place, focal, centre, size in ((x, fx, cx, views.width), (y, fy, cy, views.height)):
            middle = place + z * (centre - size / 2) / focal
            inside &= middle.abs() < (z.abs() + reach) * (size / 2 / focal) + reach
        ordered = z.where(inside, torch.inf).sort().values
        count = inside.sum()
        parts = torch.arange(1, _DEPTHS, device=z.device) * count // _DEPTHS
        found: list[float] = torch.cat((count[None].float(), ordered[parts])).tolist()
        layers = min(_DEPTHS, -(-int(found[0]) // blocks))
        inner = {found[_DEPTHS * k // layers] for k in range(1, layers)}
        return [near, *sorted(depth for depth in inner if near < depth < far), far]

    def find(self, views: Views, limits: tuple[float, float, float], room: int | None = None) -> VisibleRows:
        """Find the Gaussians to render for at most 32 views. Collective if there is a gate.

        `limits`: near plane, far plane and eps2d. `room`: the lists have room for so many blocks and their
        number tells whether that sufficed; None: for all. PoolError: the pool is too small for the views.
        """
        gaussians, index = self._gaussians, self._index
        if isinstance(gaussians, Pool):
            sizes = torch.tensor([[views.width, views.height]] * len(views), dtype=torch.int32)
            cameras = Cameras(views.viewmats, views.Ks, sizes.to(views.viewmats.device), limits)
            index = gaussians.load_for_views(cameras)
            table, rows_of = gaussians.held, gaussians.rows_of
        else:
            table, rows_of = gaussians, lambda rows: rows
        assert index is not None
        rules = None if self._lod is None else self._lod.rules(table["level"], views.viewmats)
        # Either way, the host does not wait for the number of blocks.
        active = index.active(table, views, limits, rules, room or max(1, len(index.bounds)))
        if room is None:
            active = active._replace(blocks=None)
        if rules is not None:
            gate_views_(active, table["means"], views.viewmats, rules)
        return VisibleRows(table, active, rows_of)
