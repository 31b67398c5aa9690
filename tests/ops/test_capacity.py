# SPDX-License-Identifier: Apache-2.0
import threading

import pytest

from blitzgs.ops.capacity import MOST_ATTEMPTS, CapacityEstimate, Sizes


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
    given, needed = [], Sizes(10, 100, 1000)
    for attempt in CapacityEstimate(Sizes(10, 99, 2000)).attempts():
        given.append(attempt.sizes)
        attempt.end(needed, attempt.sizes.holds(needed))
    assert len(given) == 2 and attempt.fits
    assert given[1].holds((10, 100, 1000))


def test_attempts_are_bounded_when_the_needed_size_grows():
    count = 0
    with pytest.raises(RuntimeError, match=f"{MOST_ATTEMPTS} attempts .* needs \\(1, 10000, 1, 0\\)"):
        for attempt in CapacityEstimate().attempts():
            count += 1
            attempt.end(Sizes(1, 10**count, 1), False)
    assert count == MOST_ATTEMPTS


def test_an_attempt_that_fails_leaves_the_estimate():
    estimate = CapacityEstimate(Sizes(1, 2, 3))
    with pytest.raises(MemoryError):
        for _ in estimate.attempts():
            raise MemoryError
    assert estimate.sizes == (1, 2, 3, 1)


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
