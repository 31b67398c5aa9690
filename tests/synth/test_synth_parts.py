# SPDX-License-Identifier: Apache-2.0
"""The parts of the synthetic city: patterns, plan, flight, rays."""

import numpy as np
import pytest

pytest.importorskip("embreex")

from blitzgs_synth.city import tower_height
from blitzgs_synth.flight import flight_height, plan_flight
from blitzgs_synth.noise import Noise, cell_random, inside, stripes
from blitzgs_synth.options import PRESETS, CityOptions
from blitzgs_synth.plan import Plan
from blitzgs_synth.raycast import RayCaster
from blitzgs_synth.tracks import ball, may_see


def test_stripes_and_intervals_are_box_filtered():
    x = np.linspace(-5, 5, 20001, dtype=np.float32)
    sharp = ((x / 1.5) % 1 < 0.3).astype(np.float64)
    width = 0.4
    kernel = np.ones(round(width / (x[1] - x[0])))
    filtered = np.convolve(sharp, kernel / len(kernel), "same")[2000:-2000]
    got = stripes(x, 1.5, 0.0, 0.3, np.full_like(x, width))[2000:-2000]
    np.testing.assert_allclose(got, filtered, atol=4e-3)
    edge = inside(np.array([0.9, 1.0, 1.05, 1.2], np.float32), 0.0, 1.0, np.full(4, 0.2, np.float32))
    np.testing.assert_allclose(edge, [1.0, 0.5, 0.25, 0.0], atol=1e-6)


def test_noise_tiles_and_is_standardised():
    noise = Noise(3)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 64, (2, 50_000)).astype(np.float32)
    values = noise(x, y)
    assert abs(values.mean()) < 0.02 and abs(values.std() - 1) < 0.02
    np.testing.assert_allclose(noise(x - 64, y + 128), values, atol=0.05)
    assert np.abs(noise(x, y) - noise(x + np.float32(0.01), y)).max() < 0.2
    assert noise(x[:0], y[:0]).shape == (0,)


def test_cell_random_is_uniform_and_depends_on_every_argument():
    i, j = (a.ravel().astype(np.float32) for a in np.meshgrid(np.arange(-100, 100), np.arange(-100, 100)))
    value = cell_random(i, j, 7)
    assert value.min() >= 0 and value.max() < 1
    counts, _ = np.histogram(value, 20, (0, 1))
    assert np.abs(counts / len(value) - 0.05).max() < 0.006
    for other in (
        cell_random(i + 1, j, 7),
        cell_random(i, j + 1, 7),
        cell_random(i, j, 8),
        cell_random(j, i, 7),
    ):
        assert abs(np.corrcoef(value, other)[0, 1]) < 0.03


def test_bending_is_undone_exactly():
    plan = Plan(CityOptions(extent=300))
    points = np.random.default_rng(1).uniform(-200, 200, (1000, 3))
    bent = plan.bend(points)
    assert 1 < np.abs(bent - points)[:, :2].max() < 20
    x, y = plan.unbend(bent[:, 0].astype(np.float32), bent[:, 1].astype(np.float32))
    np.testing.assert_allclose(np.stack([x, y], 1), points[:, :2], atol=2e-3)


@pytest.mark.parametrize("name", PRESETS)
def test_flights_cover_the_city_above_its_towers(name):
    options = PRESETS[name]
    views = plan_flight(options)
    assert len(views) == options.views and len({v.name for v in views}) == options.views
    assert flight_height(options) > 1.3 * tower_height(Plan(options))
    headings = set()
    # Without oblique views, the images end a little before the edge.
    line = np.linspace(-0.5, 0.5, 9) * (1 if options.oblique > 0 else 0.9) * options.extent
    spots = np.stack([a.ravel() for a in np.meshgrid(line, line)], 1)
    seen = np.zeros(len(spots), int)
    for view in views:
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) > 0 and view.rotation[2, 2] < 0
        ahead = view.rotation.T @ np.array([0.3, -0.2, 1.0])
        pixel, _ = view.project((view.centre + 50 * ahead)[None])
        np.testing.assert_allclose(view.directions(pixel)[0], ahead / np.linalg.norm(ahead), atol=1e-9)
        tilted = view.rotation[2, :2]
        if np.linalg.norm(tilted) > 0.5:
            headings.add(round(np.degrees(np.arctan2(*tilted)) / 90) % 4)
        pixels, depth = view.project(np.pad(spots, ((0, 0), (0, 1))))
        seen += (depth > 0) & ((pixels > 0) & (pixels < (view.width, view.height))).all(1)
    assert headings == ({0, 1, 2, 3} if options.oblique > 0 else set())
    assert seen.min() >= (4 if options.oblique > 0 else 1)


def test_no_group_of_points_in_view_is_passed_over():
    rng = np.random.default_rng(0)
    views = plan_flight(CityOptions(extent=600, views=20))
    groups = [c + rng.normal(0, rng.uniform(1, 40), (30, 3)) for c in rng.uniform(-400, 400, (60, 3))]
    balls = np.stack([ball(g) for g in (*groups, np.zeros((0, 3)))])
    passed_over = 0
    for view in views:
        may = may_see(view, balls)
        assert not may[-1]
        for group, considered in zip(groups, may, strict=False):
            pixels, depth = view.project(group)
            inside = ((pixels > 0) & (pixels < (view.width, view.height))).all(1) & (depth > 0)
            assert considered or not inside.any()
        passed_over += (~may).sum()
    assert passed_over > 0.5 * len(views) * len(groups)


def test_rays_hit_what_they_should():
    square = np.array([[[0, 0, 1], [2, 0, 1], [2, 2, 1]], [[0, 0, 1], [2, 2, 1], [0, 2, 1]]], np.float32)
    caster = RayCaster(square)
    origins = np.array([[1.5, 0.5, 5], [0.5, 1.5, 5], [3, 3, 5], [1, 0.5, 0]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, -1], [0, 0, -1], [0, 0, 1]], np.float32)
    hits = caster.hit(origins, directions)
    assert hits.triangle.tolist() == [0, 1, -1, 0]
    np.testing.assert_allclose(hits.distance[[0, 1, 3]], [4, 4, 1], rtol=1e-6)
    assert caster.occluded(origins, directions).tolist() == [True, True, False, True]
    assert caster.occluded(origins[:0], directions[:0]).shape == (0,)


def test_missing_embree_is_explained(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "embreex.rtcore_scene", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'blitzgs\[synth\]'"):
        RayCaster(np.zeros((1, 3, 3), np.float32))
