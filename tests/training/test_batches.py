# SPDX-License-Identifier: Apache-2.0
"""Batches: which views, and their photographs and masks although memory is reused."""

import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.training.batches import BatchLoader
from blitzgs.training.sampler import BatchSampler, tour_of
from blitzgs.view.views import Space, ViewSet
from tests.helpers import look_at_origin, refused
from tests.training.tiny import Camera, Images

SIZES = [(48, 32)] * 5 + [(30, 20)] * 3
EVERY = tuple(range(len(SIZES)))
STEPS = 25


@pytest.fixture
def capture():
    """Cameras of two sizes; the first has a mask."""
    g = torch.Generator().manual_seed(0)
    cameras, images, masks = [], [], []
    for i, (width, height) in enumerate(SIZES):
        K = np.array([[40.0 + i, 0.0, width / 2], [0.0, 41.0, height / 2], [0.0, 0.0, 1.0]])
        angle = 0.7 * i
        pose = look_at_origin(np.array([3 * np.cos(angle), 3 * np.sin(angle), 2.5]))
        cameras.append(Camera(str(i), width, height, K, pose))
        images.append(torch.randint(0, 256, (height, width, 3), generator=g, dtype=torch.uint8))
        masks.append((torch.rand(height, width, generator=g) < 0.5).byte() if i == 0 else None)
    return cameras, Images(images, masks)


@pytest.fixture
def make_loader(capture):
    """Make a loader of batches of two views; returns its sampler and the views, too."""
    with contextlib.ExitStack() as loaders:

        def make(device, ahead, train=EVERY):
            views = ViewSet(capture[0], Space(offset=(0.0, 0.0, 0.0), unit=1.0, extent=1.0), device)
            sampler = BatchSampler([SIZES[camera] for camera in train], 2, seed=3)
            parts = capture[1], views, list(train), sampler, device, ahead
            loader = BatchLoader(*parts, random_background=True)
            loaders.callback(loader.close)
            return loader, sampler, views

        yield make


@pytest.mark.parametrize("ahead", [0, 1, 3])
def test_each_step_gets_its_own_views(capture, make_loader, device, ahead):
    _, images = capture
    device = torch.device(device)
    train = [7, 6, 5, 4, 3, 2, 1, 0]
    loader, sampler, views = make_loader(device, ahead, train)
    seen = []
    for step in range(STEPS):
        batch = loader.get(step, STEPS)
        if device.type == "cuda":
            torch.cuda._sleep(1_000_000)  # a slow step, which the batches made ahead must not overtake
        views_of_batch = batch.views.viewmats, batch.views.Ks, batch.backgrounds
        tensors = (batch.targets, batch.masks, batch.samples, *views_of_batch)
        copies = [None if tensor is None else tensor.clone() for tensor in tensors]
        seen.append((batch.indices, batch.views.width, batch.views.height, *copies))
    for step, (indices, width, height, targets, masks, samples, viewmats, Ks, backgrounds) in enumerate(seen):
        assert indices == [train[view] for view in sampler.batch(step)]
        expected = views.pick(indices)
        assert (width, height) == SIZES[indices[0]] == (expected.width, expected.height)
        assert torch.equal(viewmats, expected.viewmats) and torch.equal(Ks, expected.Ks)
        assert torch.equal(backgrounds.cpu(), sampler.backgrounds(step).float())
        assert torch.equal(targets.cpu(), torch.stack([images.get(index) for index in indices]))
        counted = [torch.ones(height, width) if (m := images.mask(i)) is None else m for i in indices]
        assert samples.tolist() == [3 * int(mask.sum()) for mask in counted]
        if any(images.mask(index) is not None for index in indices):
            assert torch.equal(masks.cpu(), torch.stack(counted).byte())
        else:
            assert masks is None
    colours = torch.stack([backgrounds for *_, backgrounds in seen]).cpu()
    assert len(colours.flatten().unique()) == colours.numel()
    assert 0 < colours.min() < 0.05 and 0.95 < colours.max() < 1 and abs(colours.mean() - 0.5) < 0.1


