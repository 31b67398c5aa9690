# SPDX-License-Identifier: Apache-2.0
"""Finds what views see of a model, whether its table is on the device or on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.view_gate import gate_views_
from blitzgs.view.block_visibility import Cameras
from blitzgs.view.gate import SceneGate
from blitzgs.view.residence import Residence

# The Gaussians that views are rendered from: a table on the device, or a table on the host with its pool.
Scene = GaussianTable | Residence


class VisibleScene(NamedTuple):
    """The Gaussians to render for a batch of views.

    Attributes:
        table: a table on the device of the views.
        active: rows of `table` to render, and the views of each; None: all rows in all views.
        rows_of: maps rows of `table` to rows of the model, both int32.
    """

    table: GaussianTable
    active: ActiveRows | None
    rows_of: Callable[[Tensor], Tensor]


def table_of(scene: Scene) -> GaussianTable:
    """Return the table of all of this rank's Gaussians in a scene."""
    return scene.table if isinstance(scene, Residence) else scene


def find_visible(
    scene: Scene,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    limits: tuple[float, float, float],
    lod: SceneGate | None,
) -> VisibleScene:
    """Find the Gaussians to render for a batch of views. Collective if `lod` is given.

    Args:
        scene: the Gaussians, without pending optimiser steps.
        viewmats: float32 [B, 4, 4], world to camera, B <= 32.
        Ks: float32 [B, 3, 3], pixels.
        width: pixels.
        height: pixels.
        limits: near plane, far plane and eps2d.
        lod: leaves out rows whose octree level is too fine for their distance; None: no gate.

    Raises:
        ResidenceError: the pool is too small for the views.
    """
    if not isinstance(scene, Residence):
        active = None if lod is None else lod.active(scene, viewmats)
        return VisibleScene(scene, active, lambda rows: rows)
    sizes = torch.tensor([[width, height]] * len(viewmats), dtype=torch.int32).to(viewmats.device)
    index = scene.load_for_views(Cameras(viewmats, Ks, sizes, limits))
    pool = scene.pool
    rules = None if lod is None else lod.rules(pool["level"], viewmats)
    active = index.active(pool, viewmats, Ks, width, height, *limits, rules)
    if rules is not None:
        gate_views_(active, pool["means"], viewmats, rules)
    return VisibleScene(pool, active, scene.rows_of)
