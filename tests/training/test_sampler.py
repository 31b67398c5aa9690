# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np
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


def along(views):
    """A tour of views with consecutive numbers, which see the places around their own."""
    return {"tour": list(range(views))}


@pytest.mark.parametrize(("views", "batch_size"), [(96, 1), (96, 4), (100, 3)])
def test_an_epoch_of_a_tour_visits_every_view_once(views, batch_size):
    sampler = BatchSampler([0] * views, batch_size, seed=3, **along(views))
    drawn = [view for step in range(4 * views) for view in sampler.batch(step)]
    epochs = [tuple(drawn[views * epoch : views * (epoch + 1)]) for epoch in range(4)]
    assert all(sorted(epoch) == list(range(views)) for epoch in epochs)
    assert len(set(epochs)) == 4 and len({epoch[0] for epoch in epochs}) > 1


def test_a_tour_stays_near_and_is_shuffled_there():
    views = 400
    sampler = BatchSampler([0] * views, 1, seed=0, **along(views))
    drawn = np.array([sampler.batch(step)[0] for step in range(40 * views)]).reshape(40, views)
    # Distances on the closed tour between views that follow each other. For independent draws, their mean is
    # views / 4. Here a view moves by up to 1/8 of the tour: two such numbers differ by a third of that.
    apart = np.abs(np.diff(drawn, axis=1))
    apart = np.minimum(apart, views - apart)
    assert apart.max() < 1.5 * views / 8
    assert 0.6 * views / 24 < apart.mean() < 1.4 * views / 24
    forward = (np.diff(drawn, axis=1) % views < views / 2).mean(axis=1)
    assert 5 < (forward > 0.5).sum() < 35  # both directions occur
    # Whatever the place of a view on the tour, it comes early in some epochs and late in others.
    when = drawn.argsort(axis=1)
    assert (abs(when.mean(axis=0) - (views - 1) / 2) < 5 * views / np.sqrt(12 * 40)).all()
    assert (when.std(axis=0) > 0.5 * views / np.sqrt(12)).all()


def test_views_of_all_sizes_follow_a_tour_together():
    """Two cameras fly side by side; one has another image size, and every third view only."""
    places = [*range(300), *range(0, 300, 3)]
    sizes = ["large"] * 300 + ["small"] * 100
    tour = sorted(range(400), key=lambda view: places[view])
    sampler = BatchSampler(sizes, 2, seed=1, tour=tour)
    for epoch in range(3):
        batches = [sampler.batch(step) for step in range(200 * epoch, 200 * (epoch + 1))]
        assert all(len({sizes[view] for view in batch}) == 1 for batch in batches)
        assert sorted(view for batch in batches for view in batch) == list(range(400))
        steps = np.abs(np.diff([places[batch[0]] for batch in batches]))
        assert np.minimum(steps, 300 - steps).max() < 1.5 * 300 / 8 + 3


def test_a_tour_depends_on_the_step_and_the_seed_alone():
    tour = [(7 * view) % 50 for view in range(50)]
    whole = BatchSampler([0] * 50, 2, seed=1, tour=tour)
    ahead = [whole.batch(step) for step in range(120)]
    assert [BatchSampler([0] * 50, 2, seed=1, tour=tour).batch(step) for step in range(119, -1, -1)] == ahead[
        ::-1
    ]
    assert [BatchSampler([0] * 50, 2, seed=2, tour=tour).batch(step) for step in range(120)] != ahead
    with pytest.raises(ValueError, match="each of the 50 views once, got 49"):
        BatchSampler([0] * 50, 2, seed=1, tour=tour[1:])
