# SPDX-License-Identifier: Apache-2.0
"""Exposures of photographs are found against renders, keep their mean, and survive a resume."""

from types import SimpleNamespace

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.training.exposure import LEAST_SPREAD, Exposures

GAINS = torch.tensor([0.8, 0.9, 1.0, 1.1, 1.2])
BIASES = torch.tensor([0.02, 0.0, -0.02, 0.01, -0.01])
TRAIN = [3, 4, 7, 9, 10]


def measured(gains, biases, mask=None, visits=8):
    """Return exposures after some visits of views whose photographs have these gains and biases."""
    torch.manual_seed(0)
    exposures = Exposures(TRAIN, Ranks())
    for _ in range(visits):
        renders = torch.rand(len(TRAIN), 64, 48, 3) * 0.6 + 0.15
        photos = renders * gains[:, None, None, None] + biases[:, None, None, None]
        if mask is not None:
            photos = photos.where(mask[..., None] != 0, torch.rand_like(photos))
        batch = SimpleNamespace(
            indices=TRAIN, targets=(photos * 255).round().to(torch.uint8), masks=mask, ranges=None
        )
        exposures.measure(4, renders, batch)
    return exposures


def test_finds_gains_and_biases_and_keeps_their_mean():
    found = measured(GAINS, BIASES).effective()
    assert torch.allclose(found[:, 0], GAINS[:, None].double().expand(-1, 3), atol=0.02)
    assert torch.allclose(found[:, 1], BIASES[:, None].double().expand(-1, 3), atol=0.01)
    assert torch.allclose(found.mean(0), torch.tensor([[1.0] * 3, [0.0] * 3]).double(), atol=1e-12)


def test_masked_pixels_do_not_count():
    mask = torch.zeros(len(TRAIN), 64, 48, dtype=torch.uint8)
    mask[:, :, :24] = 1
    found = measured(GAINS, BIASES, mask).effective()
    assert torch.allclose(found[:, 0], GAINS[:, None].double().expand(-1, 3), atol=0.03)


def test_photographs_that_agree_are_taken_as_they_are():
    gains, biases = measured(1 + 0.5 * LEAST_SPREAD * (GAINS - 1) / GAINS.std(), 0 * BIASES).of(TRAIN)
    assert torch.equal(gains, torch.ones_like(gains)) and torch.equal(biases, torch.zeros_like(biases))


def test_views_that_were_not_trained_on_have_the_common_exposure():
    gains, biases = measured(GAINS, BIASES).of([5, 3])
    assert gains[0].eq(1).all() and biases[0].eq(0).all()
    assert abs(gains[1].mean() - 0.8) < 0.02


def test_saved_exposures_are_restored():
    first = measured(GAINS, BIASES)
    second = Exposures(TRAIN, Ranks())
    second.restore(first.columns())
    assert torch.equal(first.effective(), second.effective()) and torch.equal(first.counts, second.counts)
    other = Exposures(TRAIN[1:], Ranks())
    other.restore(first.columns())
    assert other.counts.sum() == 0
