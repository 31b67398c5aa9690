# SPDX-License-Identifier: Apache-2.0
"""The view level: what views leave out of an active set before projection."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.blocks import ActiveRows


@torch.no_grad()
def gate_views_(
    active: ActiveRows,
    means: Tensor,
    level: Tensor,
    viewmats: Tensor,
    reach: Sequence[float],
    lod_views: int,
    cull: Tensor | None = None,
    columns: Sequence[int] = (),
) -> None:
    """Clear, in `active.views`, the bits of the pairs that B views leave out (paper Eq. 1 and 2, then 5).

    A view with an LOD gate leaves out the rows of each level l farther than `reach[l]` from its centre; a
    view with a column of the cull matrix those whose bit is set. The rows stay listed.

    Args:
        active: rows of the table; their views are changed in place.
        means: float32 [N, 3], of which the listed rows are caught up.
        level: uint8 [N]; a level beyond the last of `reach` counts as the last.
        viewmats: float32 [B, 4, 4], rigid, world to camera, B <= 32.
        reach: for each of 1 to 32 levels the distance up to which it is kept, in the unit of the means;
            negative: nowhere.
        lod_views: bit v is set when view v has an LOD gate.
        cull: int32 [N, words], `blitzgs.population.importance.Importance.cull`.
        columns: of `cull`, one for each view; negative: the view has no mask. Empty: no view has one.

    Raises:
        RuntimeError: wrong shapes or dtypes, more than 32 views, no level, or a column that `cull` lacks.
    """
    torch.ops.blitzgs.gate_views_(
        active.ids,
        active.views,
        active.length,
        means,
        level,
        viewmats,
        list(reach),
        lod_views,
        cull,
        list(columns),
    )


@torch.library.register_fake("blitzgs::gate_views_")
def _(*_args: object) -> None:
    return None
