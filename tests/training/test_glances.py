# SPDX-License-Identifier: Apache-2.0
"""A few held-out views are measured now and then, at a small share of the time and with no effect."""

from dataclasses import replace

import pytest
import torch

from blitzgs.capture.images import PhotographError
from blitzgs.training import glances
from blitzgs.training.glances import Glances, spread
from tests.training.tiny_runs import events_of, train


@pytest.mark.parametrize("count", [1, 2, 7, 37])
def test_the_first_views_are_spread(count):
    order = spread(list(range(100, 100 + count)))
    assert sorted(order) == list(range(100, 100 + count))
    for few in range(2, count + 1):
        chosen = sorted(order[:few])
        gaps = [b - a for a, b in zip(chosen, [*chosen[1:], chosen[0] + count], strict=True)]
        assert max(gaps) <= 4 * count / few + 1


def glance_at_once(monkeypatch):
    monkeypatch.setattr(Glances, "_affordable", lambda self: 1)


def test_glances_change_no_bit_and_are_logged(tmp_path, monkeypatch):
    before, _ = train(tmp_path / "before")
    glance_at_once(monkeypatch)
    after, _ = train(tmp_path / "after")
    assert all(torch.equal(before.state.table[name], after.state.table[name]) for name in before.state.table)
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

    def measure(state, views, folder, lpips):
        now[0] += cost * len(views)
        spent.append(cost * len(views))
        return {"psnr": 20.0}

    monkeypatch.setattr(glances, "measure", measure)
    state.capture.test = list(range(30))
    state.schedule.iterations, watched = 1000, Glances(state)
    for step in range(1000):
        now[0] += 1.0
        state.stepped(step, 0)
        watched.after(step, step + 1)
    assert sum(spent) <= max(0.01 * 1000, glances.MAX_VIEWS * cost * 0.1) and spent


def test_a_lost_held_out_photograph_ends_the_glances_alone(tmp_path, monkeypatch):
    glance_at_once(monkeypatch)

    def measure(*_, **__):
        raise PhotographError("03.png is gone")

    monkeypatch.setattr(glances, "measure", measure)
    _, summary = train(tmp_path)
    assert summary["images"] == 100
    assert [event["reason"] for event in events_of(tmp_path, "glance failed")] == ["03.png is gone"]
