# SPDX-License-Identifier: Apache-2.0
"""Estimates the size of results that only the device knows while the host allocates memory for them.

If the host waited for the size, the device would be idle meanwhile. Instead, the host estimates the size from
what recent frames needed, queues all the work, and reads the true size while the device works. If the
estimate was too small, the host queues the work again (`blitzgs.frame.run`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from blitzgs.ops.projection_types import Sizes


class CapacityEstimate:
    """Estimates the sizes that the next frame needs from the largest recent ones. Threads may share it.

    Attributes:
        sizes: the present estimate; None before the first frame has ended.
    """

    def __init__(self, sizes: Sizes | None = None) -> None:
        """Begin with an estimate, or with none; without one the first attempt waits for its sizes."""
        self.sizes = None if sizes is None else Sizes._make(max(1, size) for size in sizes)
        self._lock = threading.Lock()

    def learn(self, needed: Sequence[int]) -> None:
        """Update the estimate with the sizes that a frame needed."""
        with self._lock:
            before = self.sizes or Sizes(0, 0, 0)
            # Views differ, so the estimate exceeds the largest recent size, and it shrinks slowly.
            self.sizes = Sizes(
                *[
                    max(1, n * 9 // 8, size - size // 256)
                    for n, size in zip(Sizes(*needed), before, strict=True)
                ]
            )
