# SPDX-License-Identifier: Apache-2.0
import weakref

import torch

from blitzgs.ops import host
from blitzgs.ops.host import PinnedPlace


class Event:
    is_recorded = False

    def query(self):
        return self.is_recorded


def test_memory_of_a_copy_that_is_not_read_is_kept_until_it_is_written(monkeypatch):
    monkeypatch.setattr(host, "_left", {})
    events = [Event() for _ in range(3)]
    places = [PinnedPlace(torch.zeros(1), event, []) for event in events]
    memory = [weakref.ref(place.memory) for place in places]
    places.pop(0).leave()
    places.pop(0).leave()
    assert memory[0]() is not None and memory[1]() is not None
    events[1].is_recorded = True
    places.pop().leave()
    assert [found() is not None for found in memory] == [True, False, True]
