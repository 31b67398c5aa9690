# SPDX-License-Identifier: Apache-2.0
"""Runs are fitted into a wall time, and finished ones are trained longer; the tests set the clocks."""

import json
import math
import random
import shutil
import warnings
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from blitzgs.cli import main
from blitzgs.config.fields import Config, OptimiserConfig, ScheduleConfig
from blitzgs.config.files import ConfigError, load_config
from blitzgs.config.ranges import problems
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.resume import check_before_capture, check_resumable
from blitzgs.training.budget import Budget, extended
from blitzgs.training.replay import replay
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.training.tiny import (
    OVERRIDES,
    as_flags,
    assert_same_table,
    events_of,
    make_trainer,
    stop_at,
    tiny_config,
    tiny_scene,
    train,
    write_tiny_capture,
)

SECONDS = 2.4
BUDGET = ("schedule.minutes=0.04", "schedule.densify_until=50")


class Simulation:
    """Simulates a run: a function of the time in the configuration gives the seconds per image."""

    def __init__(self, minutes, cost, **schedule):
        self.config = Config(schedule=ScheduleConfig(minutes=minutes, **schedule))
        self.schedule = Schedule(self.config.schedule)
        self.progress = SimpleNamespace(step=0, seconds=0.0)
        self.ranks = Ranks()
        self.cost = cost
        self.texts = []
        self.log = SimpleNamespace(event=lambda t, kind, values, text: self.texts.append(text))

    @property
    def images_seen(self):
        return self.progress.step * self.schedule.batch_size

    def change_pace(self, factor):
        pace = (*self.config.schedule.pace, (self.images_seen, factor))
        self.config = replace(self.config, schedule=replace(self.config.schedule, pace=pace))
        self.schedule = Schedule(self.config.schedule)

    def train(self):
        """Return the seconds of the whole run, and those until density control ended."""
        budget, first = Budget(self), None
        while self.progress.step < self.schedule.steps:
            time = self.schedule.pace.time(self.images_seen)
            self.progress.seconds += self.schedule.batch_size * self.cost(time, self.progress.step)
            self.progress.step += 1
            if first is None and time >= self.config.schedule.densify_until:
                first = self.progress.seconds
            budget.after(self.progress.step)
        return self.progress.seconds, first


def growing(start, factor):
    """Seconds per image: `factor` times as many once density control has ended."""
    return lambda time, step: start * (1 + (factor - 1) * min(time / 15_000, 1))


@pytest.mark.parametrize("batch_size", [1, 4])
@pytest.mark.parametrize("minutes", [0.5, 5.0, 60.0])
@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0, 10.0])
def test_a_run_that_slows_down_ends_on_time(minutes, batch_size, factor):
    simulation = Simulation(minutes, growing(0.02, factor), batch_size=batch_size)
    seconds, first = simulation.train()
    assert seconds == pytest.approx(60 * minutes, rel=0.01)
    assert 0.3 < first / seconds < 0.6
    assert len(simulation.config.schedule.pace) < 60


def test_the_shape_of_the_schedule_stays():
    """If images take three times as long at the end, both halves get about the same number of images."""
    simulation = Simulation(5.0, growing(0.004, 3.0))
    simulation.train()
    half = simulation.schedule.pace.image(15_000) / simulation.schedule.iterations
    assert half == pytest.approx(0.5, abs=0.03)


def test_noise_and_single_slow_steps_do_no_harm():
    chance = random.Random(0)

    def cost(time, step):
        slow = 40.0 if step in (5, 40, 700) else 1.0
        warm_up = 300.0 if step == 0 else 1.0
        return growing(0.02, 3.0)(time, step) * math.exp(chance.gauss(0.0, 0.5)) * slow * warm_up

    seconds, _ = Simulation(1.0, cost).train()
    assert seconds == pytest.approx(60.0, rel=0.05)


def test_a_short_budget_is_used_and_an_impossible_one_ends_soon():
    simulation = Simulation(1.0, lambda time, step: 3.0)
    seconds, _ = simulation.train()
    assert seconds == pytest.approx(60.0, abs=6.0)
    # The budget ends before the run has measured its speed, so the schedule ends soon after.
    impossible = Simulation(0.01, lambda time, step: 3.0)
    impossible.train()
    assert impossible.progress.step <= 24