@pytest.mark.parametrize("ahead", [0, 3])
def test_reduced_photographs_and_their_cameras(capture, make_loader, device, ahead):
    """Also where the resolution rises, and where the pace changes when later batches are prepared already."""
    _, images = capture
    loader, sampler, views = make_loader(torch.device(device), ahead)
    config = ScheduleConfig(iterations=100, batch_size=2, resolution=((4, 8), (2, 30)))
    sampler.schedule, seen = Schedule(config), []
    for step in range(STEPS):
        batch = loader.get(step, STEPS)
        factor = 4 if step < 4 else 2 if step < 12 else 1
        seen.append(factor)
        expected = views.pick(batch.indices)
        assert batch.indices == sampler.batch(step)
        assert torch.equal(batch.views.viewmats, expected.viewmats)
        factors = torch.tensor([[factor], [factor], [1]], device=device)
        assert torch.equal(batch.views.Ks * factors, expected.Ks)
        width, height = SIZES[batch.indices[0]]
        assert (batch.views.width, batch.views.height) == (width // factor, height // factor)
        for view, index in enumerate(batch.indices):
            photo, mask = images.get(index), images.mask(index)
            if mask is None:
                mask = torch.ones(height, width, dtype=torch.uint8)
            target, counted = by_squares(photo.numpy(), mask.numpy(), factor)
            difference = batch.targets[view].cpu().numpy() - target
            assert np.abs(difference[counted]).max() <= 0.5 + 1e-4
            assert batch.samples[view] == 3 * counted.sum()
            if batch.masks is not None:
                assert np.array_equal(batch.masks[view].cpu().numpy() != 0, counted)
        if step == 10:  # the resolution now rises at image 24 and not 30; batch 13 may be prepared
            sampler.schedule = Schedule(replace(config, pace=((22, 0.25),)))
    assert set(seen) == {4, 2, 1} and loader.views_masked[1] == len(SIZES)


def by_squares(photo, mask, factor):
    """Mean colours of the pixels that count in squares of pixels, and where at least half of them do."""
    height, width = photo.shape[0] // factor, photo.shape[1] // factor
    means, counted = np.zeros((height, width, 3)), np.zeros((height, width), dtype=bool)
    for y, x in np.ndindex(height, width):
        square = np.s_[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
        inside = photo[square][mask[square] != 0]
        counted[y, x] = 2 * len(inside) >= factor**2
        means[y, x] = inside.mean(0) if len(inside) else 0
    return means, counted


@pytest.mark.parametrize(("batches", "first"), [(100, 11), (16, 9), (0, 3)])
def test_photographs_are_decoded_before_their_batches_are_assembled(
    capture, make_loader, batches, first, monkeypatch
):
    """Up to half of the memory for decoded images, and always those of the batches that are assembled."""
    _, images = capture
    wanted = []
    budget = batches * 2 * 4 * 48 * 32  # images and masks of batches of two views
    monkeypatch.setattr(images, "room", lambda: budget)
    monkeypatch.setattr(images, "prefetch", lambda indices, masks, factor: wanted.append((indices, masks)))
    loader, sampler, _ = make_loader(torch.device("cpu"), ahead=2, train=range(5))
    loader.get(0, STEPS)
    assert [indices for indices, _ in wanted] == [sampler.batch(step) for step in range(first)]
    assert all(indices == masks for indices, masks in wanted)
    for step in range(1, STEPS):
        loader.get(step, STEPS)
    each_once = sorted(sampler.batch(step) for step in range(STEPS))
    assert sorted(indices for indices, _ in wanted) == each_once
    assert loader.waited > 0


@pytest.mark.parametrize("ahead", [0, 2])
@pytest.mark.parametrize("error", [OSError, ValueError])
def test_memory_is_used_once_though_batches_could_not_be_made(
    capture, make_loader, device, ahead, error, monkeypatch
):
    """A photograph cannot be read, or has another size than its camera, after memory was taken for it."""
    _, images = capture
    loader, sampler, _ = make_loader(torch.device(device), ahead)
    get, failures, step = images.get, 0, 0

    def sometimes(index, factor):
        nonlocal failures
        if failures == 10 or index not in sampler.batch(5):
            return get(index)
        failures += 1
        if error is OSError:
            raise OSError("cannot be read")
        return get(index)[:, 1:]

    monkeypatch.setattr(images, "get", sometimes)
    while step < STEPS:
        try:
            batch = loader.get(step, STEPS)
        except error:
            continue
        expected = torch.stack([get(index) for index in sampler.batch(step)])
        assert torch.equal(batch.targets.cpu(), expected)
        step += 1
    assert failures == 10


def along(views):
    """A tour of views with consecutive numbers, which see the places around their own."""
    return {"tour": list(range(views))}


@pytest.mark.parametrize(
    ("views", "batch_size", "tour"),
    [(12, 4, {}), (96, 1, along(96)), (96, 4, along(96)), (100, 3, along(100))],
)
def test_an_epoch_visits_every_view_once(views, batch_size, tour):
    sampler = BatchSampler(["same"] * views, batch_size, seed=3, **tour)
    drawn = [view for step in range(5 * views) for view in sampler.batch(step)]
    epochs = [tuple(drawn[views * epoch : views * (epoch + 1)]) for epoch in range(5)]
    assert all(sorted(epoch) == list(range(views)) for epoch in epochs)
    assert len(set(epochs)) == 5 and len({epoch[0] for epoch in epochs}) > 1


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


@pytest.mark.parametrize(
    ("views", "tour"), [(9, {}), (50, {"tour": [7 * view % 50 for view in range(50)]})], ids=["free", "tour"]
)
def test_a_batch_depends_on_the_step_and_the_seed_alone(views, tour):
    steps = range(120)
    one, same, other = (BatchSampler([0] * views, 2, seed=seed, **tour) for seed in (1, 1, 2))
    ahead = [same.batch(step) for step in reversed(steps)][::-1]
    assert [one.batch(step) for step in steps] == ahead
    assert [other.batch(step) for step in steps] != ahead


def test_fewer_views_than_the_batch():
    assert BatchSampler([0], 4, seed=0).batch(7) == [0, 0, 0, 0]
    refused(ValueError, "no training views", BatchSampler, [], 4, seed=0)


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


K = np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])


