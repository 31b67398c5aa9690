# SPDX-License-Identifier: Apache-2.0
"""Finds which blocks the views of the present and of the next steps may see."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.ops.blocks import WORD_BITS, seen_blocks
from blitzgs.ops.projection_types import MAX_VIEWS

_MAX_WORDS = 1 << 26  # words of a mask that are processed together
UNSEEN = MAX_VIEWS  # above the numbers of all batches


class Cameras(NamedTuple):
    """Views of any sizes, on the device, and the limits they share.

    Attributes:
        viewmats: float32 [V, 4, 4], world to camera.
        Ks: float32 [V, 3, 3], pixels.
        sizes: int32 [V, 2], width and height, pixels.
        limits: near plane, far plane and eps2d, as `blitzgs.ops.blocks.cull_blocks` has them.
        columns: the views' columns in the cull matrix, int64 [V]; None: the views have no mask.
    """

    viewmats: Tensor
    Ks: Tensor
    sizes: Tensor
    limits: tuple[float, float, float]
    columns: Tensor | None = None


class BlockVisibility:
    """Tests which blocks the views of several batches may see; copies the result to the host asynchronously.

    Attributes:
        batches: number of batches.
    """

    def __init__(
        self, bounds: Tensor, cameras: Cameras, batch_size: int, culled: Tensor | None = None
    ) -> None:
        """Queue the test.

        Args:
            bounds: bounds of N blocks, float32 [N, 8].
            cameras: views of consecutive batches, at most 32.
            batch_size: views per batch.
            culled: result of `culled_blocks` for the same blocks; None: there is no cull mask.
        """
        self._batch_size = batch_size
        self.batches = len(cameras.viewmats) // batch_size
        seen = seen_blocks(bounds, cameras.viewmats, cameras.Ks, cameras.sizes, *cameras.limits)
        if culled is not None and cameras.columns is not None:
            seen &= ~_culling_views(culled, cameras.columns)
        self._event: torch.cuda.Event | None = None
        if seen.is_cuda:
            host = torch.empty(seen.shape, dtype=seen.dtype, pin_memory=True)
            host.copy_(seen, non_blocking=True)
            self._event = torch.cuda.current_stream(seen.device).record_event()
            seen = host
        self._seen = seen

    def _read(self) -> npt.NDArray[np.uint32]:
        if self._event is not None:
            self._event.synchronize()
            self._event = None
        return self._seen.numpy().view(np.uint32)

    def blocks_of_batch(self, batch: int) -> npt.NDArray[np.bool_]:
        """Return which blocks a batch (0 is the first) may see, bool [N]; waits for the device."""
        bits = ((1 << self._batch_size) - 1) << batch * self._batch_size
        found: npt.NDArray[np.bool_] = (self._read() & np.uint32(bits & 0xFFFFFFFF)) != 0
        return found

    @cached_property
    def next_use(self) -> npt.NDArray[np.uint8]:
        """The first batch that may see each block, [N]; `UNSEEN` if none may. Waits for the device."""
        seen = self._read()
        # The exponent of the lowest set bit as a float32 is the number of the first view; 0 without a bit.
        exponents = (seen & (~seen + np.uint32(1))).astype(np.float32).view(np.int32) >> 23
        batch_of = np.full(127 + MAX_VIEWS, UNSEEN, dtype=np.uint8)
        batch_of[127:] = np.arange(MAX_VIEWS) // self._batch_size
        found: npt.NDArray[np.uint8] = batch_of[exponents]
        return found


def culled_blocks(cull: Tensor) -> Tensor:
    """Return, as bits, the views that leave out all rows of each block, int32 [N, columns / 32].

    Args:
        cull: int32 [N, columns, 8], see `blitzgs.ops.blocks`; of whole blocks.
    """
    bits = torch.arange(WORD_BITS, device=cull.device)
    length = max(1, _MAX_WORDS // max(1, cull[:1].numel()))
    parts = [cull.new_empty(0, cull.shape[1] // WORD_BITS)]
    for some in cull.split(length):
        is_culled = (some == -1).all(2).view(len(some), cull.shape[1] // WORD_BITS, WORD_BITS)
        parts.append((is_culled.long() << bits).sum(2).int())
    return torch.cat(parts)


def _culling_views(culled: Tensor, columns: Tensor) -> Tensor:
    """Return for each block the bits of the views (of columns [V]) that leave out all its rows, int32 [N]."""
    # In place and in 32 bits, because these are as many numbers as the table has blocks, for each view.
    found = culled[:, columns // WORD_BITS]
    found >>= (columns % WORD_BITS).int()
    found &= 1
    found <<= torch.arange(len(columns), dtype=torch.int32, device=columns.device)
    return found.sum(1, dtype=torch.int32)
