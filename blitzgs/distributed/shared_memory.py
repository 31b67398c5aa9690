# SPDX-License-Identifier: Apache-2.0
"""Memory that the ranks of one host share, and barriers between their streams.

Each rank owns memory that all others have mapped (NVLink or PCIe peer access):

- a few control words: the number of the last barrier that each rank reached, and the numbers that it wrote
  for this barrier;
- a buffer that grows, for the transport of splats (`blitzgs.frame.transport.peer`);
- a board, on which ranks publish numbers for the hosts (`HostSum`); it has its own stream and its own
  barriers.

A barrier delays streams, not hosts: work that any rank queues after a barrier begins when all work that the
ranks queued before it has ended. The numbers of barriers are double-buffered: a rank that has left a barrier
may not have read its numbers yet when another rank writes those of the next barrier. A rank must queue its
reads of the numbers before it queues the next barrier with numbers. The same holds for the board and its
barriers. Each rank stores the sums of the numbers for itself; its second barrier with numbers after this one
overwrites them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor
from torch._C._distributed_c10d import _SymmetricMemory

import blitzgs._library  # noqa: F401  (registers the ops)

# Largest number of values that a rank may write for a barrier; there is memory for two barriers, and for
# their sums.
MAX_VALUES = 256
LEAST_WORDS = 1 << 20
LEAST_BOARD = 1 << 16


class Shared(NamedTuple):
    """The numbers that all ranks wrote for a barrier."""

    everyone: Tensor  # int64 [M, n], the numbers of each rank; valid until the next barrier with numbers
    # int64 [n], sums over the ranks; valid until this rank queues the second barrier with numbers after this.
    sums: Tensor
    # `everyone` on the CPU, valid after the work queued on the current stream has ended, and as long as
    # `sums`.
    host: Tensor


def control_words(world_size: int) -> int:
    """Return the number of a rank's control words: barriers, numbers and sums, barriers of the board."""
    return world_size + 2 * MAX_VALUES * (world_size + 1) + world_size


class SharedMemory:
    """The shared memory of the ranks; make it with `connect`."""

    def __init__(
        self, rank: int, world_size: int, device: torch.device, control: Tensor, timeout_seconds: float
    ) -> None:
        """Map this rank's control words, symmetric memory of `control_words` zeros, on all ranks."""
        self.rank, self.world_size, self.device = rank, world_size, device
        self.timeout_seconds = timeout_seconds
        self.buffers: list[Tensor] = []  # int32 [words] of each rank, mapped here
        # How many times splats were written into the buffers; identifies the frame they belong to.
        self.generation = 0
        self._barriers = 0
        self._shared = 0  # number of barriers that gathered numbers
        self._handles: dict[str, Any] = {}  # a mapping exists as long as its handle
        self._control = self.map_symmetric("control", control)
        self._side_control = [words[-self.world_size :] for words in self._control]
        self._side_barriers = 0
        self._host = torch.empty(
            2, MAX_VALUES * self.world_size, dtype=torch.int64, pin_memory=control.is_cuda
        )
        self._boards: list[Tensor] = []
        self._board_parts: dict[tuple[int, int], list[Tensor]] = {}  # parts of the boards, by length and half
        self._gathered: dict[tuple[int, int], Shared] = {}  # by number of values and half

    def map_symmetric(self, name: str, mine: Tensor) -> list[Tensor]:
        """Map every rank's counterpart of a symmetric tensor; collective."""
        handle = _SymmetricMemory.rendezvous(mine, dist.distributed_c10d._get_default_group().group_name)
        self._handles[name] = handle
        mapped = [handle.get_buffer(rank, mine.shape, mine.dtype) for rank in range(self.world_size)]
        mapped[self.rank] = mine
        return mapped

    def barrier(self) -> None:
        """Delay the current stream until the streams of all ranks have reached this barrier."""
        self._barrier(None, self.world_size, None)

    def side_barrier(self) -> None:
        """Queue a barrier of the board on its stream, independent of the barriers of the step."""
        self._side_barriers += 1
        torch.ops.blitzgs.device_barrier_(
            self._side_control, self.rank, self._side_barriers, None, self.world_size, self.timeout_seconds
        )

    def share(self, values: Tensor) -> Shared:
        """Queue a barrier that also gathers numbers from all ranks.

        `values`: int64 [n], n <= MAX_VALUES, the same n on all ranks.
        """
        # Use the other half: a rank may have left the last barrier without having read its numbers yet.
        half = self._shared % 2
        self._shared += 1
        count, numbers = self.world_size, values.shape[0]
        # The sums are stored behind the numbers, always in the same words, where no other rank writes.
        first = count + half * MAX_VALUES * (count + 1) + count * (MAX_VALUES - numbers)
        if (numbers, half) not in self._gathered:
            words = self._control[self.rank][first : first + (count + 1) * numbers].view(count + 1, numbers)
            host = self._host[half, : count * numbers].view(count, numbers)
            self._gathered[numbers, half] = Shared(words[:count], words[count], host)
        shared = self._gathered[numbers, half]
        self._barrier(values, first, shared.host)
        return shared

    def boards(self, words: int) -> list[Tensor]:
        """Return every rank's board, float32 [words], for the next barrier of the board. Collective.

        What ranks write there before that barrier must be copied, on the same stream, before the following
        barrier.
        """
        if not self._boards or len(self._boards[0]) < 2 * words:
            # After the last barrier no rank writes to this rank's board any more.
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = []
            self._board_parts.clear()
            mine = symmetric_words(2 * max(words, LEAST_BOARD), torch.float32, self.device)
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = self.map_symmetric("board", mine)
        key = words, self._side_barriers % 2
        if key not in self._board_parts:
            begin = key[1] * (len(self._boards[0]) // 2)
            self._board_parts[key] = [board[begin : begin + words] for board in self._boards]
        return self._board_parts[key]

    def _barrier(self, values: Tensor | None, first: int, host: Tensor | None) -> None:
        self._barriers += 1
        torch.ops.blitzgs.device_barrier_(
            self._control, self.rank, self._barriers, values, first, self.timeout_seconds, host
        )

    def reserve(self, words: int) -> None:
        """Enlarge every rank's buffer to `words` 32-bit words, the same on all ranks. Collective.

        The contents of the buffers are lost.
        """
        if self.buffers and len(self.buffers[0]) >= words:
            return
        mine = symmetric_words(-(-words // 4096) * 4096, torch.int32, self.device)
        # The new buffer is zeroed in stream order; this must end before a peer writes to it. Also, this
        # rank's queued work may still read the other ranks' old buffers, which are freed when all ranks have
        # reached the mapping.
        torch.cuda.current_stream(self.device).synchronize()
        self.buffers = self.map_symmetric("rows", mine)


def symmetric_words(count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Allocate memory [count] that `SharedMemory.map_symmetric` can map on all ranks; not cleared.

    `torch.distributed._symmetric_memory.empty` would load SymPy, for seconds, to find the stride.
    """
    return _SymmetricMemory.empty_strided_p2p((count,), (1,), dtype, device)
