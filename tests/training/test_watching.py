# SPDX-License-Identifier: Apache-2.0
import os
import signal

import numpy as np
import pytest

from blitzgs.distributed.group import Ranks
from blitzgs.runs.watch import Wish
from blitzgs.training.trainer import Trainer
from blitzgs.view.draw import intrinsics
from blitzgs.view.look import Look
from blitzgs.view.views import viewmat
from blitzgs.view.visible import VisibleFinder
from tests.distributed.rank_harness import run_ranks
from tests.training.tiny import assert_same_table, tiny_config, tiny_scene, train


class Recorder:
    """Asks for a picture after every step, and may fail or pause."""

    def __init__(self, look=None, fails=None, pauses=0, saves=0):
        self.look, self.fails, self.pauses, self.saves = look, fails, pauses, saves
        self.pictures, self.records, self.closed, self.failures = [], [], 0, []
        self.stays, self.shown_on = False, 0

    def wants(self):
        if self.fails == "wants":
            raise KeyError("a fault of the viewer")
        return True

    def wish(self):
        if self.fails == "wish":
            raise KeyError("a fault of the viewer")
        pauses, self.pauses = self.pauses > 0, self.pauses - 1
        if self.stays:
            self.shown_on += 1
            if self.shown_on == 3:
                os.kill(os.getpid(), signal.SIGINT)
            pauses = True
        saves, self.saves = self.saves > 0, 0
        return Wish(self.look, pauses, saves)

    def show(self, picture, seconds):
        if self.fails == "show":
            raise OSError("the browser is gone")
        self.pictures.append(picture)
        assert seconds > 0

    def failed(self, reason):
        self.failures.append(reason)

    def stay(self):
        self.stays = True

    def told(self, t, values):
        self.records.append((t, dict(values)))

    def close(self):
        self.closed += 1


def some_look(state, mode="RGB"):
    camera = state.capture.cameras[0]
    return Look(viewmat(camera, state.space), camera.K, camera.width, camera.height, mode=mode)


def watched_run(folder, *overrides, ranks=None, **choices):
    trainer = Trainer(tiny_config(*overrides), *tiny_scene(), folder, ranks or Ranks())
    watcher = Recorder(some_look(trainer.state), **choices)
    trainer.watch(watcher if ranks is None or ranks.rank == 0 else None)
    return trainer, watcher, trainer.train()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return train(tmp_path_factory.mktemp("alone"))


def test_looking_does_not_change_the_training(alone, tmp_path):
    trainer, watcher, summary = watched_run(tmp_path)
    assert_same_table(trainer.state.table, alone[0].state.table)
    assert summary["psnr"] == alone[1]["psnr"]
    assert len(watcher.pictures) == 99  # none after the last step
    first, last = watcher.pictures[0].values, watcher.pictures[-1].values
    assert (first != last).any()
    assert watcher.closed == 1
    assert [t for t, values in watcher.records if "loss" in values] == [20, 40, 60, 80, 100]


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
    trainer, watcher, summary = watched_run(folder, "schedule.iterations=40", ranks=ranks, pauses=3, saves=1)
    return len(watcher.pictures), None if summary is None else summary["psnr"]


def test_all_ranks_draw_for_the_first(tmp_path):
    (pictures, psnr), (none, _) = run_ranks(_watched_on_ranks, 2, tmp_path / "watched")
    assert pictures > 3
    assert none == 0
    _, summary = train(tmp_path / "alone", "schedule.iterations=40")
    assert psnr == pytest.approx(summary["psnr"], abs=0.1)


def _fails_on_the_second_rank(ranks, folder):
    draw = VisibleFinder.find

    def found(self, *arguments):
        if ranks.rank == 1:
            raise RuntimeError("no room")
        return draw(self, *arguments)

    trainer = Trainer(tiny_config("schedule.iterations=20"), *tiny_scene(), folder, ranks)
    watcher = Recorder(some_look(trainer.state))
    trainer.watch(watcher if ranks.rank == 0 else None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("blitzgs.view.draw.VisibleFinder.find", found)
        patch.setattr(
            "blitzgs.training.events.evaluate.evaluate", lambda *_, **__: {"psnr": 1.0, "views": {}}
        )
        summary = trainer.train()
    return len(watcher.pictures), set(watcher.failures), summary["images"]


def test_a_rank_that_cannot_draw_does_not_end_the_training(tmp_path):
    (pictures, failures, images), (_, _, other) = run_ranks(_fails_on_the_second_rank, 2, tmp_path)
    assert (pictures, failures) == (0, {"rank 1: no room"})
    assert images == other == 20


def test_a_watcher_may_stay_after_the_training(tmp_path):
    trainer = Trainer(tiny_config("schedule.iterations=20"), *tiny_scene(), tmp_path, Ranks())
    watcher = Recorder(some_look(trainer.state))
    trainer.watch(watcher, stays=True)
    trainer.train()
    seen = len(watcher.pictures)
    assert watcher.closed == 0
    trainer.show_on()  # until the watcher sends a signal
    assert watcher.closed == 1
    assert len(watcher.pictures) >= seen + 2


def test_intrinsics_are_centred():
    K = intrinsics(200, 100, np.pi / 2)  # noqa: N806
    np.testing.assert_allclose(K, [[50, 0, 100], [0, 50, 50], [0, 0, 1]])


def test_a_model_in_host_memory_is_shown(tmp_path):
    settings = ("schedule.iterations=20", "memory.resident_gb=0.001")
    trainer, watcher, summary = watched_run(tmp_path, *settings)
    assert trainer.state.stepper.scene is not trainer.state.table
    assert len(watcher.pictures) == 19
    assert watcher.failures == []
    assert watcher.pictures[-1].values.std() > 10
    _, alone = train(tmp_path / "alone", *settings)
    assert summary["psnr"] == pytest.approx(alone["psnr"], abs=1e-3)
