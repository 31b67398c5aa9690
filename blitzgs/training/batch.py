# SPDX-License-Identifier: Apache-2.0
"""What a training step reads: the views of a batch and their photographs."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from blitzgs.frame.frame import Views
from blitzgs.frame.tiles import TileRanges


@dataclass(frozen=True)
class Batch:
    """One step's views and photographs on the device.

    Attributes:
        indices: the B cameras of the batch, as indices into the capture.
        views: the same cameras as the renderer takes them, at the resolution of the step.
        targets: uint8 [B, H, W, 3]; on several ranks, undefined outside the pixels that this rank's loss
            reads.
        masks: uint8 [B, H, W], 0 = excluded pixel; None when no view of the batch has a mask.
        samples: float32 [B], number of values in a view's mean: 3 x its pixels that count, at least 1.
        ranges: the tiles of each rank; None on one rank.
    """

    indices: list[int]
    views: Views
    targets: Tensor
    masks: Tensor | None
    samples: Tensor
    ranges: TileRanges | None
