# SPDX-License-Identifier: Apache-2.0
"""Trainings with a part of the Gaussians on the device are those with all of them there."""

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.evaluation import render_view
from blitzgs.table.blocks import morton_order
from blitzgs.table.pool import Pool, PoolError
from blitzgs.table.table import GaussianTable
from blitzgs.view.visible import VisibleFinder
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.training import tiny
from tests.training.tiny import (
    HEIGHT,
    WIDTH,
    Camera,
    assert_same_table,
    photographed,
    random_gaussians,
    sorted_rows,
    steps_of,
    stop_at,
    trained_in_parts,
)

COUNT, VIEWS = 4000, 12
RESIDENT = "memory.resident_gb=0.0039"
SETTINGS = (
    "lod.visible_threshold=0", "schedule.iterations=60", "population.max_gaussians=20000",
    "population.grad_threshold=2e-4",
)  # fmt: skip
TOUR = (RESIDENT, "memory.tour=true")


def street(count=COUNT):
    """Gaussians along a street, and cameras above it that each see a piece."""
    truth = random_gaussians(count)
    truth["means"][:, 0] *= 20
    K = np.array([[40.0, 0.0, 24.5], [0.0, 41.0, 15.0], [0.0, 0.0, 1.0]])
    down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    cameras = []
    for i, x in enumerate(np.linspace(-22, 22, VIEWS)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = down, -down @ np.array([x, 0.1 * (i % 3), 4.0])
        cameras.append(Camera(f"{i:02}.png", WIDTH, HEIGHT, K, pose))
    return photographed(truth, cameras, test=5, extent=24.0)


def make_trainer(folder, *overrides, **how):
    return tiny.make_trainer(folder, *SETTINGS, *overrides, scene=street(), **how)


def train(folder, *overrides, device="cpu", resume=False):
    ranks = Ranks(device=torch.device(device))
    return tiny.train(folder, *SETTINGS, *overrides, scene=street(), ranks=ranks, resume=resume)


def assert_same_run(one, other):
    assert_same_table(sorted_rows(one.state.table), sorted_rows(other.state.table))
    assert one.state.progress.peak_gaussians == other.state.progress.peak_gaussians


VARIANTS = {
    "plain": (),
    "batches": ("schedule.batch_size=2", "memory.resident_gb=0.0065"),
    "resolution": ("schedule.resolution=[[2, 40]]",),
    "passes": (
        "population.importance=true", "schedule.t1=30", "schedule.t2=48", "view.cull=true", "view.lod=true",
        "schedule.densify_until=40", "schedule.evaluate_every=25", "schedule.checkpoint_every=35",
    ),
    "smooth": (
        "population.importance=true", "schedule.t1=24", "schedule.t2=40", "view.lod=smooth",
        "schedule.densify_until=32", "schedule.densify_every=4",
    ),
    "relocation": ("population.strategy=relocation", "population.min_opacity=0.08", "loss.opacity=0.01"),
    "resets": ("schedule.reset_every=15", "optimiser.position_noise=1000", "model.antialiased=true"),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_run_with_a_quarter_of_its_blocks_on_the_device_is_the_same_run(tmp_path, variant, device):
    options = (*VARIANTS[variant], "model.deterministic=true")
    resident = [option for option in options if not option.startswith("memory")]
    whole, expected = train(tmp_path / "whole", *resident, device=device)
    pooled, summary = train(tmp_path / "pooled", RESIDENT, *options, device=device)
    assert len(pooled.state.stepper.table) < 0.42 * len(pooled.state.table)
    assert_same_run(pooled, whole)
    for name in ("psnr", "ssim", "gaussians"):
        assert summary[name] == expected[name]
    assert 0 <= summary["resident_hits"] < 1 and summary["moved_mb_per_step"] > 0
    assert "resident_hits" not in expected
    records = steps_of(tmp_path / "pooled")
    shares = [record["resident_hits"] for record in records]
    assert len(shares) == 3 and all(0 <= share < 1 for share in shares)
    assert all(record["moved_mb_per_step"] > 0 for record in records)


def test_a_run_goes_on_with_and_without_a_pool(tmp_path, monkeypatch):
    whole, _ = train(tmp_path / "whole")
    for at, overrides in ((17, [RESIDENT]), (41, [])):
        stop_at(monkeypatch, at)
        assert train(tmp_path / "cut", *overrides, resume=at > 17)[1] is None
        monkeypatch.undo()
    resumed, _ = train(tmp_path / "cut", RESIDENT, resume=True)
    assert_same_run(resumed, whole)


def test_a_tour_moves_less_and_shows_the_same_views(tmp_path):
    # Without figures in between, for which all blocks would be read.
    options = ("schedule.densify_until=0", "schedule.iterations=48", "schedule.evaluate_every=48")
    (random, usual_summary), (toured, summary) = (
        train(tmp_path / name, *options, *more) for name, more in (("random", [RESIDENT]), ("tour", TOUR))
    )
    views = len(toured.state.capture.train)
    drawn = [toured.state.sampler.batch(step)[0] for step in range(4 * views)]
    assert all(sorted(drawn[at : at + views]) == list(range(views)) for at in range(0, 4 * views, views))
    moved, usual = (run.state.stepper.report(whole=True) for run in (toured, random))
    assert 0 < moved["moved_mb_per_step"] < 0.7 * usual["moved_mb_per_step"]
    assert moved["resident_hits"] > usual["resident_hits"]
    assert abs(summary["psnr"] - usual_summary["psnr"]) < 0.3


def test_a_tour_goes_on_where_it_was_interrupted(tmp_path):
    whole, _ = train(tmp_path / "whole", *TOUR)
    assert_same_run(trained_in_parts(train, tmp_path / "cut", 23, *TOUR), whole)


def _train(ranks, folder, overrides):
    trainer = make_trainer(folder, *overrides, ranks=ranks)
    trainer.train()
    table = trainer.state.table
    return {name: table[name].clone() for name in table}


def test_two_ranks_share_a_run_beyond_their_memory(tmp_path):
    options = ("population.importance=true", "schedule.t1=30", "schedule.t2=0", "schedule.iterations=45")
    whole = run_ranks(_train, 2, tmp_path / "whole", options)
    pooled = run_ranks(_train, 2, tmp_path / "pooled", (*options, "memory.resident_gb=0.003"))
    expected, got = (
        {name: torch.cat([share[name] for share in shares]) for name in shares[0]}
        for shares in (whole, pooled)
    )
    assert_same_table(sorted_rows(got), sorted_rows(expected))


def test_a_model_with_a_cull_mask_is_rendered_through_a_pool(tmp_path, monkeypatch):
    stop_at(monkeypatch, 15)  # the mask is cleared later
    trainer, _ = train(tmp_path, RESIDENT, "schedule.iterations=30", "view.lod=true",
                       "schedule.densify_until=10", "population.importance=true", "population.pass1_keep=1",
                       "schedule.t1=12", "schedule.t2=0", "view.cull=true")  # fmt: skip
    model, ranks = trained_model.open_model(tmp_path, Ranks()), Ranks()
    table = model.table
    lod = model.progress.model_gate(model.config, table, ranks)
    options, owners = trainer.state.render_options, TileOwners(ranks)
    resident, views = VisibleFinder(table, lod), trainer.state.views
    expected = [render_view(resident, views, i, options, owners) for i in (0, 5)]
    whole = GaussianTable({name: table[name].clone() for name in table})
    pool = model.subject(ranks).gaussians
    finder = VisibleFinder(pool, lod)
    assert isinstance(pool, Pool) and len(pool.held) < 0.42 * len(whole)
    for i, image in zip((0, 5), expected, strict=True):
        assert torch.equal(render_view(finder, views, i, options, owners), image)
        assert image.std() > 0.01
    pool.write_back()
    assert_same_table(model.table, whole)


def test_rows_are_sorted_for_a_pool_or_for_another_number_of_ranks(tmp_path):
    """Density events sort the rows rarely, and those of each rank alone."""
    train(tmp_path / "one", "schedule.iterations=20")
    run_ranks(_train, 2, tmp_path / "two", ("schedule.iterations=20",))
    restored = trained_model.restore(tmp_path / "two", Ranks())
    assert restored.progress.sorted_spread == 0
    model = trained_model.open_model(tmp_path / "one", Ranks(), resident_gb=0.1)
    pool = model.subject(Ranks()).gaussians
    resumed = make_trainer(tmp_path / "one", "schedule.iterations=20", RESIDENT, resume=True)
    for table in (restored.table, pool.table, resumed.state.table):
        assert torch.equal(morton_order(table["means"]), torch.arange(len(table)))


def test_a_batch_that_does_not_fit_is_named(tmp_path):
    refused(PoolError, r"see \d+ blocks of 256 .* lower sch", train, tmp_path, "memory.resident_gb=0.001")
    assert not list((tmp_path / run_files.CHECKPOINTS).iterdir())


@pytest.mark.parametrize(
    ("options", "resumed"),
    [
        (("population.grad_threshold=1e-6", "schedule.densify_until=60"), "resumed from"),
        # The first step fits into the pool, and the pass behind it surveys views that see more blocks.
        (
            ("schedule.iterations=20", "population.importance=true", "schedule.t1=1", "schedule.t2=0"),
            "after 2 steps",
        ),
    ],
    ids=["step", "pass"],
)
def test_what_outgrows_its_pool_costs_nothing_and_happens_with_a_larger_one(tmp_path, options, resumed):
    whole, _ = train(tmp_path / "whole", *options)
    small = (tmp_path / "pooled", *options, "memory.resident_gb=0.0026")
    refused(PoolError, r"The model so far is saved: continue with --resume", train, *small)
    if resumed == "resumed from":  # nothing new to save
        refused(PoolError, r"lower schedule.batch_size$", train, *small, resume=True)
    larger, _ = train(tmp_path / "pooled", *options, "memory.resident_gb=0.1", resume=True)
    assert resumed in larger.state.origin and "after 0 steps" not in larger.state.origin
    assert_same_run(larger, whole)


def test_a_mask_for_a_table_of_less_than_a_block(tmp_path):
    passes = ("population.importance=true", "schedule.t1=30", "schedule.t2=0", "view.cull=true")
    options = ("population.grad_threshold=1e30", "schedule.iterations=45", "lod.visible_threshold=0", *passes)
    runs = [
        tiny.train(tmp_path / name, *options, *more, scene=street(50))[0]
        for name, more in (("pooled", [RESIDENT]), ("whole", []))
    ]
    assert all(0 < len(run.state.table) < 256 for run in runs)
    assert_same_run(*runs)
