# SPDX-License-Identifier: Apache-2.0
"""A training step: its loss, and memory that follows the visible Gaussians."""

import json

import numpy as np
import pytest
import torch

from blitzgs.config.fields import LossConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.frame.ownership import TileOwners
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.initialisation import INITIAL_OPACITY
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.training.batches import Batch
from blitzgs.training.loss import loss_terms, opacity_term, photometric, scale_term, weighted
from blitzgs.training.step import Stepper
from blitzgs.training.trainer import Trainer
from blitzgs.view.gate import ViewGate
from tests.helpers import DEVICES, parameter_gradients
from tests.training.tiny import look_at_origin, random_gaussians, tiny_config, tiny_scene


def test_a_step_marks_its_stages_and_lowers_the_loss():
    config, table = tiny_config(), random_gaussians(300)
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), 1.0, "cpu")
    stepper = Stepper(table, optimiser, TileOwners(Ranks()), config.loss, 1.0)
    viewmat = torch.from_numpy(look_at_origin(np.array([3.0, 0.0, 1.5]))).float()[None]
    K = torch.tensor([[[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]])
    views, options = Views(viewmat, K, 80, 60), RenderOptions(0, 0.05, 100.0)
    targets = torch.full((1, 60, 80, 3), 90, dtype=torch.uint8)
    batch = Batch([0], views, targets, None, torch.full((1,), 3.0 * 60 * 80), None)
    losses = []
    for step in range(1, 30):
        stages = []
        frame, terms, sums = stepper.forward(step, options, batch, stages.append)
        assert stages == ["other", "optimiser", "project", "exchange", "sort", "raster", "loss", "other"]
        stages.clear()
        stepper.backward(step, frame, terms, stages.append)
        assert stages == ["raster back", "exchange back", "optimiser", "other"]
        losses.append(photometric(sums.read(), batch.samples, config.loss).item())
    assert losses[-1] < losses[0] - 0.01


EXTENT, CONFIG = 1.7, LossConfig(opacity=0.3, scale=0.5, scale_reference=2.0)


@pytest.mark.parametrize("device", DEVICES)
def test_regularisers_are_means_over_the_visible_gaussians_of_a_view(device):
    plain = random_gaussians(300)
    table = GaussianTable({name: plain[name].to(device) for name in plain})
    poses = [look_at_origin(np.array([2.0 * np.cos(a), 2.0 * np.sin(a), 0.5])) for a in (0.0, 1.0, 3.0)]
    viewmats = torch.from_numpy(np.stack(poses)).float().to(device)
    K = torch.tensor([[90.0, 0, 40], [0, 90.0, 30], [0, 0, 1]], device=device).repeat(3, 1, 1)
    views = Views(viewmats, K, 80, 60)
    frame = pipeline.forward(table, views, RenderOptions(0, 0.05, 100.0))
    targets = torch.zeros((3, 60, 80, 3), dtype=torch.uint8, device=device)
    samples = torch.full((3,), 3.0 * 60 * 80, device=device)
    terms = loss_terms(frame, Batch([0, 1, 2], views, targets, None, samples, None), CONFIG, EXTENT)

    scales, opacities = (table[name].double().requires_grad_() for name in ("scales", "opacities"))
    views_of, ids_of = frame.projected.camera_ids, frame.projected.gaussian_ids.long()
    expected = []
    for view in range(3):
        seen = ids_of[views_of == view]
        assert 50 < len(seen) < 300  # so that the views' means differ
        axes = scales[seen].exp() / EXTENT
        expected.append(torch.stack([axes.amin(1).mean() / 2, opacities[seen].sigmoid().mean()]))
    found = scale_term(frame, table, 2 * EXTENT), opacity_term(frame, table)
    torch.testing.assert_close(torch.stack(found, 1).double(), torch.stack(expected), rtol=1e-5, atol=0)

    weights = torch.tensor([0.5, 0.3], dtype=torch.float64, device=device)
    (torch.stack(expected) @ weights).mean().backward()
    no_images = torch.zeros_like(frame.renders)
    regularisers = terms.scale_reg, terms.opacity_reg
    _, _, v_scales, v_opacities, _ = parameter_gradients(table, frame, no_images, *regularisers)
    visible = frame.projected.visible_ids.long()
    for got, want in ((v_scales, scales.grad[visible]), (v_opacities, opacities.grad[visible])):
        torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=1e-6 * float(want.abs().max()))


