# SPDX-License-Identifier: Apache-2.0
"""How much memory to give to results whose size only the device knows when they are queued.

The host could wait for the size, but the device would have nothing to do meanwhile. So the host estimates the
size from what the calls of late needed, queues all the work, and learns the true size while the device works.
Where the estimate was too small, the work is queued once more.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

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


class Attempt:
    """One call with room of some sizes.

    Attributes:
        sizes: to make room for; None: nothing is known yet, so the call has to wait for its sizes.
        needed: the sizes that turned out to be needed.
        fits: whether there was room for them.
    """

    def __init__(self, sizes: Sizes | None, estimate: CapacityEstimate | None = None) -> None:
        """Begin; `estimate` learns how it ends."""
        self.sizes, self.fits, self._estimate = sizes, False, estimate
        self.needed: Sequence[int] = ()

    def end(self, needed: Sequence[int], fits: bool) -> None:
        """Say what was needed, and whether there was room for it."""
        self.needed, self.fits = needed, fits
        if self._estimate is not None:
            self._estimate.learn(needed)


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

    def attempts(self) -> Iterator[Attempt]:
        """Yield attempts with the estimate until one of them fits; whoever makes one calls its `end`.

        Raises:
            RuntimeError: the sizes that an attempt asked for were too small for the next one, several times.
        """
        for _ in range(MOST_ATTEMPTS):
            attempt = Attempt(self._sizes, self)
            yield attempt
            if attempt.fits:
                return
        raise RuntimeError(
            f"{MOST_ATTEMPTS} attempts have each needed more than the one before had asked for: the last had "
            f"{attempt.sizes} and needs {tuple(attempt.needed)}. The inputs must not change during a call"
        )