def test_a_run_has_no_more_images_than_a_run_may_have():
    simulation = Simulation(1e6, lambda time, step: 1.0, iterations=30_000)
    budget, planned = Budget(simulation), 0
    for _ in range(40):
        simulation.progress.step, simulation.progress.seconds = budget.next_step, budget.next_step * 1e-4
        budget.after(simulation.progress.step)
        planned = max(planned, simulation.schedule.iterations)
    assert 9_000_000 < planned <= 10_000_000
    assert list(problems(simulation.config)) == []


def start(folder, *overrides, resume=False, ranks=None, haste=1.0):
    """A trainer whose images take 10 ms, and longer the more Gaussians there are."""
    trainer = make_trainer(folder, *BUDGET, *overrides, ranks=ranks, resume=resume)
    state, now = trainer.state, [0.0]
    state.clock = lambda: now[0]
    step = trainer.step

    def timed(number):
        now[0] += haste * 0.01 * state.schedule.batch_size * state.population() / 400
        step(number)

    trainer.step = timed
    return trainer


def stopped(folder, number):
    """A trainer that was stopped after step `number`."""
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, number)
        trainer = start(folder)
        assert trainer.train() is None
    return trainer


@pytest.fixture(scope="module")
def timed_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("timed")
    trainer = start(folder)
    return folder, trainer, trainer.train()


def test_training_ends_on_time_and_says_what_it_chose(timed_run):
    folder, trainer, summary = timed_run
    assert summary["gaussians"] > 450  # the run has slowed down
    assert summary["seconds"] == pytest.approx(SECONDS, rel=0.05)
    assert summary["budget_seconds"] == pytest.approx(SECONDS)
    assert summary["scale"] == summary["images"] / 100
    plans = events_of(folder, "pace")
    assert len(plans) == len(trainer.state.config.schedule.pace) >= 3
    assert plans[-1]["images"] == summary["images"]
    assert plans[-1]["seconds"] == pytest.approx(SECONDS, rel=0.05)
    assert load_config(folder / "config.yaml") == trainer.state.config


def test_the_saved_configuration_repeats_the_run_without_the_clock(timed_run, tmp_path):
    folder, trainer, summary = timed_run
    config = load_config(folder / "config.yaml", ["schedule.minutes=0"])
    again = Trainer(config, *tiny_scene(), tmp_path, Ranks())
    repeated = again.train()
    assert repeated["psnr"] == summary["psnr"] and "budget_seconds" not in repeated
    assert_same_table(again.state.table, trainer.state.table)


