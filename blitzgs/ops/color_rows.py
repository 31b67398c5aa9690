# SPDX-License-Identifier: Apache-2.0
"""Gathers the Gaussians that views see, and computes the colours of their splats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs


class VisibleRows(NamedTuple):
    """The visible Gaussians of a projection, gathered.

    Attributes:
        inputs: the inputs of the projection with these Gaussians alone, and their SH.
        numbers: int32 [U], 0 to U - 1: the rows of `inputs` that are visible.
        indices: int64 [U], the Gaussians, as the indices of sparse gradients.
    """

    inputs: ProjectionInputs
    numbers: Tensor
    indices: Tensor


def colored_rows(
    splats: ProjectedSplats, tables: ProjectionInputs, sh: Sequence[Tensor], totals: Tensor | None = None
) -> tuple[ProjectedSplats, VisibleRows]:
    """Gather the visible Gaussians and colour their splats, without gradients.

    Args:
        splats: those of `tables`. Splats whose colour is not finite are hidden in place.
        tables: the inputs of the projection, without SH.
        sh: the SH of all Gaussians in parts, [N, L, 3] each; empty: the splats have no colours.
        totals: `ProjectionOutputs.totals` if the splats have spare capacity (CUDA); the contents of the
            results are undefined if they do not fit it.

    Returns:
        The splats with colours, and the rows, both of the capacity of `splats`.
    """
    with below_autograd():
        numbers, indices, colors, *gaussians = torch.ops.blitzgs.color_rows_(
            tables.gaussians,
            sh,
            tables.cameras,
            [splats.visible_ids, splats.splat_offsets, splats.camera_ids],
            [splats.opacities, splats.radii, splats.tiles_touched],
            tables.options.ints,
            tables.options.floats,
            totals,
        )
    return splats._replace(colors=colors), VisibleRows(tables._replace(gaussians=gaussians), numbers, indices)


@torch.library.register_fake("blitzgs::color_rows_")
def _(
    tables: Sequence[Tensor],
    sh: Sequence[Tensor],
    cameras: Sequence[Tensor],
    splats: Sequence[Tensor],
    *_others: object,
) -> list[Tensor]:
    visible_ids, _, camera_ids = splats
    rows = [table.new_empty((len(visible_ids), *table.shape[1:])) for table in tables]
    if sh:
        rows.append(sh[0].new_empty((len(visible_ids), sum(part.shape[1] for part in sh), 3)))
    colors = tables[0].new_empty(len(camera_ids) if sh else 0, 3)
    indices = visible_ids.new_empty(len(visible_ids), dtype=torch.int64)
    return [torch.empty_like(visible_ids), indices, colors, *rows]
