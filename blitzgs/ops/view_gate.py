# SPDX-License-Identifier: Apache-2.0
"""The view level: removes (row, view) pairs from an active set before projection."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.blocks import ActiveRows, GateRules


def gate_views_(active: ActiveRows, means: Tensor, viewmats: Tensor, rules: GateRules) -> None:
    """Clear the bits of `active.views` for the (row, view) pairs that B views leave out; no row is removed.

    Args:
        active: rows of the table; their views are changed in place.
        means: float32 [N, 3], of which the listed rows are caught up.
        viewmats: float32 [B, 4, 4], rigid, world to camera, B <= 32.
        rules: which rows each view leaves out.

    Raises:
        RuntimeError: wrong shapes or dtypes, more than 32 views, no level, finer levels that reach farther,
            or a column that the cull matrix lacks.
    """
    level, reach, lod_views, cull, columns = rules
    with below_autograd():
        torch.ops.blitzgs.gate_views_(
            active.ids, active.views, active.length, means, level, viewmats, reach, lod_views, cull, columns
        )


@torch.library.register_fake("blitzgs::gate_views_")
def _(*_args: object) -> None:
    return None