def test_the_logged_loss_has_all_terms(tmp_path):
    """In the first step all Gaussians are round and have the same opacity, so the terms are known."""
    first, fixed = {}, ("log.every=1", "schedule.iterations=8", "loss.scale=0")
    for override in ("loss.opacity=0", "loss.opacity=2", "loss.scale=5"):
        Trainer(tiny_config(*fixed, override), *tiny_scene(), tmp_path / override, Ranks()).train()
        lines = (tmp_path / override / "log.jsonl").read_text().splitlines()
        first[override] = next(record for record in map(json.loads, lines) if "loss" in record)
    plain = first["loss.opacity=0"]
    axis = first["loss.scale=5"]["l_scale"]
    for override, term in (("loss.opacity=2", 2 * INITIAL_OPACITY), ("loss.scale=5", 5 * axis)):
        assert first[override]["loss"] - plain["loss"] == pytest.approx(term, rel=1e-4)


@pytest.mark.parametrize(
    ("views", "opacity"), [(1, 0.05), (22, 0.05), (50, 0.022), (110, 0.01), (5_000, 0.005)]
)
def test_the_opacity_term_follows_the_number_of_views_within_what_was_measured(views, opacity):
    found = weighted(LossConfig(opacity_total=1.1, scale=0.7), views)
    assert found.opacity == pytest.approx(opacity) and found.opacity_total == 0 and found.scale == 0.7
    assert weighted(found, views + 1) == found  # a resumed run keeps its weight
    assert weighted(CONFIG, views) == CONFIG


SEEN = 20_000
WIDTH, HEIGHT = 80, 60


def table_of(unseen: int, device: str) -> GaussianTable:
    """`SEEN` Gaussians before the camera, and others far behind it."""
    rows = random_gaussians(SEEN + unseen)
    rows["scales"].sub_(1.5)
    rows["means"][SEEN:] += torch.tensor([1e4, 0.0, 0.0])
    rows["means"][SEEN:] *= 1 + torch.rand(unseen, 1, generator=torch.Generator().manual_seed(1))
    table = GaussianTable({name: rows[name].to(device) for name in rows})
    table.permute(morton_order(table["means"]))
    return table


def peak_bytes(run, device: str) -> int:
    """Return the largest number of bytes requested at one time while `run()` runs, beyond those before it."""
    if device == "cuda":
        # Requested bytes, and not allocated ones (`max_memory_allocated`): for more than 1 MiB, torch uses a
        # free block whole if less than 1 MiB of it would remain, and the free blocks depend on the table.
        torch.cuda.synchronize()
        before = torch.cuda.memory_stats()["requested_bytes.all.current"]
        torch.cuda.reset_peak_memory_stats()
        run()
        return torch.cuda.memory_stats()["requested_bytes.all.peak"] - before
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as all:
        run()
    events = [e for e in all.profiler.kineto_results.events() if e.name() == "[memory]"]
    assert len(events) > 20
    sums = np.cumsum([e.nbytes() for e in sorted(events, key=lambda e: e.start_ns())])
    return max(0, int(sums.max()))


def scratch_of_a_step(unseen: int, device: str) -> int:
    config, table = tiny_config(), table_of(unseen, device)
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), 1.0, device)
    stepper = Stepper(table, optimiser, TileOwners(Ranks(device=torch.device(device))), config.loss, 1.0)
    viewmat = torch.from_numpy(look_at_origin(np.array([3.0, 0.0, 1.5]))).float()[None].to(device)
    K = torch.tensor([[[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]], device=device)
    targets = torch.full((1, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8, device=device)
    samples = torch.full((1,), 3.0 * HEIGHT * WIDTH, device=device)
    batch = Batch([0], Views(viewmat, K, WIDTH, HEIGHT), targets, None, samples, None)
    options, gate = RenderOptions(0, 0.05, 100.0), ViewGate([1e3], 1)

    def step(number: int) -> None:
        frame, terms, sums = stepper.forward(number, options, batch, view_filter=gate)
        stepper.backward(number, frame, terms, keep_means2d=True)
        sums.read()

    for number in range(1, 6):  # capacities are estimated, and every row is behind
        step(number)
    return peak_bytes(lambda: step(6), device)


@pytest.mark.parametrize("device", DEVICES)
def test_scratch_of_a_step_does_not_grow_with_what_is_not_seen(device):
    few, many = scratch_of_a_step(40_000, device), scratch_of_a_step(16 * 40_000, device)
    assert few > 8 * SEEN  # the step saw Gaussians, and its memory was measured
    assert many <= 1.01 * few, f"{(many - few) / (15 * 40_000):.3f} bytes for each row that no view sees"
