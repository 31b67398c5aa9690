# SPDX-License-Identifier: Apache-2.0
"""A step of the trainer, and the exposures of photographs."""

import json
import pkgutil
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.config.fields import LossConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.frame.transport.protocol import stages_told_to
from blitzgs.ops.projection_types import Views
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.initialisation import INITIAL_OPACITY
from blitzgs.runs.cameras import LEAST_SPREAD
from blitzgs.runs.folder import open_run
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.training.batches import Batch
from blitzgs.training.exposure import Exposures, _log_gains, exposures_differ, track_gains
from blitzgs.training.inputs import open_capture
from blitzgs.training.loss import batch_psnr, loss_terms, opacity_term, photometric, scale_term, weighted
from blitzgs.training.records import measure_step
from blitzgs.training.step import Stepper
from blitzgs.training.trainer import Trainer
from blitzgs.view.gate import ViewGate
from blitzgs_synth.generate import generate_city
from tests.distributed.rank_harness import run_ranks
from tests.helpers import look_at_origin, parameter_gradients
from tests.training.tiny import (
    assert_same_table,
    events_of,
    random_gaussians,
    steps_of,
    tiny_config,
    tiny_scene,
    train,
    trained_in_parts,
)

WIDTH, HEIGHT = 80, 60
OPTIONS = RenderOptions(0, 0.05, 100.0)


