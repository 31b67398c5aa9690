# SPDX-License-Identifier: Apache-2.0
"""Finds what views see of a model, whether its table is on the device or on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.blocks import ActiveRows, gate_views_
from blitzgs.table.block_visibility import Cameras
from blitzgs.table.blocks import BlockIndex
from blitzgs.table.pool import Pool
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import SceneGate

# The Gaussians that views are rendered from: a table on the device, or a table on the host with its pool.
Scene = GaussianTable | Pool


class VisibleScene(NamedTuple):
    """The Gaussians to render for a batch of views.

    Attributes:
        table: a table on the device of the views.
        active: rows of `table` to render, and the views of each.
        rows_of: maps rows of `table` to rows of the model, both int32.
    """

    table: GaussianTable
    active: ActiveRows
    rows_of: Callable[[Tensor], Tensor]


def table_of(scene: Scene) -> GaussianTable:
    """Return the table of all of this rank's Gaussians in a scene."""
    return scene.table if isinstance(scene, Pool) else scene


class VisibleFinder:
    """Finds the Gaussians to render for batches of views of a scene that stays as it is meanwhile.

    Blocks of Gaussians that no view of a batch may see are not read.
    """

    def __init__(self, scene: Scene, lod: SceneGate | None = None) -> None:
        """Compute the bounds of the scene's blocks, unless its pool has them.

        Args:
            scene: this rank's Gaussians, without pending optimiser steps.
            lod: leaves out rows whose octree level is too fine for their distance; None: no gate.
        """
        self._scene, self._lod = scene, lod
        self._index = None if isinstance(scene, Pool) else BlockIndex(scene)

    def find(
        self, viewmats: Tensor, Ks: Tensor, width: int, height: int, limits: tuple[float, float, float]
    ) -> VisibleScene:
        """Find the Gaussians to render for a batch of views. Collective if there is a gate.

        Args:
            viewmats: float32 [B, 4, 4], world to camera, B <= 32.
            Ks: float32 [B, 3, 3], pixels.
            width: pixels.
            height: pixels.
            limits: near plane, far plane and eps2d.

        Raises:
            PoolError: the pool is too small for the views.
        """
        scene, index = self._scene, self._index
        if isinstance(scene, Pool):
            sizes = torch.tensor([[width, height]] * len(viewmats), dtype=torch.int32).to(viewmats.device)
            index = scene.load_for_views(Cameras(viewmats, Ks, sizes, limits))
            table, rows_of = scene.held, scene.rows_of
        else:
            table, rows_of = scene, _same_rows
        assert index is not None
        rules = None if self._lod is None else self._lod.rules(table["level"], viewmats)
        # The lists have room for all blocks, so that the host does not wait for the number of blocks.
        room = max(1, len(index.bounds))
        active = index.active(table, viewmats, Ks, width, height, *limits, rules, room)._replace(blocks=None)
        if rules is not None:
            gate_views_(active, table["means"], viewmats, rules)
        return VisibleScene(table, active, rows_of)


def _same_rows(rows: Tensor) -> Tensor:
    return rows
