# SPDX-License-Identifier: Apache-2.0
"""Gathers numbers from the ranks that only the host reads, later, without delaying the step."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.report import report_


class HostSum:
    """The loss's sums over all ranks and what every rank's tiles cost, on their way to the host. Collective.

    On CUDA everything happens on a stream beside the step's, after what was queued so far; only `read`
    waits. Ranks that share memory write to one another, others add up by a collective. On the CPU the sum is
    there at once.
    """

    def __init__(
        self,
        ranks: Ranks,
        parts: Tensor | None = None,
        tile_work: Tensor | None = None,
        tiles: tuple[int, int] = (0, 0),
    ) -> None:
        """Start to gather.

        Args:
            ranks: the job.
            parts: float64 [B, K, 2], sums of this rank's loss in parts (`photometric_fwd_bwd`); None: none.
            tile_work: int32 [T], list entries each tile went through; None: none.
            tiles: those of this rank, [first, one past last).
        """
        self._ranks = ranks
        self._sums = 0 if parts is None else 2 * len(parts)
        self._copied: torch.cuda.Event | None = None
        words = ranks.world_size * self._sums + (0 if tile_work is None else len(tile_work))
        self._total: Tensor | None = None
        stream = _side_stream(ranks.device)
        if stream is None:
            self._value = torch.zeros(words)
            report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, [self._value])
            ranks.all_reduce(self._value)
            return
        stream.wait_stream(torch.cuda.current_stream(ranks.device))
        with torch.cuda.stream(stream):
            if ranks.memory is not None:
                with ranks.watchdog.waiting("boards"):
                    boards = ranks.memory.boards(words)
                report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, boards)
                ranks.memory.side_barrier()
                total = boards[ranks.rank]
            else:
                new = torch.empty if ranks.world_size == 1 else torch.zeros
                total = new(words, device=ranks.device)
                report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, [total])
                ranks.all_reduce(total)
            self._value = torch.empty(words, pin_memory=True)
            self._value.copy_(total, non_blocking=True)
            self._copied = torch.cuda.Event()
            self._copied.record(stream)
        for tensor in (parts, tile_work):
            if tensor is not None:
                tensor.record_stream(stream)

    def read(self) -> Tensor:
        """Return the sums, float32 on the CPU, the same bits on every rank; waits for them the first time.

        The B views' sums of |render - photograph|, those of the SSIM map, the T tiles' work.
        """
        if self._total is None:
            if self._copied is not None:
                with self._ranks.watchdog.waiting("read_sums"):
                    self._copied.synchronize()
            self._total = self._folded(self._value)
            del self._value  # pinned memory serves the next one
        return self._total

    def _folded(self, value: Tensor) -> Tensor:
        """Add up the sums of the ranks, in their order; a copy."""
        numbers, end = value.numpy(), self._ranks.world_size * self._sums
        total = numbers[:end].reshape(self._ranks.world_size, self._sums).sum(0)
        return torch.from_numpy(np.concatenate((total, numbers[end:])))


@lru_cache(maxsize=16)
def _side_stream(device: torch.device) -> torch.cuda.Stream | None:
    """Return the stream for what the step need not wait for, one for each device; None on the CPU."""
    return torch.cuda.Stream(device) if device.type == "cuda" else None
