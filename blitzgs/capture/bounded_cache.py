# SPDX-License-Identifier: Apache-2.0
"""A cache with a budget of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class BoundedCache(Generic[K, V]):
    """A least-recently-used cache with a budget of bytes; an entry larger than the budget is not stored.

    Attributes:
        budget: the largest size, in bytes.
        bytes: the size now.
        most_bytes: the largest size so far.
    """

    def __init__(self, budget: int) -> None:
        """Hold at most `budget` bytes."""
        self.budget = budget
        self.bytes = 0
        self.most_bytes = 0
        self._entries: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K) -> V | None:
        """Return the entry and mark it as the most recently used; None if it is not stored."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def put(self, key: K, value: V, size: int, spare: bool = False) -> None:
        """Add or replace an entry of `size` bytes, dropping the oldest until all fit.

        A spare entry drops no other one, and is the first to be dropped.
        """
        with self._lock:
            if key in self._entries:
                self.bytes -= self._entries.pop(key)[1]
            if size > self.budget or (spare and self.bytes + size > self.budget):
                return
            while self.bytes + size > self.budget:
                self.bytes -= self._entries.popitem(last=False)[1][1]
            self._entries[key] = (value, size)
            self._entries.move_to_end(key, last=not spare)
            self.bytes += size
            self.most_bytes = max(self.most_bytes, self.bytes)

    def resize(self, budget: int) -> None:
        """Change the budget, dropping the oldest entries until the others fit."""
        with self._lock:
            self.budget = budget
            while self.bytes > budget:
                self.bytes -= self._entries.popitem(last=False)[1][1]