def oblique(place, azimuth, height=10.0):
    """A camera at (x, y, height) that looks 45 degrees down, at a place `height` away."""
    forward = np.array([np.cos(azimuth), np.sin(azimuth), -1.0]) / np.sqrt(2)
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = -pose[:3, :3] @ np.append(place, height)
    return Camera("view", 64, 64, K, pose)


def test_neighbours_of_a_tour_show_the_same_places():
    """Four oblique cameras a place: those that show the same place are elsewhere, and look elsewhere."""
    centres = [(x, y) for x in range(0, 80, 10) for y in range(0, 80, 10)]
    azimuths = np.arange(4) * np.pi / 2
    cameras = [oblique(centre, azimuth) for centre in centres for azimuth in azimuths]
    shown = np.array([np.array(c) + 10 * np.array((np.cos(a), np.sin(a))) for c in centres for a in azimuths])
    grid = np.arange(-20.0, 92.0, 1.5)
    points = np.stack((*np.meshgrid(grid, grid), np.zeros((len(grid), len(grid)))), axis=-1).reshape(-1, 3)
    order = tour_of(cameras, points)
    assert sorted(order) == list(range(len(cameras)))

    def step(places):
        return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))

    random = np.random.default_rng(0).permutation(len(cameras))
    # Neighbours show the same place or the next one, 10 away; along the flight it is 14.
    assert step(shown[order]) < 10.1
    assert step(shown) > 14.0
    assert step(shown[random]) > 30.0


def test_cameras_without_points_are_visited_by_their_own_places():
    centres = np.random.default_rng(1).permutation(np.arange(16.0))
    cameras = [oblique((x, 0.0), 0.0) for x in centres]
    assert centres[tour_of(cameras, np.zeros((0, 3)))].tolist() == sorted(centres)
