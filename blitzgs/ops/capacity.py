# SPDX-License-Identifier: Apache-2.0
"""How much memory to give to results whose size only the device knows when they are queued.

The host could wait for the size, but the device would have nothing to do meanwhile. So the host estimates the
size from what the calls of late needed, queues all the work, and learns the true size while the device works.
Where the estimate was too small, the work is queued once more.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

T = TypeVar("T")

# An attempt that failed tells what it needs, so the next has it: more attempts than this are an error in the
# program.
MOST_ATTEMPTS = 4


class Sizes(NamedTuple):
    """How many of each there are, or may be."""

    visible: int  # Gaussians seen by at least one view
    splats: int  # pairs of a Gaussian and a view that sees it
    isects: int  # entries of the tiles' lists
    blocks: int = 0  # of rows of the table, of which some view may see a part

    def holds(self, needed: Sequence[int]) -> bool:
        """Tell whether there is room for so many of the first of these."""
        return all(n <= size for n, size in zip(needed, self, strict=False))


class CapacityEstimate:
    """An estimate of the sizes that the next call needs, from the largest of late. Threads may share it."""

    def __init__(self, sizes: Sizes | None = None) -> None:
        """Begin with an estimate, or with none: the first attempt then has to wait for its sizes."""
        self._sizes = None if sizes is None else Sizes._make(max(1, size) for size in sizes)
        self._lock = threading.Lock()

    @property
    def sizes(self) -> Sizes | None:
        """The estimate; None: nothing is known yet."""
        return self._sizes

    def learn(self, needed: Sequence[int]) -> None:
        """Take note of what a call needed."""
        with self._lock:
            before = self._sizes or Sizes(0, 0, 0)
            # Views differ, so some more than the largest; and a large one is forgotten slowly.
            self._sizes = Sizes._make(
                max(1, n * 9 // 8, size - size // 256) for n, size in zip(Sizes(*needed), before, strict=True)
            )

    def run(self, attempt: Callable[[Sizes | None], tuple[T | None, Sequence[int]]]) -> T:
        """Call `attempt` with the estimate, and again where that was too small.

        Args:
            attempt: is given the estimate, and returns its result and what it needed. The result is None
                where the estimate was too small.

        Raises:
            RuntimeError: the sizes that an attempt asked for were too small for the next one, several times.
        """
        given = needed = None
        for _ in range(MOST_ATTEMPTS):
            given = self.sizes
            result, needed = attempt(given)
            self.learn(needed)
            if result is not None:
                return result
        raise RuntimeError(
            f"{MOST_ATTEMPTS} attempts have each needed more than the one before had asked for: the last had "
            f"{given} and needs {tuple(needed or ())}. The inputs must not change during a call"
        )
