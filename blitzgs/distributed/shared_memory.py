# SPDX-License-Identifier: Apache-2.0
"""Memory that the ranks of one host share, and barriers between their streams.

Each rank owns memory that all others have mapped (NVLink or PCIe peer access):

- control words, which are few: the number of the last barrier that each rank reached, and the numbers that it
  brought to it;
- a buffer that grows, for the transport of splats (`blitzgs.distributed.transport.peer`);
- a board, for what ranks show each other's hosts (`HostSum`), on a stream and with barriers of its own beside
  the step.

A barrier holds up streams, not hosts: work queued behind it, on any rank, finds done what any rank queued
before it. There are two places for the numbers that ranks bring to a barrier, used in turn, because a rank
that has left a barrier may not have read its numbers yet when another brings the next ones. They are read
before the rank queues the next barrier with numbers. So it is with the board and the barriers beside the
step. Sums of the numbers lie where no other rank ever writes: a rank's own second such barrier overwrites
them.
"""

from __future__ import annotations

import socket
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import _symmetric_memory as symmetric

import blitzgs._library  # noqa: F401  (registers the ops)

T = TypeVar("T")
MAX_PEERS = 16
# Numbers that a rank may bring to a barrier; there are two places for them, and for their sums.
MAX_VALUES = 256
_LEAST_WORDS = 1 << 20
_LEAST_BOARD = 1 << 16


class Job(Protocol):
    """What shared memory needs to know of the job (`blitzgs.distributed.group.Ranks`)."""

    rank: int
    world_size: int
    device: torch.device
    shares_gpu: bool

    def all_gather_object(self, value: T) -> list[T]:
        """Gather an object from all ranks."""

    def barrier(self) -> None:
        """Wait for all ranks, on the host."""


class Shared(NamedTuple):
    """Numbers that all ranks brought to a barrier.

    Attributes:
        everyone: int64 [M, n], those of each rank; valid until the next such barrier.
        sums: int64 [n], over the ranks; valid until this rank queues the second such barrier after this.
        host: `everyone` on the CPU, once what was queued on the current stream was waited for; as long as
            the sums.
    """

    everyone: Tensor
    sums: Tensor
    host: Tensor


def control_words(world_size: int) -> int:
    """Length of a rank's control words, int64: barriers, numbers and sums, barriers beside the step."""
    return world_size + 2 * MAX_VALUES * (world_size + 1) + world_size


