# SPDX-License-Identifier: Apache-2.0
"""The statistics that density control reads, against autograd, also of photographs of lower resolution."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from blitzgs.config.files import ConfigError
from blitzgs.ops.photometric import photometric_loss
from blitzgs.reference import render
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import run_ranks
from tests.training import tiny
from tests.training.tiny import (
    HEIGHT,
    WIDTH,
    assert_same_table,
    events_of,
    steps_of,
    tiny_scene,
    train,
    trained_in_parts,
)

# No event changes the Gaussians within the steps of a test; statistics are gathered.
QUIET = (
    "schedule.iterations=200", "schedule.densify_from=150", "schedule.densify_until=180",
    "schedule.sh_every=2", "model.antialiased=true",
)  # fmt: skip


def make_trainer(folder, *overrides) -> Trainer:
    """A trainer of eight training views, each of which sees a part of the Gaussians."""
    scene, images = tiny_scene()
    scene.train, scene.test = list(range(8)), []
    for camera in scene.cameras:
        camera.K = camera.K * np.array([[2.5, 1, 1], [1, 2.5, 1], [1, 1, 1]])
    trainer = tiny.make_trainer(folder, *QUIET, *overrides, scene=(scene, images))
    trainer.state.start_clock()
    return trainer


def of_one_view(trainer: Trainer, index: int, sh_degree: int, reduction: int) -> tuple[torch.Tensor, ...]:
    """Return gradient norm (half images), visibility and radius of each Gaussian in a view, by autograd.

    The view has a lower resolution: width and height are divided by `reduction`.
    """
    width, height = WIDTH // reduction, HEIGHT // reduction
    K = torch.tensor([[1 / reduction], [1 / reduction], [1]])
    state, table = trainer.state, trainer.state.table
    views = state.views.pick([index])
    model, extent = state.config.model, state.space.extent
    image = render(
        table["means"].double().requires_grad_(), table["quats"], table["scales"].double().exp(),
        table["opacities"].double().sigmoid(), table["sh"], views.viewmats[0], views.Ks[0] * K, width, height,
        sh_degree=sh_degree, near_plane=model.near * extent, antialiased=model.antialiased,
    )  # fmt: skip
    target = cv2.resize(state.images.get(index).numpy(), (width, height), interpolation=cv2.INTER_AREA)
    target = torch.from_numpy(target)[None]
    loss = photometric_loss(image.image[None], target, None, state.config.loss.ssim)
    (gradient,) = torch.autograd.grad(loss.sum(), image.splats.means2d)
    splats, count = image.splats, len(table)
    norms, seen, radii = torch.zeros(count).double(), torch.zeros(count).bool(), torch.zeros(count).double()
    norms[splats.ids] = (gradient * torch.tensor([width / 2, height / 2])).norm(dim=1)
    a, b, c = splats.conics.detach().unbind(dim=1)
    # A Gaussian counts if the box around alpha >= 1/255 overlaps the image.
    sigmas = (2 * (255 * splats.opacities.detach()).clamp(min=1).log()).sqrt()
    spread = torch.stack([c, a], dim=1) / (a * c - b * b)[:, None]
    half, size = sigmas[:, None] * spread.sqrt(), torch.tensor([width, height])
    centres = splats.means2d.detach()
    seen[splats.ids] = ((centres + half > 0) & (centres - half < size)).all(dim=1) & (sigmas > 0)
    # 3 sigma along the longer axis; INRIA's renderer takes round splats for a little larger than they are.
    # The radius is that in the whole photograph.
    half_trace = reduction**2 * spread.sum(dim=1) / 2
    gap = (half_trace**2 - reduction**4 / (a * c - b * b)).clamp(min=0.1)
    radii[splats.ids] = 3 * (half_trace + gap.sqrt()).sqrt()
    return norms, seen, radii


@pytest.mark.parametrize(("batch_size", "resolution"), [(1, ()), (3, ()), (3, ((2, 6),)), (1, ((2, 4),))])
def test_statistics_are_those_of_autograd(tmp_path, batch_size, resolution):
    """Over several steps that change the Gaussians, through loss, compositing and projection."""
    reduced = f"schedule.resolution={[list(pair) for pair in resolution]}"
    trainer = make_trainer(tmp_path, f"schedule.batch_size={batch_size}", reduced)
    table, steps = trainer.state.table, 4
    sums, counts = torch.zeros(len(table)).double(), torch.zeros(len(table)).int()
    radii = torch.zeros(len(table)).double()
    batches = []
    get = trainer.loader.get
    trainer.loader.get = lambda *step: batches.append(get(*step)) or batches[-1]
    for step in range(steps):
        before = {name: table[name].clone() for name in table}
        with torch.no_grad():
            trainer.step(step + 1)
        after = {name: table[name].clone() for name in table}
        for name in table:  # the values that the step read
            table[name].copy_(before[name])
        trainer.state.optimiser.catch_up(table, None, step)
        degree = trainer.state.schedule.sh_degree(step * batch_size, 3)
        for index in batches[step].indices:
            reduction = 2 if resolution and step * batch_size < resolution[0][1] else 1
            norms, seen, reach = of_one_view(trainer, index, degree, reduction)
            sums += norms
            counts += seen
            radii = torch.maximum(radii, reach.where(seen, 0))
        for name in table:
            table[name].copy_(after[name])
    assert len(set(sum((batch.indices for batch in batches), []))) == min(8, steps * batch_size)
    assert trainer.state.progress.sh_degree > 0
    assert counts.max() == steps * batch_size and counts.min() < counts.max()
    assert torch.equal(table["grad_count"], counts)
    error = (table["grad_sum"] - sums).abs() / sums.mean()
    # If rounding decides whether a splat covers a pixel, the gradients of that pixel's few splats differ.
    assert error.median() < 1e-6 and error.quantile(0.9) < 2e-5 and error.max() < 0.02
    excess = table["max_radii"] - radii  # rounded up to whole pixels
    assert excess.min() > -1e-3 and excess.max() < 1 + 1e-3
    trainer.close()


RISING = ("schedule.resolution=[[2, 40]]", "schedule.iterations=60")


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, *train(folder, *RISING)


def test_the_log_tells_the_resolution_and_the_measurements_have_all_of_it(whole_run, tmp_path):
    folder, trainer, summary = whole_run
    told = [(event["t"], event["reduction"]) for event in events_of(folder, "resolution")]
    assert told == [(0, 2), (40, 1)]
    _, other = train(tmp_path, "schedule.iterations=60")
    assert not events_of(tmp_path, "resolution")
    assert summary["psnr"] == pytest.approx(other["psnr"], abs=1.5) and summary["psnr"] != other["psnr"]
    assert list(steps_of(folder)) and trainer.loader.views_masked[1] == 7


def test_a_run_resumes_exactly_while_its_resolution_is_lower(whole_run, tmp_path):
    _, whole, _ = whole_run
    resumed = trained_in_parts(train, tmp_path, 30, *RISING)
    assert_same_table(resumed.state.table, whole.state.table)
    assert [event["t"] for event in events_of(tmp_path, "resolution")] == [0, 40]


def _train(ranks, folder):
    trainer, _ = train(folder, *RISING, "schedule.batch_size=2", ranks=ranks)
    return trainer.state.population()


def test_two_ranks_share_a_run_whose_resolution_rises(tmp_path):
    alone, _ = train(tmp_path / "alone", *RISING, "schedule.batch_size=2")
    counts = run_ranks(_train, 2, tmp_path / "together")
    first, other = steps_of(tmp_path / "alone"), steps_of(tmp_path / "together")
    assert [record["t"] for record in first] == [record["t"] for record in other] == [20, 40, 60]
    for one, two in zip(first, other, strict=True):
        assert two["loss"] == pytest.approx(one["loss"], rel=1e-3)
    assert counts[0] == counts[1] == pytest.approx(alone.state.population(), rel=0.02)


def test_photographs_that_become_too_small_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"schedule\.resolution: divided by 4, .* at least 11 .* 48 x 32"):
        train(tmp_path, "schedule.resolution=[[4, 40]]")
