# SPDX-License-Identifier: Apache-2.0
"""Exposures and gains of photographs are found, keep their mean, and survive a resume."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.cameras import LEAST_SPREAD, stored_exposures
from blitzgs.training.exposure import Exposures
from blitzgs.training.inputs import open_capture
from blitzgs.training.track_gains import _log_gains, differ, track_gains
from blitzgs.training.trainer import Trainer
from blitzgs_synth.generate import generate_city
from tests.distributed.rank_harness import run_ranks
from tests.training.tiny import assert_same_table, stop_at, tiny_config, tiny_scene

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
    assert torch.equal(stored_exposures(first.columns()), first.effective()) and stored_exposures({}) is None
    other = Exposures(TRAIN[1:], Ranks())
    other.restore(first.columns())
    assert other.counts.sum() == 0


def train_on_unequal_photographs(folder, resume=False):
    capture, images = tiny_scene()
    gains = np.linspace(0.75, 1.25, len(images.images))
    images.images = [
        (image.float() * gain).clamp(0, 255).byte() for image, gain in zip(images.images, gains, strict=True)
    ]
    config = tiny_config("model.exposure=true", "population.strategy=relocation")
    trainer = Trainer(config, capture, images, folder, Ranks(), resume)
    return trainer, trainer.train()


def test_a_resumed_run_repeats_every_bit_and_a_render_shows_the_exposures(tmp_path, monkeypatch):
    whole, summary = train_on_unequal_photographs(tmp_path / "whole")
    assert summary["exposure"]["least"] < 0.95 < 1.05 < summary["exposure"]["most"]
    assert summary["warnings"] == [] and summary["largest_fall"] == 0
    stop_at(monkeypatch, 50)
    train_on_unequal_photographs(tmp_path / "parts")
    monkeypatch.undo()
    resumed, _ = train_on_unequal_photographs(tmp_path / "parts", resume=True)
    assert_same_table(resumed.state.table, whole.state.table)
    assert torch.equal(resumed.state.stepper.exposures.measured, whole.state.stepper.exposures.measured)
    content = json.loads((tmp_path / "whole" / "exposures.json").read_text())
    train = [whole.state.capture.cameras[index].name for index in whole.state.capture.train]
    assert list(content) == train
    np.testing.assert_allclose(list(content.values()), whole.state.stepper.exposures.effective(), atol=1e-5)
    out = {}
    for name, flags in (("mean", []), ("own", ["--exposure"])):
        folder = tmp_path / name
        arguments = ["render", str(tmp_path / "whole"), "--split", "all", "--raw", "--out", str(folder)]
        assert main([*arguments, *flags]) == 0
        out[name] = [np.load(path) for path in sorted(folder.glob("*.npy"))]
    brighter = [own.mean() > mean.mean() for own, mean in zip(out["own"], out["mean"], strict=True)]
    assert not brighter[0] and brighter[-1] and np.array_equal(out["own"][3], out["mean"][3])


def measure_with(ranks):
    generator = torch.Generator().manual_seed(1)
    renders = torch.rand(2, 64, 96, 3, generator=generator)
    targets = (renders * 200).byte()
    ranges = TileOwners(ranks).divide([0, 1], 96, 64, 16) if ranks.world_size > 1 else None
    exposures = Exposures([0, 1], ranks)
    exposures.measure(4, renders, SimpleNamespace(indices=[1, 0], targets=targets, masks=None, ranges=ranges))
    return exposures.columns()["exposures"]


def test_any_number_of_ranks_measures_the_same_bits():
    alone = measure_with(Ranks())
    assert (alone[:, 0] != 1).all()
    for found in run_ranks(measure_with, 3):
        assert torch.equal(found, alone)


def test_gains_are_found_where_each_photograph_has_other_points():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.2, (12, 3))
    truth -= truth.mean(0)
    colors = rng.normal(4, 0.5, (900, 3))
    rows = []
    for view in range(12):
        points = np.sort((np.arange(300) + 55 * view) % 900)
        shown = colors[points] + truth[view] + rng.normal(0, 0.01, (300, 3))
        shown[::10] += 2  # something stands before the point
        rows.append((points, shown))
    assert np.abs(_log_gains(rows, 900) - truth).max() < 0.05


@pytest.mark.parametrize("exposure", [0.0, 0.2])
def test_photographs_of_fields_differ_if_their_exposures_do(tmp_path, exposure):
    pytest.importorskip("embreex")
    folder = generate_city(
        tmp_path / "fields", extent=60, views=8, width=96, height=64, points_per_view=80, oblique=0,
        built=False, grain=2.0, exposure=exposure,
    )  # fmt: skip
    config = tiny_config(f"data.path={str(folder)!r}", "data.split=0")
    capture, images = open_capture(config, Ranks())
    gains = track_gains(capture, images, Ranks())
    images.close()
    assert gains is not None and torch.allclose(gains.mean(0), torch.ones(3).double())
    assert differ(gains) == (exposure > 0)
