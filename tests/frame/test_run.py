# SPDX-License-Identifier: Apache-2.0
"""The one loop that starts a frame again, and its estimate of sizes."""

import threading
from types import SimpleNamespace

import pytest

from blitzgs.frame.run import MAX_ATTEMPTS, run
from blitzgs.frame.transport.protocol import CapacityEstimate
from blitzgs.ops.projection_types import Sizes


class NeedsMemory:
    """A transport whose exchanges need the sizes that a function returns for each attempt."""

    def __init__(self, needed, sizes=None):
        self.capacity, self._needed, self.given = CapacityEstimate(sizes), needed, []

    def project_and_send(self, inputs, assignment, sizes, mark):
        self.given.append(sizes)
        needed = self._needed(len(self.given))
        fits = sizes is not None and sizes.holds(needed)
        return SimpleNamespace(finish=lambda: (needed, "result" if fits else None))


def test_an_estimate_follows_the_largest_recent_sizes():
    estimate = CapacityEstimate()
    assert estimate.sizes is None
    estimate.learn((800, 1600, 0))
    assert estimate.sizes == (900, 1800, 1, 1)  # some more than needed, and at least one
    estimate.learn((80, 3200, 16))
    assert estimate.sizes == (900 - 900 // 256, 3600, 18, 1)
    assert estimate.sizes.holds((897, 3600, 18)) and not estimate.sizes.holds((898,))
    for _ in range(3000):  # the estimate shrinks slowly
        estimate.learn((80, 80, 16))
    assert estimate.sizes.splats < 400


def test_the_next_attempt_gets_the_sizes_the_last_one_needed():
    transport, asked, consumed = NeedsMemory(lambda _: Sizes(10, 100, 1000), Sizes(10, 99, 2000)), [], []
    found = run(transport, asked.append, None, lambda exchange: consumed.append(exchange) or len(consumed))
    assert found == ("result", 2)
    assert asked == transport.given and len(asked) == 2
    assert transport.given[0] == (10, 99, 2000, 1) and transport.given[1].holds((10, 100, 1000))


def test_attempts_are_bounded_when_the_needed_size_grows():
    transport = NeedsMemory(lambda count: Sizes(1, 10**count, 1))
    with pytest.raises(RuntimeError, match=f"{MAX_ATTEMPTS} attempts .* needs \\(1, 10000, 1, 0\\)"):
        run(transport, lambda sizes: None, None, lambda exchange: None)
    assert len(transport.given) == MAX_ATTEMPTS


def test_an_attempt_that_fails_leaves_the_estimate():
    def fail(sizes):
        raise MemoryError

    transport = NeedsMemory(lambda _: Sizes(9, 9, 9), Sizes(1, 2, 3))
    with pytest.raises(MemoryError):
        run(transport, fail, None, lambda exchange: None)
    assert transport.capacity.sizes == (1, 2, 3, 1)


def test_threads_may_share_an_estimate():
    estimate = CapacityEstimate()

    def learn(splats):
        for _ in range(2000):
            estimate.learn((1, splats, 1))

    threads = [threading.Thread(target=learn, args=(splats,)) for splats in (8, 80, 80_000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    estimate.learn((1, 80_000, 1))
    assert estimate.sizes.splats >= 80_000
