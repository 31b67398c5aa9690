# SPDX-License-Identifier: Apache-2.0
"""The adaptive schedule: its measurements, the times that it places, and repeating a run with them."""

import itertools
import json
import math
import random
from dataclasses import replace

import pytest
import torch

from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.files import ConfigError
from blitzgs.config.pace import Pace
from blitzgs.config.schedule import Schedule, latest_times
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from blitzgs.training.adaptive import SETTLED, Signals
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import on_each_device, run_ranks
from tests.training import tiny_runs
from tests.training.tiny import tiny_config, tiny_scene
from tests.training.tiny_runs import assert_same_table, events_of, read_log, stop_at

CONFIG = ScheduleConfig(
    iterations=3_000, densify_from=100, densify_until=1_500, densify_every=50, t1=800, t2=1_600, adaptive=True
)
FLAGS = (
    "schedule.adaptive=true",
    "schedule.iterations=160",
    "schedule.densify_every=8",
    "schedule.densify_from=16",
    "schedule.densify_until=80",
    "schedule.t1=48",
    "schedule.t2=96",
    "population.importance=true",
    "view.lod=true",
    "log.pictures=0",
)


def signals(demand=(), epochs=()):
    return Signals(demand=list(demand), epochs=[list(epoch) for epoch in epochs])


def place(found, config, time):
    return found.next_place(config, Pace(1.0, ()), time)


def epochs_of_50(rate, until=3_000):
    """Epochs of a loss that falls by `rate` per length of the schedule."""
    return [(end, 0.1 * math.exp(-rate * end / CONFIG.iterations)) for end in range(50, until + 1, 50)]


def test_t1_comes_when_demand_has_fallen():
    falling = [0.2, 0.2, 0.2, 0.2, 0.1, 0.05, 0.05]
    early, late = 0.6 * CONFIG.t1, latest_times(CONFIG)[0]
    assert late == 1_120
    assert place(signals(falling), CONFIG, early - 1) is None
    where, reason = place(signals(falling), CONFIG, early + 0.5)
    assert where == early + 1
    assert reason == "density control asks for 6.67% of the Gaussians, 20.00% at most before"
    assert place(signals([0.2, 0.2, 0.15, 0.15, 0.15]), CONFIG, late - 1) is None
    where, reason = place(signals([0.2] * 5), CONFIG, late + 3)
    assert (where, reason) == (late, "the latest that schedule.adaptive_limit allows")
    assert place(signals(falling[-3:]), CONFIG, early) is None  # there are too few measurements
    assert place(signals(), replace(CONFIG, t1=0), 0.0) == (0, "there is none")


def test_densification_ends_with_demand_or_when_the_loss_settles():
    config, now = replace(CONFIG, placed=(700,)), 1_000.0
    wanted = [0.2] * 6
    assert place(signals(wanted), config, now) is None
    where, reason = place(signals([*wanted, 0.02, 0.01, 0.0]), config, now)
    assert where == 1_000 and reason.startswith("density control asks for 1.00% of")
    for rate, settled in ((1.1 * SETTLED, False), (0.9 * SETTLED, True)):
        found = place(signals(wanted, epochs_of_50(rate, 950)), config, now)
        assert (found is not None) == settled
        assert not settled or "until 950, over 1 epochs each" in found[1]
    # A reset of opacities raises the loss, so spans with a reset in them do not count: here from 850 to 950.
    calm = signals(wanted, epochs_of_50(0, 950))
    for reset_every, settled in ((400, True), (450, False), (850, False), (849, True), (0, True)):
        found = place(calm, replace(config, reset_every=reset_every), now)
        assert (found is not None) == settled, reset_every
    after = replace(config, placed=(700, 880), reset_every=900)  # there is none after densification
    assert place(signals((), epochs_of_50(0, 1_000)), after, 1_000) is not None
    # Measurements before T1 are not used for the times after it.
    assert place(signals(wanted, epochs_of_50(0, 750)), config, now) is None
    assert place(signals(wanted, epochs_of_50(0, 800)), config, now) is not None
    # Short epochs are joined to spans of a sixtieth of the schedule.
    short = [(end, 0.1) for end in range(20, 801, 20)]
    assert "over 3 epochs each" in place(signals(wanted, [*short, (820, 0.1)]), config, now)[1]
    assert place(signals(wanted, short), config, now) is None


