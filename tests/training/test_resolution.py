# SPDX-License-Identifier: Apache-2.0
"""Runs that begin with photographs of a lower resolution; test_density_statistics.py has their gradients."""

import pytest
import torch

from blitzgs.config.files import ConfigError
from blitzgs.distributed.group import Ranks
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import Views
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import run_ranks
from tests.training.test_offload import assert_same_run
from tests.training.test_offload import train as train_street
from tests.training.tiny import HEIGHT, WIDTH, tiny_config, tiny_scene
from tests.training.tiny_runs import assert_same_table, events_of, steps_of, stop_at, train

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
    assert list(steps_of(folder)) and trainer.loader.views_read == 7


def test_a_step_renders_the_camera_of_the_reduced_photograph(tmp_path):
    trainer = Trainer(tiny_config(*RISING), *tiny_scene(), tmp_path, Ranks())
    state, frames = trainer.state, []
    forward = state.stepper.forward

    def kept(*args, **named):
        frames.append(forward(*args, **named)[0])
        return forward(*args, **named)

    state.stepper.forward = kept
    before = state.table["means"].clone()
    state.start_clock()
    with torch.no_grad():
        trainer.step(1)
    trainer.close()
    (frame,), (view,) = frames, state.sampler.batch(0)
    index = state.capture.train[view]
    K = torch.from_numpy(state.capture.cameras[index].K).float()
    K[:2] *= 0.5
    views = Views(state.views.pick([index]).viewmats, K[None], WIDTH // 2, HEIGHT // 2)
    fresh = Trainer(tiny_config(), *tiny_scene(), tmp_path / "fresh", Ranks())
    fresh.close()
    assert torch.equal(fresh.state.table["means"], before)
    expected = pipeline.forward(fresh.state.table, views, frame.options).renders
    assert torch.equal(frame.renders, expected) and expected.std() > 0.05


def test_a_run_resumes_exactly_while_its_resolution_is_lower(whole_run, tmp_path, monkeypatch):
    _, whole, _ = whole_run
    stop_at(monkeypatch, 30)
    assert train(tmp_path, *RISING)[1] is None
    monkeypatch.undo()
    resumed, _ = train(tmp_path, *RISING, resume=True)
    assert_same_table(resumed.state.table, whole.state.table)
    assert [event["t"] for event in events_of(tmp_path, "resolution")] == [0, 40]


def test_gaussians_in_host_memory_are_those_that_the_lower_resolution_sees(tmp_path):
    options = ("schedule.resolution=[[2, 30]]", "schedule.iterations=45", "lod.visible_threshold=0")
    whole, _ = train_street(tmp_path / "whole", *options)
    pooled, _ = train_street(tmp_path / "pooled", *options, "memory.resident_gb=0.0078")
    assert_same_run(pooled, whole)


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
