# SPDX-License-Identifier: Apache-2.0
"""Merged Gaussians against sums in float64, one cell after the other."""

import math
from collections import defaultdict

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from blitzgs.formats.proxies import merged, moments, shown
from tests.formats.test_tiles import city

BOX = np.array([[0.0, 0, 0], [40, 30, 4]])


def covariances_of(model):
    turns = Rotation.from_quat(np.roll(model.quats.double().numpy(), -1, axis=1)).as_matrix()
    return turns @ (np.exp(2 * model.scales.double().numpy())[:, :, None] * turns.transpose(0, 2, 1))


def area(covariance):
    """Return the root of a third of the sum of squared products of two semi-axes."""
    a, b, c = np.linalg.eigvalsh(covariance)
    return math.sqrt((a * b + a * c + b * c) / 3)


@pytest.mark.parametrize("antialiased", [True, False])
def test_cells_have_the_moments_of_their_gaussians(antialiased):
    model = city(1500)
    rows, edge = merged(moments(model), 100, BOX, antialiased)
    assert 40 < len(rows) <= 100 and 1 < edge < 40
    blur = 0 if antialiased else 0.3 * edge**2
    means, covariances = model.means.double().numpy(), covariances_of(model)
    opacities, sh = model.opacities.double().sigmoid().numpy(), model.sh.double().flatten(1).numpy()
    # Cells are cubes of the box, of which the longest side is 2; outside they grow with the distance.
    places = (means - BOX.mean(axis=0)) / 20
    far = np.abs(places) > 1
    places[far] = np.sign(places[far]) * (1 + np.log(np.abs(places[far])))
    cells = defaultdict(list)
    for row, place in enumerate((places - places.min(axis=0)) / (edge / 20)):
        cells[tuple(np.floor(place))].append(row)
    assert len(cells) == len(rows)
    for (_, inside), row in zip(sorted(cells.items()), rows, strict=True):
        w = np.array([opacities[i] * area(covariances[i] + blur * np.eye(3)) for i in inside])
        mean = w @ means[inside] / w.sum()
        away = means[inside] - mean
        spread = np.einsum("n,ni,nj->ij", w, away, away) + np.einsum("n,nij->ij", w, covariances[inside])
        spread /= w.sum()
        cover = w.sum() / area(spread + blur * np.eye(3))
        np.testing.assert_allclose(row[:3], mean, rtol=1e-5, atol=1e-5)
        scale = np.abs(spread).max()
        np.testing.assert_allclose(row[3:9], spread[np.triu_indices(3)], rtol=1e-4, atol=2e-6 * scale)
        np.testing.assert_allclose(row[9], cover, rtol=1e-4)
        np.testing.assert_allclose(row[10:], w @ sh[inside] / w.sum(), rtol=1e-4, atol=1e-6)


def test_a_gaussian_alone_stays_and_covers_widen():
    model = city(50)
    rows = moments(model)
    same, edge = merged(rows, 50, BOX, True)
    assert len(same) == 50 and edge < 0.01
    again = shown(same, ["comment x"])
    order = model.means[:, 0].argsort()
    back = again.means[:, 0].argsort()
    torch.testing.assert_close(again.means[back], model.means[order])
    torch.testing.assert_close(again.sh[back], model.sh[order])
    torch.testing.assert_close(again.opacities[back], model.opacities[order], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        covariances_of(again)[back.numpy()], covariances_of(model)[order.numpy()], rtol=1e-3, atol=1e-5
    )
    assert again.comments == ["comment x"] and again.levels is None
    for cover, wider, opacity in ((0.4, 1, 0.4), (1.5, 1.5**0.5, 0.999), (7.0, 1.38, 0.999)):
        rows[:, 9] = cover
        found = shown(rows, [])
        np.testing.assert_allclose(
            found.scales.sort(dim=1).values, model.scales.sort(dim=1).values + math.log(wider), atol=2e-3
        )
        np.testing.assert_allclose(found.opacities.sigmoid(), opacity, rtol=1e-5)


def test_any_number_of_cells_is_kept_and_invisible_gaussians_are_merged():
    model = city(300)
    model.opacities[:] = -200.0
    for most in (1, 7):
        rows, _ = merged(moments(model), most, BOX, True)
        assert 1 <= len(rows) <= most and np.isfinite(rows).all()
        shown(rows, []).check()
    least = merged(moments(model), 300, BOX, True, 5.0)
    assert least[1] == pytest.approx(5.0) and len(least[0]) < 300
    one_place = model.means.clone()
    model.means[:] = one_place[0]
    assert len(merged(moments(model), 300, BOX, True)[0]) == 1