def test_t2_comes_when_the_loss_has_settled_after_densification():
    config = replace(CONFIG, placed=(700, 1_200))
    assert place(signals((), epochs_of_50(0, 1_250)), config, 1_300) is None
    assert place(signals((), epochs_of_50(0, 1_300)), config, 1_259) is None  # 0.6 of the distance of 100
    assert place(signals((), epochs_of_50(0, 1_300)), config, 1_300)[0] == 1_300
    assert place(signals([0.0] * 9), config, 1_360) is None
    assert place(signals(), replace(config, placed=(700, 1_200, 1_360)), 2_999) is None


def test_demand_includes_clones_that_were_held_back_or_vetoed():
    found, nothing = Signals(), {"cloned": 0, "split": 0, "pruned": 0, "held_back": 0, "vetoed": 0}
    for counts, share in (
        ({"cloned": 10, "split": 5, "pruned": 20, "gaussians": 195}, 0.075),
        ({"held_back": 30, "vetoed": 20, "gaussians": 200}, 0.25),
        ({"cloned": 12, "relocated": 8, "held_back": 6, "gaussians": 104}, 0.1),  # 4 more, and 8 elsewhere
    ):
        found.densified(nothing | {"relocated": 0} | counts)
        assert found.demand[-1] == pytest.approx(share)


def test_the_loss_is_that_of_whole_epochs():
    found, sums = Signals(), HostSum(Ranks(), torch.tensor([[[6.0, 1.0]], [[12.0, 1.0]]]).double())
    for step in range(1, 6):
        found.add(sums, views=2, pixels=3, images=2 * step, epoch=4)
    again = Signals.of(json.loads(json.dumps(found.saved())))
    assert again == found
    assert found.epochs == [[4, 1.0], [8, 1.0]] and found.loss == (2.0, 2)


@pytest.mark.parametrize("batch_size", [1, 4])
def test_placing_a_time_does_not_change_past_events(batch_size):
    chance = random.Random(5)
    for scale in (0.3, 1.0, 2.0):
        config = replace(CONFIG, batch_size=batch_size, scale=scale, reset_every=300)
        schedule, happened, step = Schedule(config), [], 0
        while step < schedule.steps:
            begin, step = step * batch_size, step + 1
            events = schedule.events(begin, begin + batch_size)
            happened += [event for event in events if event.kind != "place"]
            if any(event.kind == "place" for event in events):
                time = schedule.pace.time(step * batch_size)
                index = len(config.placed)
                if time >= (latest := latest_times(config)[index]):
                    config = replace(config, placed=(*config.placed, latest))
                elif chance.random() < 0.05 and time > 200:
                    config = replace(config, placed=(*config.placed, math.ceil(time)))
                schedule = Schedule(config)
        assert len(config.placed) == 3
        assert config.placed[0] <= config.placed[1] <= config.placed[2]
        fixed = Schedule(replace(config, adaptive=False))
        assert happened == fixed.events(0, fixed.iterations)
        kinds = [event.kind for event in happened]
        assert kinds.count("pass_1") == kinds.count("pass_2") == kinds.count("clear_cull") == 1


def train(folder, *overrides, resume=False):
    return tiny_runs.train(folder, *FLAGS, *overrides, resume=resume)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("adaptive")
    return folder, *train(folder)


