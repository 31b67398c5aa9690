# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import pytest

from blitzgs.training.sampler import BatchSampler


def test_an_epoch_visits_every_view_once():
    sampler = BatchSampler(["same"] * 12, batch_size=4, seed=3)
    epochs = [[view for step in range(3 * e, 3 * e + 3) for view in sampler.batch(step)] for e in range(5)]
    assert all(sorted(epoch) == list(range(12)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 5


def test_batches_hold_one_image_size_and_views_are_drawn_equally_often():
    sizes = [(64, 48)] * 10 + [(48, 64)] * 5 + [(32, 32)]
    sampler = BatchSampler(sizes, batch_size=4, seed=0)
    seen = Counter()
    for step in range(16 * 50 // 4):
        batch = sampler.batch(step)
        assert len(batch) == 4
        assert len({sizes[view] for view in batch}) == 1
        seen.update(batch)
    assert all(abs(seen[view] - 50) <= 4 for view in range(16)), seen


def test_a_batch_depends_on_the_step_and_the_seed_alone():
    first, second = BatchSampler([0] * 9, 2, seed=1), BatchSampler([0] * 9, 2, seed=1)
    ahead = [second.batch(step) for step in reversed(range(40))][::-1]
    assert [first.batch(step) for step in range(40)] == ahead
    assert [BatchSampler([0] * 9, 2, seed=2).batch(step) for step in range(40)] != ahead


def test_fewer_views_than_the_batch():
    assert BatchSampler([0], 4, seed=0).batch(7) == [0, 0, 0, 0]
    with pytest.raises(ValueError, match="no training views"):
        BatchSampler([], 4, seed=0)
