# SPDX-License-Identifier: Apache-2.0
"""Ranks that write to each other's memory without a GPU: ranks are threads, CPU code replaces CUDA ops."""

import threading

import torch

from blitzgs.distributed.shared_memory import Shared
from blitzgs.frame.transport import peer
from blitzgs.frame.transport.peer import WORDS_PER_SPLAT
from blitzgs.ops.exchange import gather_splats, scatter_splats, words_of
from blitzgs.ops.projection_types import VIEW_TOTALS

PATIENCE = 30.0


class Host:
    """The state that the ranks share."""

    def __init__(self, world_size):
        self.meeting = threading.Barrier(world_size, timeout=PATIENCE)
        self.slots = [None] * world_size

    def gather(self, rank, value):
        """Return every rank's value. Collective."""
        self.slots[rank] = value
        self.meeting.wait()
        values = list(self.slots)
        self.meeting.wait()
        return values


class Memory:
    """A stand-in for `SharedMemory` of one rank."""

    def __init__(self, host, rank):
        self.host, self.rank, self.generation, self.log = host, rank, 0, []
        self.reserve(32 * WORDS_PER_SPLAT)

    def barrier(self):
        self.log.append("barrier")
        self.host.meeting.wait()

    def share(self, values):
        self.log.append("share")
        everyone = torch.stack(self.host.gather(self.rank, values))
        return Shared(everyone, everyone.sum(0), everyone.clone())

    def reserve(self, words):
        self.log.append(("reserve", words))
        self.buffers = self.host.gather(self.rank, torch.full((words,), -1, dtype=torch.int32))


class IdleEvent:
    """Replaces `torch.cuda.Event`: nothing is pending on a CPU."""

    def record(self, stream=None):
        pass

    def synchronize(self):
        pass


def send(columns, masks, everyone, rank, buffers, capacity):
    """Replaces `send_splats_`."""
    world_size = len(buffers)
    n_views = everyone.shape[1] - VIEW_TOTALS - 2 * world_size
    splats = everyone[:, VIEW_TOTALS + n_views :: 2].tolist()
    most = max(*everyone[:, 1].tolist(), *map(sum, splats), *map(sum, zip(*splats, strict=True)))
    if most > capacity:
        return torch.empty(0, world_size, dtype=torch.int64), torch.tensor([0])
    count = int(everyone[rank, 1])
    numbers = torch.arange(count, dtype=torch.int32)
    packed, places = scatter_splats([numbers], masks[:count], splats[rank])
    (numbers,) = gather_splats(packed, [numbers], splats[rank])
    for m, which in enumerate(numbers.long().split(splats[rank])):
        at, begin = sum(sent[m] for sent in splats[:rank]), 0
        for column in columns:
            words = words_of(column[:count])
            width = words.shape[1]
            buffers[m][begin + at * width :][: len(which) * width] = words[which].flatten()
            begin += capacity * width
    return places, torch.tensor([sum(sent[rank] for sent in splats)])


def rasterize_into(*arguments):
    """Replaces `rasterize_fwd_`."""
    *rest, table, n_splats = arguments
    table[: int(n_splats)] = 0
    return torch.ops.blitzgs.rasterize_fwd(*rest, False, False, n_splats)[:6]


def replace_cuda(monkeypatch):
    """Let `PeerTransport` work on a CPU."""
    monkeypatch.setattr(torch.ops.blitzgs, "send_splats_", send)
    monkeypatch.setattr(torch.ops.blitzgs, "rasterize_fwd_", rasterize_into)
    monkeypatch.setattr(torch.cuda, "Event", IdleEvent)
    monkeypatch.setattr(peer, "current_stream", lambda _: None)