class SharedMemory:
    """The shared memory of the ranks; make it with `connect`.

    Args:
        rank: this rank.
        world_size: M.
        device: where this rank computes.
        control: this rank's control words, symmetric memory, `control_words` zeros.
        timeout_seconds: longest wait in a barrier.

    Attributes:
        buffers: int32 [words] of each rank, mapped here.
        generation: how often splats were written into the buffers: tells whose these are.
    """

    def __init__(
        self, rank: int, world_size: int, device: torch.device, control: Tensor, timeout_seconds: float
    ) -> None:
        self.rank, self.world_size, self.device = rank, world_size, device
        self.timeout_seconds = timeout_seconds
        self.buffers: list[Tensor] = []
        self.generation = 0
        self._barriers = 0
        self._shared = 0  # how many of them had numbers
        self._handles: dict[str, Any] = {}  # the mappings live as long as these
        self._control = self._map("control", control)
        self._side_control = [words[-self.world_size :] for words in self._control]
        self._side_barriers = 0
        self._host = torch.empty(
            2, MAX_VALUES * self.world_size, dtype=torch.int64, pin_memory=control.is_cuda
        )
        self._boards: list[Tensor] = []
        self._places: dict[tuple[int, int], list[Tensor]] = {}  # on the boards; made once

    def _map(self, name: str, mine: Tensor) -> list[Tensor]:
        """Map every rank's counterpart of a symmetric tensor; collective."""
        handle = symmetric.rendezvous(mine, dist.distributed_c10d._get_default_group())
        self._handles[name] = handle
        mapped = [handle.get_buffer(rank, mine.shape, mine.dtype) for rank in range(self.world_size)]
        mapped[self.rank] = mine
        return mapped

    def barrier(self) -> None:
        """Hold up the current stream until all ranks' have come here."""
        self._barrier(None, self.world_size, None)

    def side_barrier(self) -> None:
        """Be a barrier on the stream beside the step, whatever barriers the step is at."""
        self._side_barriers += 1
        torch.ops.blitzgs.device_barrier_(
            self._side_control, self.rank, self._side_barriers, None, self.world_size, self.timeout_seconds
        )

    def share(self, values: Tensor) -> Shared:
        """Be a barrier, and show the other ranks numbers.

        Args:
            values: int64 [n], n <= MAX_VALUES, the same n on all ranks.
        """
        # A rank may have left the last barrier and not have read its numbers yet.
        place = self._shared % 2
        self._shared += 1
        count, numbers = self.world_size, len(values)
        # The sums come behind the numbers: always in the same words, where no other rank ever writes.
        first = count + place * MAX_VALUES * (count + 1) + count * (MAX_VALUES - numbers)
        host = self._host[place, : count * numbers].view(count, numbers)
        self._barrier(values, first, host)
        brought = self._control[self.rank][first : first + (count + 1) * numbers].view(count + 1, numbers)
        return Shared(brought[:count], brought[count], host)

    def boards(self, words: int) -> list[Tensor]:
        """Return every rank's board, float32 [words], for the next barrier beside the step. Collective.

        What is written there before that barrier is to be copied, on the same stream, before the one after.
        """
        if not self._boards or len(self._boards[0]) < 2 * words:
            # Behind its last barrier no rank writes to this rank's board any more.
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = []
            self._places.clear()
            mine = symmetric.empty(2 * max(words, _LEAST_BOARD), dtype=torch.float32, device=self.device)
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = self._map("board", mine)
        key = words, self._side_barriers % 2
        if key not in self._places:
            begin = key[1] * (len(self._boards[0]) // 2)
            self._places[key] = [board[begin : begin + words] for board in self._boards]
        return self._places[key]

    def _barrier(self, values: Tensor | None, first: int, host: Tensor | None) -> None:
        self._barriers += 1
        torch.ops.blitzgs.device_barrier_(
            self._control, self.rank, self._barriers, values, first, self.timeout_seconds, host
        )

    def reserve(self, words: int) -> None:
        """Make every rank's buffer hold `words` 32-bit words. Collective: all ranks ask for the same.

        What the buffers held is lost.
        """
        if self.buffers and len(self.buffers[0]) >= words:
            return
        mine = symmetric.empty(-(-words // 4096) * 4096, dtype=torch.int32, device=self.device)
        # It is zeroed in stream order, which must be over before any peer can write; and what this rank has
        # queued may still read the other ranks' old buffers, which they give up when all have come to the
        # mapping.
        torch.cuda.current_stream(self.device).synchronize()
        self.buffers = self._map("rows", mine)


def connect(job: Job, timeout_seconds: float) -> SharedMemory | str:
    """Set up shared memory between all ranks, or say, the same on every rank, why that is impossible.

    Collective.

    Args:
        job: the ranks, joined.
        timeout_seconds: longest wait in a barrier.
    """
    place = (socket.gethostname(), job.device.index if job.device.type == "cuda" else None)
    places = job.all_gather_object(place)
    obstacle, control = _obstacle(places, job), None
    if obstacle is None:
        try:
            words = control_words(job.world_size)
            control = symmetric.empty(words, dtype=torch.int64, device=job.device).zero_()
        except RuntimeError as error:
            obstacle = f"rank {job.rank}: {error}"
    obstacles = [text for text in job.all_gather_object(obstacle) if text is not None]
    if obstacles or control is None:
        return obstacles[0]
    memory = SharedMemory(job.rank, job.world_size, job.device, control, timeout_seconds)
    memory.reserve(_LEAST_WORDS)
    job.barrier()
    return memory


def _obstacle(places: list[tuple[str, Any]], job: Job) -> str | None:
    """Say what keeps a rank from the others' memory."""
    hosts, devices = {host for host, _ in places}, [device for _, device in places]
    mine = job.device.index
    if None in devices:
        return "not every rank computes on a GPU"
    if len(hosts) > 1:
        return f"the ranks are on {len(hosts)} hosts"
    if len(set(devices)) < len(devices) and not job.shares_gpu:
        return "some ranks see their GPU under the same number"
    if len(devices) > MAX_PEERS:
        return f"at most {MAX_PEERS} ranks can share memory, not {len(devices)}"
    for other in devices:
        if other != mine and not torch.cuda.can_device_access_peer(mine, other):
            return f"cuda:{mine} has no access to the memory of cuda:{other}"
    return None
