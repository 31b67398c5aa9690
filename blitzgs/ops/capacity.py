# SPDX-License-Identifier: Apache-2.0
"""Estimates the size of results that only the device knows while the host allocates memory for them.

If the host waited for the size, the device would be idle meanwhile. Instead, the host estimates the size from
what recent calls needed, queues all the work, and reads the true size while the device works. If the estimate
was too small, the host queues the work again.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

# A failed attempt reports the sizes that it needs, and the next attempt uses them. More attempts than this
# mean that the inputs change or that the program is wrong.
MOST_ATTEMPTS = 4


class Sizes(NamedTuple):
    """Numbers of Gaussians, splats, tile entries and blocks that a call needs, or has memory for."""

    visible: int  # Gaussians seen by at least one view
    splats: int  # pairs of a Gaussian and a view that sees it
    isects: int  # entries of the tiles' lists
    blocks: int = 0  # of rows of the table, of which some view may see a part

    def holds(self, needed: Sequence[int]) -> bool:
        """Tell whether these sizes suffice for `needed`, which has the first of these fields in order."""
        return all(n <= size for n, size in zip(needed, self, strict=False))


class Attempt:
    """One call whose results get memory of given sizes.

    Attributes:
        sizes: sizes to allocate; None: no estimate exists yet, so the call must wait for the true sizes.
        needed: the sizes that the call needed.
        fits: whether the allocated sizes sufficed.
    """

    def __init__(self, sizes: Sizes | None, estimate: CapacityEstimate | None = None) -> None:
        """Begin an attempt; `end` passes the needed sizes to `estimate`, if there is one."""
        self.sizes, self.fits, self._estimate = sizes, False, estimate
        self.needed: Sequence[int] = ()

    def end(self, needed: Sequence[int], fits: bool) -> None:
        """Note which sizes the call needed, and whether its memory sufficed."""
        self.needed, self.fits = needed, fits
        if self._estimate is not None:
            self._estimate.learn(needed)


class CapacityEstimate:
    """Estimates the sizes that the next call needs from the largest recent ones. Threads may share it."""

    def __init__(self, sizes: Sizes | None = None) -> None:
        """Begin with an estimate, or with none; without one the first attempt waits for its sizes."""
        self._sizes = None if sizes is None else Sizes._make(max(1, size) for size in sizes)
        self._lock = threading.Lock()

    @property
    def sizes(self) -> Sizes | None:
        """The present estimate; None before the first call has ended."""
        return self._sizes

    def learn(self, needed: Sequence[int]) -> None:
        """Update the estimate with the sizes that a call needed."""
        with self._lock:
            before = self._sizes or Sizes(0, 0, 0)
            # Views differ, so the estimate exceeds the largest recent size, and it shrinks slowly.
            self._sizes = Sizes._make(
                max(1, n * 9 // 8, size - size // 256) for n, size in zip(Sizes(*needed), before, strict=True)
            )

    def attempts(self) -> Iterator[Attempt]:
        """Yield attempts until one of them fits; the caller must call `end` of each attempt.

        Raises:
            RuntimeError: `MOST_ATTEMPTS` attempts did not suffice, each with the sizes that the last one
                needed.
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