@pytest.mark.parametrize("stop", [2, 6, 70])
def test_a_run_resumes_before_and_after_it_has_chosen_its_pace(tmp_path, stop):
    first = stopped(tmp_path, stop)
    before = first.state.config.schedule.pace
    assert bool(before) == (stop > 8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert trained_model.open_model(tmp_path, Ranks()).config.schedule.pace == before
    second = start(tmp_path, resume=True)
    # The time that the checkpoint was trained counts, also if the command changes the budget.
    assert second.state.config.schedule.pace == before
    taken = second.state.optimiser.lr_table[: stop + 1]
    assert torch.equal(taken, first.state.optimiser.lr_table[: stop + 1])
    summary = second.train()
    assert second.state.config.schedule.pace[: len(before)] == before
    assert torch.equal(second.state.optimiser.lr_table[: stop + 1], taken)
    assert summary["seconds"] == pytest.approx(SECONDS, rel=0.05)


def test_a_resumed_run_may_have_more_time_but_not_lose_its_budget(tmp_path):
    stopped(tmp_path, 70)
    with pytest.raises(ConfigError, match=r"schedule.minutes: the checkpoint was trained with 0.04, now 0"):
        start(tmp_path, "schedule.minutes=0", resume=True)
    summary = start(tmp_path, "schedule.minutes=0.06", resume=True).train()
    assert summary["seconds"] == pytest.approx(3.6, rel=0.05)


def test_a_new_run_measures_anew_whatever_its_configuration_has_noted(tmp_path):
    noted = "schedule.pace=[[16, 0.5]]"
    assert start(tmp_path / "new", noted).state.config.schedule.pace == ()
    assert start(tmp_path / "nothing", noted, resume=True).state.config.schedule.pace == ()
    assert start(tmp_path / "fixed", noted, "schedule.minutes=0").state.config.schedule.pace == ((16, 0.5),)


def test_a_gate_is_not_replayed_on_a_run_by_the_clock(tmp_path):
    config = tiny_config("schedule.minutes=2", "population.lineage=true")
    arms = replay(config, *tiny_scene(), tmp_path / "run", tmp_path / "out", None, 0.5, Ranks())
    refused(ValueError, r"was trained with schedule.minutes \(2\): its arms would differ", next, arms)


def _train_on_ranks(ranks, folder):
    trainer = start(folder, ranks=ranks, haste=1.0 + 4.0 * ranks.rank)
    summary = trainer.train()
    return summary, trainer.state.config.schedule.pace, trainer.state.progress.step


def test_ranks_whose_clocks_differ_take_the_same_steps(tmp_path):
    (first, pace, step), (_, other_pace, other_step) = run_ranks(_train_on_ranks, 2, tmp_path)
    assert pace == other_pace and len(pace) >= 3 and step == other_step
    assert first["seconds"] == pytest.approx(SECONDS, rel=0.05)


def test_the_command_takes_minutes(tmp_path, capsys):
    write_tiny_capture(tmp_path / "data")
    flags = as_flags("config=defaults", *OVERRIDES)
    command = ["train", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), *flags]
    assert main([*command, "--minutes=0.02"]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["budget_seconds"] == pytest.approx(1.2) and summary["scale"] > 0
    capsys.readouterr()
    assert main([*command, "--minutes=0.02", "--schedule.scale=0.5"]) != 0
    assert "schedule.scale: must be 1 with schedule.minutes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("overrides", "by", "images"),
    [
        ((), 1.5, 150),
        ((), 2, 200),
        ((), 100, 200),
        ((), 1000, 1100),
        (("schedule.scale=0.5",), 2, 100),
        (("schedule.scale=0.5",), 100, 150),
        (("schedule.batch_size=4",), 1.5, 152),
        (("schedule.pace=[[50, 2.0]]",), 2, 300),
    ],
)
def test_the_new_length(overrides, by, images):
    config = tiny_config(*overrides)
    before = Schedule(config.schedule)
    after = Schedule(extended(config, before.steps, by).schedule)
    assert after.iterations == images
    # Nothing before the old end changes.
    assert after.events(0, before.iterations) == before.events(0, before.iterations)
    old, new = (schedule.learning_rates(OptimiserConfig(final=0.1), 1.0) for schedule in (before, after))
    assert torch.equal(new[: len(old)], old)


def test_a_run_that_is_not_finished_is_not_extended():
    refused(ConfigError, r"not .* \(50 of 100 images\): continue .*--resume", extended, tiny_config(), 50, 2)
    refused(ConfigError, "schedule", extended, tiny_config(), 100, 1e9)


def extend(folder, by):
    config = load_config(folder / run_files.CONFIG)
    return Trainer(config, *tiny_scene(), folder, Ranks(), resume=True, extend=by)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run."""
    folder = tmp_path_factory.mktemp("finished")
    train(folder)
    return folder


def test_an_interrupted_extension_ends_as_an_uninterrupted_one(finished, tmp_path, monkeypatch):
    tables = []
    for name in ("whole", "parts"):
        folder = shutil.copytree(finished, tmp_path / name)
        if name == "whole":
            running = extend(folder, 1.4)
        else:
            with monkeypatch.context() as patch:
                stop_at(patch, 120)
                assert extend(folder, 1.4).train() is None
            refused(ConfigError, r"not finished \(120 of 140 images\)", extend, folder, 2)
            running = extend(folder, None)
        assert running.train()["images"] == 140
        tables.append(running.state.table)
        assert json.loads((folder / "summary.json").read_text())["images"] == 140
    assert_same_table(*tables)


@pytest.mark.parametrize("by", [1.4, None])
def test_an_extension_that_was_killed_before_its_first_checkpoint_goes_on(finished, tmp_path, by):
    folder = shutil.copytree(finished, tmp_path / "run")
    extend(folder, 1.4).close()  # its configuration is written, its checkpoint is not
    check_before_capture(folder, load_config(folder / run_files.CONFIG), extends=False)
    assert extend(folder, by).train()["images"] == 140


def test_only_a_finished_run_becomes_longer():
    longer = tiny_config("schedule.iterations=140")
    check_resumable(tiny_config(), longer, step=100)
    check_resumable(tiny_config("schedule.minutes=5"), longer, step=100)
    refused(ConfigError, "schedule.iterations", check_resumable, tiny_config(), longer, 99)
    refused(ConfigError, "schedule.iterations", check_resumable, longer, tiny_config(), 140)
