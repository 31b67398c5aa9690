# SPDX-License-Identifier: Apache-2.0
import weakref

import torch

from blitzgs.ops import host
from blitzgs.ops.host import PinnedNumbers


class Event:
    is_recorded = False

    def query(self):
        return self.is_recorded


def test_memory_of_a_copy_that_is_not_read_is_kept_until_it_is_written(monkeypatch):
    monkeypatch.setattr(host, "_abandoned", {})
    events = [Event() for _ in range(3)]
    pinned = [PinnedNumbers(torch.zeros(1), event, []) for event in events]
    memory = [weakref.ref(piece.memory) for piece in pinned]
    pinned.pop(0).abandon()
    pinned.pop(0).abandon()
    assert memory[0]() is not None and memory[1]() is not None
    events[1].is_recorded = True
    pinned.pop().abandon()
    assert [found() is not None for found in memory] == [True, False, True]
