# SPDX-License-Identifier: Apache-2.0
"""Adds up numbers of all ranks for the host, which reads them after the step, without delaying the step."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.host import PinnedNumbers, current_stream
from blitzgs.ops.photometric import report_


class _Side(NamedTuple):
    """A second stream of a device, for work that the step does not wait for.

    Only one thread at a time may use it: a second thread could record `ready` again before the first one has
    made the stream wait for it.
    """

    stream: torch.cuda.Stream  # the second stream
    # Event by which the second stream waits for the step's stream. It is recorded on the step's stream before
    # each use of the second one; a new record does not change waits that are queued.
    ready: torch.cuda.Event


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

        `parts`: float64 [B, K, 2], sums of this rank's loss in parts (`photometric_fwd_bwd`); None: none.
        `tile_work`: int32 [T], number of list entries that were composited in each tile; None: none. `tiles`:
        the tiles of this rank, [first, one past last).
        """
        self._ranks = ranks
        self._sums = 0 if parts is None else 2 * parts.shape[0]
        self._total: Tensor | None = None
        self._pinned: PinnedNumbers | None = None
        self._tensors: tuple[Tensor | None, ...] = ()
        words = ranks.world_size * self._sums + (0 if tile_work is None else tile_work.shape[0])
        self._side = side = _side_of(ranks.device)
        if side is None:
            value = torch.zeros(words)
            report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, [value])
            self._numbers = ranks.all_reduce(value).numpy()
            return
        # Powers of two, so that images of many sizes share few pieces of pinned memory.
        self._pinned = PinnedNumbers.take(1 << (words - 1).bit_length(), torch.float32, side.stream.device)
        # Torch assumes that the tensors of the step are used on the step's stream alone, and gives their
        # memory to new tensors as soon as no variable refers to them. They are kept until the second stream
        # has read them.
        self._tensors = parts, tile_work
        memory = self._pinned.memory[:words]
        self._numbers = memory.numpy()
        main = current_stream(ranks.device)
        side.ready.record(main)
        side.stream.wait_event(side.ready)
        # The context manager of a stream takes longer: it asks for the current device and stream again.
        torch.cuda.set_stream(side.stream)
        try:
            total = self._queue(parts, tile_work, tiles, words)
            memory.copy_(total, non_blocking=True)
            self._pinned.written.record(side.stream)
        finally:
            torch.cuda.set_stream(main)

    def _queue(
        self, parts: Tensor | None, tile_work: Tensor | None, tiles: tuple[int, int], words: int
    ) -> Tensor:
        """Queue the report of all ranks, float32 [words] on the device, on the current stream."""
        ranks = self._ranks
        if ranks.memory is not None:
            with ranks.watchdog.waiting("boards"):
                boards = ranks.memory.boards(words)
            report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, boards)
            ranks.memory.side_barrier()
            return boards[ranks.rank]
        new = torch.empty if ranks.world_size == 1 else torch.zeros
        total = new(words, device=ranks.device)
        report_(parts, tile_work, tiles, ranks.rank, ranks.world_size, [total])
        return ranks.all_reduce(total)

    def read(self) -> Tensor:
        """Return the sums, float32 on the CPU, the same bits on every rank. The first call waits for them.

        The result has the sum of |render - photograph| of each of the B views, then the sum of the SSIM map
        of each view, then the cost of each of the T tiles.
        """
        if self._total is None:
            if self._pinned is not None:
                with self._ranks.watchdog.waiting("read_sums"):
                    self._pinned.written.synchronize()
            self._total = self._folded(self._numbers)
            del self._numbers
            if self._pinned is not None:
                self._pinned.give_back()
                self._pinned, self._tensors = None, ()
        return self._total

    def __del__(self) -> None:
        # If the host never read the sums, the second stream may still use the tensors, so torch must not
        # reuse their memory before that stream has passed this point. (Torch delays the reuse of the pinned
        # memory itself, because it queued the copy.) The host does not wait here: if a rank has failed, the
        # sums never arrive.
        for tensor in self._tensors:
            if tensor is not None and self._side is not None:
                tensor.record_stream(self._side.stream)

    def _folded(self, numbers: NDArray[np.float32]) -> Tensor:
        """Add up the sums of the ranks in the order of the ranks; the result is a copy."""
        end = self._ranks.world_size * self._sums
        # The costs follow the sums of the last rank. Copy both; the totals then replace that rank's sums.
        total = numbers[end - self._sums :].copy()
        if self._ranks.world_size > 1:
            of_ranks = numbers[:end].reshape(self._ranks.world_size, self._sums)
            np.add.reduce(of_ranks, 0, out=total[: self._sums])
        return torch.from_numpy(total)


@lru_cache(maxsize=16)
def _side_of(device: torch.device) -> _Side | None:
    return _Side(torch.cuda.Stream(device), torch.cuda.Event()) if device.type == "cuda" else None
