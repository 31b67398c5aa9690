# SPDX-License-Identifier: Apache-2.0
"""Memory that the ranks of one host share: a rank writes rows straight to where another needs them.

Each rank owns buffers that all others have mapped (NVLink or PCIe peer access). `mail` is small: the
number of the last meeting each rank came to, and the numbers it brought. `rows` is large and grows: first the
rows that arrive for this rank's tiles, column by column, so that intersection and compositing read them where
they lie; behind them the table in which compositing's gradient adds up theirs, where their owners read it.
`board` is for what ranks tell each other's hosts, and has a stream and meetings of its own beside the step.

A step is, in stream order on every rank: meeting A with the counts, rows written to the others, meeting B,
sorting, compositing, which zeroes the table, and its gradient, meeting C, reading the tables of all ranks.
Where many rows travel, their colours are computed meanwhile on a stream of their own, written there while the
rows are sorted, and met for (B') before compositing. A meeting is a barrier between streams: work queued
behind it, on any rank, finds done what any rank queued before it. Hence

- rows and tables are read after the meeting that follows their writing: B, B' for colours, C;
- arriving rows of a step overwrite those of the step before after A; whoever read those had queued that
  before its own A;
- a table is zeroed after B; whoever read it in the step before had queued that before its own B. A second
  gradient of one frame has a meeting of its own before the table is zeroed again;
- the numbers that ranks bring to a meeting are read before the next that has numbers, as there are two places
  for them, used in turn: whoever has been at the next may overwrite the first. So it is with the board and
  the meetings beside the step: what a rank copies from it behind one of them it has copied before it comes to
  the next. Sums of the numbers lie where no other rank ever writes: a rank's own second meeting after
  overwrites them.

Rows are queued for writing behind A, and for compositing, while the counts are on their way to the host.
Where they do not fit into somebody's buffer no rank writes any, which each finds from the same counts, and
nothing is composited; then all wait for what they have queued, so when buffers grow, no kernel of any rank
uses them, and all is queued again. So it is where one rank has more intersections than all have room for. A
rank that dies leaves the others in a meeting: their hosts wait in `Ranks.reading`, where the watchdog finds
them, and a meeting that lasts longer than that aborts the process's kernels.
"""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import _symmetric_memory as symmetric

import blitzgs._library  # noqa: F401  (registers the ops)

if TYPE_CHECKING:
    from blitzgs.distributed.group import Ranks

MAX_PEERS = 16
# Numbers that a rank may bring to a meeting; there are two places for them, and for their sums.
MAX_VALUES = 256
# Buffers grow to this many times what is needed, so that they seldom do.
HEADROOM = 1.25
_LEAST_WORDS = 1 << 20
_LEAST_BOARD = 1 << 16


class Shared(NamedTuple):
    """Numbers that all ranks brought to a meeting.

    Attributes:
        everyone: int64 [M, n], those of each rank; valid until the next such meeting.
        sums: int64 [n], over the ranks; valid until this rank queues the second such meeting after this.
        known: `everyone` on the CPU, once what was queued on the current stream was waited for; as long as
            the sums.
    """

    everyone: Tensor
    sums: Tensor
    known: Tensor


def mail_words(world_size: int) -> int:
    """Length of a rank's mail, int64: last meetings, numbers and sums, last meetings beside the step."""
    return world_size + 2 * MAX_VALUES * (world_size + 1) + world_size