def stepper_of(table: GaussianTable) -> tuple[Stepper, Batch]:
    """Return what takes steps with a table, and a batch of one grey photograph, for each step."""
    device, config = table.device, tiny_config()
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), 1.0, device)
    stepper = Stepper(table, optimiser, TileOwners(Ranks(device=device)), config.loss, 1.0)
    viewmat = torch.from_numpy(look_at_origin(np.array([3.0, 0.0, 1.5]))).float()[None].to(device)
    K = torch.tensor([[[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]], device=device)
    targets = torch.full((1, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8, device=device)
    samples = torch.full((1,), 3.0 * HEIGHT * WIDTH, device=device)
    return stepper, Batch([0], Views(viewmat, K, WIDTH, HEIGHT), targets, None, samples, None)


def test_a_step_tells_its_stages_and_lowers_the_loss():
    stepper, batch = stepper_of(random_gaussians(300))
    losses = []
    for step in range(1, 30):
        stages = []
        with stages_told_to(stages.append):
            frame, terms, sums = stepper.forward(step, OPTIONS, batch)
        assert stages == ["other", "optimiser", "project", "exchange", "sort", "raster", "loss", "other"]
        stages.clear()
        with stages_told_to(stages.append):
            stepper.backward(step, frame, terms)
        assert stages == ["raster back", "exchange back", "optimiser", "other"]
        losses.append(photometric(sums.read(), batch.samples, LossConfig()).item())
    assert losses[-1] < losses[0] - 0.01


EXTENT, CONFIG = 1.7, LossConfig(opacity=0.3, scale=2.5)


def test_regularisers_are_means_over_the_visible_gaussians_of_a_view(device):
    plain = random_gaussians(300)
    table = GaussianTable({name: plain[name].to(device) for name in plain})
    poses = [look_at_origin(np.array([2.0 * np.cos(a), 2.0 * np.sin(a), 0.5])) for a in (0.0, 1.0, 3.0)]
    viewmats = torch.from_numpy(np.stack(poses)).float().to(device)
    K = torch.tensor([[90.0, 0, 40], [0, 90.0, 30], [0, 0, 1]], device=device).repeat(3, 1, 1)
    views = Views(viewmats, K, 80, 60)
    frame = render_frame(table, views, OPTIONS)
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
        train(tmp_path / override, *fixed, override)
        first[override] = steps_of(tmp_path / override)[0]
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
    stepper, batch = stepper_of(table_of(unseen, device))
    gate = ViewGate([1e3], 1)

    def step(number: int) -> None:
        frame, terms, sums = stepper.forward(number, OPTIONS, batch, view_filter=gate)
        stepper.backward(number, frame, terms, keep_means2d=True)
        sums.read()

    for number in range(1, 6):  # capacities are estimated, and every row is behind
        step(number)
    return peak_bytes(lambda: step(6), device)


def test_scratch_of_a_step_does_not_grow_with_what_is_not_seen(device):
    few, many = scratch_of_a_step(SEEN, device), scratch_of_a_step(16 * SEEN, device)
    assert few > 8 * SEEN  # the step saw Gaussians, and its memory was measured
    assert many <= 1.01 * few, f"{(many - few) / (15 * SEEN):.3f} bytes for each row that no view sees"


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


@pytest.mark.parametrize("masked", [False, True])
def test_finds_gains_and_biases_of_what_is_not_masked_and_keeps_their_mean(masked):
    mask = torch.zeros(len(TRAIN), 64, 48, dtype=torch.uint8)
    mask[:, :, :24] = 1
    found = measured(GAINS, BIASES, mask if masked else None).effective()
    assert torch.allclose(found[:, 0], GAINS[:, None].double().expand(-1, 3), atol=0.03)
    assert torch.allclose(found[:, 1], BIASES[:, None].double().expand(-1, 3), atol=0.01)
    assert torch.allclose(found.mean(0), torch.tensor([[1.0] * 3, [0.0] * 3]).double(), atol=1e-12)


@pytest.mark.parametrize(("dark", "bright", "gain"), [(4, 251, 247 / 200), (3, 252, 1.0)])
def test_only_colours_that_are_cut_off_do_not_count(dark, bright, gain):
    renders = torch.full((5, 64, 48, 3), 20 / 255)
    renders[:, :, 24:] = 220 / 255
    targets = torch.where(renders > 0.5, bright, dark).to(torch.uint8)
    exposures = Exposures(TRAIN, Ranks())
    exposures.measure(4, renders, SimpleNamespace(indices=TRAIN, targets=targets, masks=None, ranges=None))
    assert torch.allclose(exposures.measured[:, 0], torch.tensor(gain).double(), atol=0.01)


def test_photographs_that_agree_are_taken_as_they_are():
    gains, biases = measured(1 + 0.5 * LEAST_SPREAD * (GAINS - 1) / GAINS.std(), 0 * BIASES).of(TRAIN)
    assert torch.equal(gains, torch.ones_like(gains)) and torch.equal(biases, torch.zeros_like(biases))


def train_on_unequal_photographs(folder, resume=False):
    _, images = scene = tiny_scene()
    gains = np.linspace(0.75, 1.25, len(images.images))
    images.images = [
        (image.float() * gain).clamp(0, 255).byte() for image, gain in zip(images.images, gains, strict=True)
    ]
    options = ("model.exposure=true", "population.strategy=relocation")
    return train(folder, *options, scene=scene, resume=resume)


def test_the_training_psnr_is_that_of_the_images_of_the_loss(tmp_path, monkeypatch):
    compared = []

    def call(function, *args):
        compared.append(args[-1].clone())
        return function(*args)

    for path in ("blitzgs.training.step.loss_terms", "blitzgs.training.records.batch_psnr"):
        monkeypatch.setattr(path, partial(call, pkgutil.resolve_name(path)))
    train_on_unequal_photographs(tmp_path)
    assert torch.equal(*compared[-2:])  # of the last step, which is logged


@pytest.mark.parametrize("background", ["[0.2, 0.3, 0.4]", "[0, 0, 0]"])
def test_the_training_psnr_is_that_over_the_background_of_the_run(tmp_path, monkeypatch, background):
    """Random colours behind a view that no Gaussian covers would decide on its PSNR."""
    compared = []

    def measure(state, frame, batch):
        expected = render_frame(state.table, frame.views, state.render_options).renders
        assert (frame.renders - expected).abs().mean() > 0.01
        compared.append(batch_psnr(frame, batch, expected).item())
        return measure_step(state, frame, batch)

    monkeypatch.setattr("blitzgs.training.trainer.measure_step", measure)
    options = ("model.random_background=true", f"model.background={background}", "schedule.iterations=20")
    train(tmp_path, *options)
    assert [record["psnr"] for record in steps_of(tmp_path)] == pytest.approx(compared, abs=1e-4)


def test_a_resumed_run_repeats_every_bit_and_a_render_shows_the_exposures(tmp_path):
    whole, summary = train_on_unequal_photographs(tmp_path / "whole")
    assert summary["exposure"]["least"] < 0.95 < 1.05 < summary["exposure"]["most"]
    assert summary["warnings"] == [] and summary["largest_fall"] == 0
    resumed = trained_in_parts(train_on_unequal_photographs, tmp_path / "parts", 50)
    assert_same_table(resumed.state.table, whole.state.table)
    assert torch.equal(resumed.state.stepper.exposures.measured, whole.state.stepper.exposures.measured)
    effective = whole.state.stepper.exposures.effective()
    assert torch.equal(open_run(tmp_path / "whole").model().exposures, effective)
    content = json.loads((tmp_path / "whole" / "exposures.json").read_text())
    train = [whole.state.capture.cameras[index].name for index in whole.state.capture.train]
    assert list(content) == train
    np.testing.assert_allclose(list(content.values()), effective, atol=1e-5)
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
    ranges = TileOwners(ranks).divide([0, 1], 96, 64) if ranks.world_size > 1 else None
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
    config = tiny_config(
        f"data.path={str(folder)!r}", "data.split=0", "model.exposure=true", "schedule.iterations=1"
    )
    capture, images = open_capture(config, Ranks())
    gains = track_gains(capture, images, Ranks())
    assert gains is not None and torch.allclose(gains.mean(0), torch.ones(3).double())
    assert exposures_differ(gains) == (exposure > 0)
    Trainer(config, capture, images, tmp_path / "run", Ranks()).train()
    images.close()
    hints = [event["hint"] for event in events_of(tmp_path / "run", "hint")]
    assert any("so none is modelled" in hint for hint in hints) == (exposure == 0)
