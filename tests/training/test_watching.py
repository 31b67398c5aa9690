# SPDX-License-Identifier: Apache-2.0
"""What is seen of a training: a viewer on its state, glances, figures and curves."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from blitzgs.capture.images import PhotographError
from blitzgs.runs.guard import ModelLostError
from blitzgs.training.events import evaluate as glances
from blitzgs.training.events.evaluate import Glances, evenly_ordered
from blitzgs.training.state import FALL, WINDOW, Curve
from blitzgs.view.look import Look, Wish
from blitzgs.view.views import viewmat
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.training.tiny import assert_same_table, events_of, make_trainer, tiny_scene, train


class Recorder:
    """Asks for a picture after every step, and may fail or pause."""

    def __init__(self, look=None, fails=None, pauses=0, saves=0):
        self.look, self.fails, self.pauses, self.saves = look, fails, pauses, saves
        self.pictures, self.records, self.closed, self.failures = [], [], 0, []

    def wants(self):
        if self.fails == "wants":
            raise KeyError("a fault of the viewer")
        return True

    def wish(self):
        if self.fails == "wish":
            raise KeyError("a fault of the viewer")
        pauses, self.pauses = self.pauses > 0, self.pauses - 1
        saves, self.saves = self.saves > 0, 0
        return Wish(self.look, pauses, saves)

    def show(self, picture, seconds):
        if self.fails == "show":
            raise OSError("the browser is gone")
        self.pictures.append(picture)
        assert seconds > 0

    def failed(self, reason):
        self.failures.append(reason)

    def told(self, t, values):
        self.records.append((t, dict(values)))

    def close(self):
        self.closed += 1


STEPS = "schedule.iterations=40"


def watched_run(folder, *overrides, ranks=None, **choices):
    trainer = make_trainer(folder, STEPS, *overrides, ranks=ranks)
    camera = trainer.state.capture.cameras[0]
    look = Look(viewmat(camera, trainer.state.space), camera.K, camera.width, camera.height)
    watcher = Recorder(look, **choices)
    trainer.watch(watcher if ranks is None or ranks.rank == 0 else None)
    return trainer, watcher, trainer.train()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return train(tmp_path_factory.mktemp("alone"), STEPS)


def test_looking_does_not_change_the_training(alone, tmp_path):
    trainer, watcher, summary = watched_run(tmp_path)
    assert_same_table(trainer.state.table, alone[0].state.table)
    assert summary["psnr"] == alone[1]["psnr"]
    assert len(watcher.pictures) == 39  # none after the last step
    first, last = watcher.pictures[0].values, watcher.pictures[-1].values
    assert (first != last).any()
    assert watcher.closed == 1
    assert [t for t, values in watcher.records if "loss" in values] == [20, 40]


@pytest.mark.parametrize("fails", ["wants", "wish", "show"])
def test_a_viewer_that_fails_does_not_end_the_training(alone, tmp_path, fails):
    with pytest.warns(UserWarning, match="training goes on without it"):
        trainer, watcher, summary = watched_run(tmp_path, fails=fails)
    assert_same_table(trainer.state.table, alone[0].state.table)
    assert summary["psnr"] == alone[1]["psnr"]
    assert watcher.closed == 1


def test_a_picture_that_cannot_be_drawn_does_not_end_the_training(alone, tmp_path, monkeypatch):
    def drawn(self, look):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("blitzgs.view.draw.Drawer.draw", drawn)
    trainer, watcher, _ = watched_run(tmp_path)
    assert_same_table(trainer.state.table, alone[0].state.table)
    assert set(watcher.failures) == {"out of memory"}


def test_pause_and_save_now(tmp_path):
    trainer, watcher, summary = watched_run(tmp_path, "schedule.iterations=20", pauses=5, saves=1)
    assert len(watcher.pictures) == 19 + 5
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2  # that of the request and the last
    assert summary["images"] == 20


def _watched_on_ranks(ranks, folder):
    _, watcher, summary = watched_run(folder, ranks=ranks, pauses=3, saves=1)
    return len(watcher.pictures), summary["psnr"]


def test_all_ranks_draw_for_the_first(alone, tmp_path):
    (pictures, psnr), (none, _) = run_ranks(_watched_on_ranks, 2, tmp_path)
    assert pictures > 3
    assert none == 0
    assert psnr == pytest.approx(alone[1]["psnr"], abs=0.1)


def _fails_on_the_second_rank(ranks, folder):
    def no_room(self, *arguments):
        raise RuntimeError("no room")

    patch = pytest.MonkeyPatch()
    if ranks.rank == 1:
        patch.setattr("blitzgs.view.draw.VisibleFinder.find", no_room)
    patch.setattr("blitzgs.training.events.evaluate.evaluate", lambda *_, **__: {"psnr": 1.0, "views": {}})
    _, watcher, summary = watched_run(folder, "schedule.iterations=20", ranks=ranks)
    return len(watcher.pictures), set(watcher.failures), summary["images"]


def test_a_rank_that_cannot_draw_does_not_end_the_training(tmp_path):
    (pictures, failures, images), (_, _, other) = run_ranks(_fails_on_the_second_rank, 2, tmp_path)
    assert (pictures, failures) == (0, {"rank 1: no room"})
    assert images == other == 20


def test_a_model_in_host_memory_is_shown_and_does_not_change(tmp_path):
    gate = ("schedule.densify_until=0", "view.lod=smooth", "view.footprint=0.1")  # rows fall behind
    settings = (*gate, "memory.resident_gb=0.001")
    trainer, watcher, _ = watched_run(tmp_path, *settings)
    assert trainer.state.stepper.gaussians is not trainer.state.table
    assert len(watcher.pictures) == 39
    assert watcher.failures == []
    assert watcher.pictures[-1].values.std() > 10
    alone, _ = train(tmp_path / "alone", STEPS, *settings)
    table = alone.state.table
    assert (table["last_step"] - table["moment_step"]).max() > 20
    assert_same_table(trainer.state.table, table)


def test_a_fully_masked_view_counts_for_nothing(tmp_path, capsys):
    capture, images = scene = tiny_scene()
    capture.train, capture.test = [1, 2, 4, 5, 6, 7], [0, 3]
    images.masks = [None] * 8
    _, plain = train(tmp_path / "plain", "schedule.iterations=20", scene=scene)
    images.masks[3] = torch.zeros(32, 48, dtype=torch.uint8)
    with pytest.warns(UserWarning, match="1 of 2 views cannot be measured, as they are masked: 03.png"):
        _, summary = train(tmp_path / "masked", "schedule.iterations=20", scene=scene)
    views = [
        json.loads((tmp_path / name / "evaluation" / "000020" / "metrics.json").read_text())["views"]
        for name in ("plain", "masked")
    ]
    assert list(views[0]) == ["00.png", "03.png"] and list(views[1]) == ["00.png"]
    assert summary["psnr"] == views[0]["00.png"]["psnr"] != plain["psnr"]
    images.masks[0] = images.masks[3]
    with pytest.warns(UserWarning, match="2 of 2 views cannot be measured, .* masked: 00.png, 03.png"):
        _, summary = train(tmp_path / "nothing", "schedule.iterations=20", scene=scene)
    assert "psnr" not in summary and "evaluation: all pixels are masked" in capsys.readouterr().out


def test_a_model_without_gaussians_is_no_result(tmp_path):
    lost = "the density event after 20 images pruned the last Gaussian"
    refused(ModelLostError, lost, train, tmp_path / "a", "population.min_opacity=0.98")
    running = make_trainer(tmp_path / "b", "schedule.iterations=2")
    running.state.table.keep(torch.zeros(len(running.state.table), dtype=torch.bool))
    running.state.stepper.reindex()
    refused(ModelLostError, "no Gaussian is left", running.train)
    assert not list(tmp_path.glob("*/checkpoints/*"))


@pytest.mark.parametrize("count", [1, 2, 7, 37])
def test_the_first_views_are_spread(count):
    order = evenly_ordered(list(range(100, 100 + count)))
    assert sorted(order) == list(range(100, 100 + count))
    for few in range(2, count + 1):
        chosen = sorted(order[:few])
        gaps = [b - a for a, b in zip(chosen, [*chosen[1:], chosen[0] + count], strict=True)]
        assert max(gaps) <= 4 * count / few + 1


def glance_at_once(monkeypatch):
    monkeypatch.setattr(Glances, "_affordable", lambda self: 1)


def test_glances_change_no_bit_and_are_logged(tmp_path, monkeypatch):
    def narrow(folder):
        capture, images = tiny_scene()
        for camera in capture.cameras:  # so that steps leave Gaussians out, which are then behind
            camera.K = np.diag([5.0, 5.0, 1.0]) @ camera.K + [[0, 0, -96], [0, 0, -64], [0, 0, 0]]
        return train(folder, scene=(capture, images))[0]

    before = narrow(tmp_path / "before")
    glance_at_once(monkeypatch)
    after = narrow(tmp_path / "after")
    assert_same_table(before.state.table, after.state.table)
    found = events_of(tmp_path / "after", "glance")
    assert len(found) == glances.POINTS - 1 and not events_of(tmp_path / "before", "glance")
    assert all(event["views"] == 1 and event["psnr"] > 5 for event in found)
    train(tmp_path / "all", "schedule.evaluate_every=50")
    assert not events_of(tmp_path / "all", "glance")


@pytest.mark.parametrize("cost", [0.001, 0.1, 3.0])
def test_the_share_of_the_time_is_small(tmp_path, monkeypatch, cost):
    """A training of 1,000 s by a clock of its own, in which a view costs `cost` seconds."""
    trainer, _ = train(tmp_path, "schedule.iterations=2")
    state, now = trainer.state, [0.0]
    state.clock = lambda: now[0]
    state.progress = replace(state.progress, step=0, seconds=0.0)
    state.start_clock()
    spent = []

    def measure(state, views, folder):
        now[0] += cost * len(views)
        spent.append(cost * len(views))
        return {"psnr": 20.0}

    monkeypatch.setattr(glances, "measure", measure)
    monkeypatch.setattr(state.stepper, "catch_up", lambda step: None)
    state.capture.test = list(range(30))
    state.schedule.iterations, watched = 1000, Glances(state)
    for step in range(1000):
        now[0] += 1.0
        state.stepped(step, 0)
        watched.after(step, step + 1)
    assert sum(spent) <= max(0.01 * 1000, glances.MAX_VIEWS * cost * 0.1) and spent


def test_a_lost_held_out_photograph_ends_the_glances_alone(tmp_path, monkeypatch):
    glance_at_once(monkeypatch)

    found = glances.measure

    def measure(state, views, folder):
        if folder is None and set(views) <= set(state.capture.test):
            raise PhotographError("03.png is gone")
        return found(state, views, folder)

    monkeypatch.setattr(glances, "measure", measure)
    _, summary = train(tmp_path)
    assert summary["images"] == 100
    assert [event["reason"] for event in events_of(tmp_path, "glance failed")] == ["03.png is gone"]


@pytest.mark.parametrize(
    ("values", "fall"),
    [
        ([20.0] * WINDOW + [25.0] * WINDOW + [25.0 - FALL - 1] * (2 * WINDOW), FALL + 1),
        (([25.0] * (WINDOW - 1) + [15.0]) * 4, 0),  # single batches
        ([25.0] * WINDOW + [None] + [15.0] * (2 * WINDOW), 0),  # with a reset in between
    ],
)
def test_a_fall_is_reported_once(values, fall):
    curve, said = Curve(), []
    for number, value in enumerate(values, 1):
        said.append(curve.restart() if value is None else curve.add(100 * number, value))
    texts = [text for text in said if text]
    assert curve.fall == fall and len(texts) == len(curve.warnings()) == (fall > 0)
    assert all("fell by 3." in text and "from 25.0 dB" in text for text in texts)