class Peers:
    """The shared memory of the ranks; make it with `connect`.

    Args:
        ranks: the job.
        mail: this rank's mail, symmetric memory, `mail_words` zeros.
        timeout_seconds: longest wait in a meeting.

    Attributes:
        buffers: int32 [words] of each rank, mapped here.
        columns: of the rows in this rank's buffer, as `PeerSpace.arrived` has them; empty: not made yet.
        exchanges: how often rows were written: tells whose rows are in the buffers.
        n_isects: how many intersections of arrived rows may be listed before their number is known, by what
            frames of late needed; the same on all ranks.
        second: stream for colours.
        apart: whether the next exchange's colours travel apart from their rows; the same on all ranks.
    """

    def __init__(self, ranks: Ranks, mail: Tensor, timeout_seconds: float) -> None:
        self.rank, self.world_size, self.device = ranks.rank, ranks.world_size, ranks.device
        self.timeout_seconds = timeout_seconds
        self.buffers: list[Tensor] = []
        self.columns: list[Tensor] = []
        self.exchanges = 0
        self.n_isects = 0
        self.apart = False
        self.second = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._meetings = 0
        self._shared = 0  # how many of them had numbers
        self._handles: dict[str, Any] = {}  # the mappings live as long as these
        self._mail = self._map("mail", mail)
        self._beside = [letters[-self.world_size :] for letters in self._mail]
        self._meetings_beside = 0
        self._known = torch.empty(2, MAX_VALUES * self.world_size, dtype=torch.int64, pin_memory=mail.is_cuda)
        self._boards: list[Tensor] = []
        self._places: dict[tuple[int, int], list[Tensor]] = {}  # on the boards; made once

    def _map(self, name: str, mine: Tensor) -> list[Tensor]:
        """Map every rank's counterpart of a symmetric tensor; collective."""
        handle = symmetric.rendezvous(mine, dist.distributed_c10d._get_default_group())
        self._handles[name] = handle
        mapped = [handle.get_buffer(rank, mine.shape, mine.dtype) for rank in range(self.world_size)]
        mapped[self.rank] = mine
        return mapped

    def meet(self) -> None:
        """Meet the other ranks, in stream order."""
        self._meet(None, self.world_size, None)

    def learn(self, n_isects: int) -> None:
        """Take note of the most intersections that a rank had."""
        self.n_isects = max(n_isects * 9 // 8, self.n_isects - self.n_isects // 256)

    def meet_beside(self) -> None:
        """Meet the other ranks on the stream beside the step, whatever meetings the step is at."""
        self._meetings_beside += 1
        torch.ops.blitzgs.meet_peers_(
            self._beside, self.rank, self._meetings_beside, None, self.world_size, self.timeout_seconds
        )

    def share(self, values: Tensor) -> Shared:
        """Meet the other ranks and show them numbers.

        Args:
            values: int64 [n], n <= MAX_VALUES, the same n on all ranks.
        """
        # A rank may have come out of the last meeting and not have read its numbers yet.
        place = self._shared % 2
        self._shared += 1
        count, numbers = self.world_size, len(values)
        # The sums come behind the numbers: always in the same words, where no other rank ever writes.
        first = count + place * MAX_VALUES * (count + 1) + count * (MAX_VALUES - numbers)
        known = self._known[place, : count * numbers].view(count, numbers)
        self._meet(values, first, known)
        brought = self._mail[self.rank][first : first + (count + 1) * numbers].view(count + 1, numbers)
        return Shared(brought[:count], brought[count], known)

    def boards(self, words: int) -> list[Tensor]:
        """Return every rank's board, float32 [words], for the next meeting beside the step. Collective.

        What is written there before that meeting is to be copied, on the same stream, before the one after.
        """
        if not self._boards or len(self._boards[0]) < 2 * words:
            # Behind its last meeting nobody writes to this rank's board any more.
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = []
            self._places.clear()
            mine = symmetric.empty(2 * max(words, _LEAST_BOARD), dtype=torch.float32, device=self.device)
            torch.cuda.current_stream(self.device).synchronize()
            self._boards = self._map("board", mine)
        key = words, self._meetings_beside % 2
        if key not in self._places:
            begin = key[1] * (len(self._boards[0]) // 2)
            self._places[key] = [board[begin : begin + words] for board in self._boards]
        return self._places[key]

    def _meet(self, values: Tensor | None, first: int, known: Tensor | None) -> None:
        self._meetings += 1
        torch.ops.blitzgs.meet_peers_(
            self._mail, self.rank, self._meetings, values, first, self.timeout_seconds, known
        )

    def reserve(self, words: int) -> None:
        """Make every rank's buffer hold `words` 32-bit words. Collective: all ranks ask for the same.

        What the buffers held is lost.
        """
        if self.buffers and len(self.buffers[0]) >= words:
            return
        self.buffers, self.columns = [], []
        size = -(-int(HEADROOM * words) // 4096) * 4096
        mine = symmetric.empty(size, dtype=torch.int32, device=self.device)
        # It is zeroed in stream order: that must be over before any peer can write.
        torch.cuda.current_stream(self.device).synchronize()
        self.buffers = self._map("rows", mine)


def connect(ranks: Ranks, timeout_seconds: float) -> Peers | str:
    """Set up shared memory between all ranks, or say, the same on every rank, why that is impossible.

    Collective.

    Args:
        ranks: the job, joined.
        timeout_seconds: longest wait in a meeting.
    """
    place = (socket.gethostname(), ranks.device.index if ranks.device.type == "cuda" else None)
    places = ranks.all_gather_object(place)
    obstacle, mail = _obstacle(places, ranks), None
    if obstacle is None:
        try:
            words = mail_words(ranks.world_size)
            mail = symmetric.empty(words, dtype=torch.int64, device=ranks.device).zero_()
        except RuntimeError as error:
            obstacle = f"rank {ranks.rank}: {error}"
    obstacles = [text for text in ranks.all_gather_object(obstacle) if text is not None]
    if obstacles or mail is None:
        return obstacles[0]
    peers = Peers(ranks, mail, timeout_seconds)
    peers.reserve(_LEAST_WORDS)
    ranks.barrier()
    return peers


def _obstacle(places: list[tuple[str, Any]], ranks: Ranks) -> str | None:
    """Say what keeps a rank from the others' memory."""
    hosts, devices = {host for host, _ in places}, [device for _, device in places]
    mine = ranks.device.index
    if None in devices:
        return "not every rank computes on a GPU"
    if len(hosts) > 1:
        return f"the ranks are on {len(hosts)} hosts"
    if len(set(devices)) < len(devices) and not ranks.shares_gpu:
        return "some ranks see their GPU under the same number"
    if len(devices) > MAX_PEERS:
        return f"at most {MAX_PEERS} ranks can share memory, not {len(devices)}"
    for other in devices:
        if other != mine and not torch.cuda.can_device_access_peer(mine, other):
            return f"cuda:{mine} has no access to the memory of cuda:{other}"
    return None
