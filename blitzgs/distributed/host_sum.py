# SPDX-License-Identifier: Apache-2.0
"""Adds up numbers of all ranks for the host, which reads them after the step, without delaying the step."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.host import current_stream
from blitzgs.ops.report import report_


class HostSum:
    """Sums of the loss over all ranks, and the costs of all tiles, which the host reads later. Collective.

    On CUDA the work is queued on a second stream, after the work that is queued on the step's stream so far;
    only `read` waits. Ranks that share memory write the numbers to each other's memory, other ranks use an
    all-reduce. On the CPU the constructor computes the sums.
    """

    def __init__(
        self,
        ranks: Ranks,
        parts: Tensor | None = None,
        tile_work: Tensor | None = None,
        tiles: tuple[int, int] = (0, 0),
    ) -> None:
        """Queue the sums.

        Args:
            ranks: the job.
            parts: float64 [B, K, 2], sums of this rank's loss in parts (`photometric_fwd_bwd`); None: none.
            tile_work: int32 [T], number of list entries that were composited in each tile; None: none.
            tiles: the tiles of this rank, [first, one past last).
        """
        self._ranks = ranks
        self._sums = 0 if parts is None else 2 * parts.shape[0]
        self._copied: torch.cuda.Event | None = None
        words = ranks.world_size * self._sums + (0 if tile_work is None else tile_work.shape[0])
        self._total: Tensor | None = None
        stream = _side_stream(ranks.device)
        if stream is None:
            self._value = torch.zeros(words)
            report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, [self._value])
            ranks.all_reduce(self._value)
            return
        main = current_stream(ranks.device)
        stream.wait_stream(main)
        # The context manager of a stream takes longer: it asks for the current device and stream again.
        torch.cuda.set_stream(stream)
        try:
            self._copied = self._queue(parts, tile_work, tiles, words, stream)
        finally:
            torch.cuda.set_stream(main)
        for tensor in (parts, tile_work):
            if tensor is not None:
                tensor.record_stream(stream)

    def _queue(
        self,
        parts: Tensor | None,
        tile_work: Tensor | None,
        tiles: tuple[int, int],
        words: int,
        stream: torch.cuda.Stream,
    ) -> torch.cuda.Event:
        """Queue the sums, of `words` words, and their copy to the host on `stream`, the current one."""
        ranks = self._ranks
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
        copied = torch.cuda.Event()
        copied.record(stream)
        return copied

    def read(self) -> Tensor:
        """Return the sums, float32 on the CPU, the same bits on every rank. The first call waits for them.

        The result has the sum of |render - photograph| of each of the B views, then the sum of the SSIM map
        of each view, then the cost of each of the T tiles.
        """
        if self._total is None:
            if self._copied is not None:
                with self._ranks.watchdog.waiting("read_sums"):
                    self._copied.synchronize()
            self._total = self._folded(self._value)
            del self._value  # so that the next object can use its pinned memory
        return self._total

    def _folded(self, value: Tensor) -> Tensor:
        """Add up the sums of the ranks in the order of the ranks; the result is a copy."""
        numbers, end = value.numpy(), self._ranks.world_size * self._sums
        total = numbers[:end].reshape(self._ranks.world_size, self._sums).sum(0)
        return torch.from_numpy(np.concatenate((total, numbers[end:])))


@lru_cache(maxsize=16)
def _side_stream(device: torch.device) -> torch.cuda.Stream | None:
    """Return the device's stream for work that the step does not wait for; None on the CPU."""
    return torch.cuda.Stream(device) if device.type == "cuda" else None