def test_a_run_places_its_times_and_says_why(whole_run):
    folder, trainer, summary = whole_run
    placed = trainer.state.config.schedule.placed
    assert len(placed) == 3 and list(placed) == sorted(placed)
    for place, fixed in zip(placed, (48, 80, 96), strict=True):
        assert 0.6 * fixed - 1 <= place <= 1.4 * fixed
    assert placed != (48, 80, 96)
    assert [summary["placed"][name]["time"] for name in ("t1", "densify_until", "t2")] == list(placed)
    logged = events_of(folder, "place")
    assert [record["time"] for record in logged] == list(placed)
    assert all(record["reason"] for record in logged)
    assert [record["reason"] for record in logged] == [x["reason"] for x in summary["placed"].values()]
    times = {record["event"]: record["t"] for record in read_log(folder) if "event" in record}
    assert times["pass_1"] == placed[0] and times["pass_2"] == placed[2]
    assert times["densify"] < placed[1]
    assert trainer.state.signals.epochs and trainer.state.signals.demand
    assert json.loads((folder / "summary.json").read_text())["placed"] == summary["placed"]


def test_a_fixed_run_with_the_places_is_the_same(whole_run, tmp_path):
    _, whole, _ = whole_run
    placed = list(whole.state.config.schedule.placed)
    fixed, summary = train(tmp_path, "schedule.adaptive=false", f"schedule.placed={placed}")
    assert_same_table(fixed.state.table, whole.state.table)
    assert "placed" not in summary and fixed.state.signals is None


@pytest.mark.parametrize("last", [32, 41, 57, 90])
def test_resume_is_exact(whole_run, tmp_path, monkeypatch, last):
    """The run stops when it reads its signals, within an epoch, and after placed times."""
    _, whole, _ = whole_run
    stop_at(monkeypatch, last)
    assert train(tmp_path)[1] is None
    monkeypatch.undo()
    second, summary = train(tmp_path, resume=True)
    assert second.state.config.schedule.placed == whole.state.config.schedule.placed
    assert second.state.signals.saved() == whole.state.signals.saved()
    assert_same_table(second.state.table, whole.state.table)
    assert summary["placed"] == whole_run[2]["placed"]


def _train_on(ranks, folder):
    trainer = Trainer(tiny_config(*FLAGS), *tiny_scene(), folder, ranks)
    trainer.train()
    return trainer.state.config.schedule.placed, trainer.state.signals.saved()


@pytest.mark.parametrize(("world_size", "device"), on_each_device(2))
def test_all_ranks_make_the_same_decision(whole_run, tmp_path, world_size, device):
    answers = run_ranks(_train_on, world_size, tmp_path, device=device)
    assert all(answer == answers[0] for answer in answers)
    if device == "cpu":
        assert answers[0][0] == whole_run[1].state.config.schedule.placed


@pytest.mark.parametrize("flag", ["schedule.scale=0.5", "schedule.minutes=0.02"])
def test_places_are_times_of_the_configuration(tmp_path, flag):
    trainer = Trainer(tiny_config(*FLAGS, flag), *tiny_scene(), tmp_path, Ranks())
    trainer.state.clock = itertools.count(0, 0.01).__next__  # an image takes a hundredth of a second
    summary = trainer.train()
    placed = trainer.state.config.schedule.placed
    assert summary["images"] == pytest.approx(80 if "scale" in flag else 120, rel=0.2)
    for place, fixed in zip(placed, (48, 80, 96), strict=True):
        assert 0.6 * fixed - 1 <= place <= 1.4 * fixed
    assert list(summary["placed"]) == ["t1", "densify_until", "t2"]


def test_errors_name_the_value():
    with pytest.raises(ConfigError, match="adaptive: needs t1 <= densify_until <= t2.*got 48, 80 and 70"):
        tiny_config(*FLAGS, "schedule.t2=70")
    with pytest.raises(ConfigError, match=r"placed: must be up to 3 times.*got \[50, 40\]"):
        tiny_config(*FLAGS, "schedule.placed=[50, 40]")
    with pytest.raises(ConfigError, match=r"schedule.adaptive_limit: must be in \[0, 1\)"):
        tiny_config(*FLAGS, "schedule.adaptive_limit=1")
