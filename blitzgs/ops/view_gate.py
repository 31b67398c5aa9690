# SPDX-License-Identifier: Apache-2.0
"""The view level: what views leave out of an active set before projection."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.blocks import ActiveRows, GateRules


@torch.no_grad()
def gate_views_(active: ActiveRows, means: Tensor, viewmats: Tensor, rules: GateRules) -> None:
    """Clear, in `active.views`, the bits of the pairs that B views leave out. The rows stay listed.

    Args:
        active: rows of the table; their views are changed in place.
        means: float32 [N, 3], of which the listed rows are caught up.
        viewmats: float32 [B, 4, 4], rigid, world to camera, B <= 32.
        rules: what is left out.

    Raises:
        RuntimeError: wrong shapes or dtypes, more than 32 views, no level, finer levels that reach farther,
            or a column that the cull matrix lacks.
    """
    level, reach, lod_views, cull, columns = rules
    torch.ops.blitzgs.gate_views_(
        active.ids, active.views, active.length, means, level, viewmats, reach, lod_views, cull, columns
    )


@torch.library.register_fake("blitzgs::gate_views_")
def _(*_args: object) -> None:
    return None
