# SPDX-License-Identifier: Apache-2.0
"""What a run shows while it works, on a terminal and elsewhere."""

import json
import time

from blitzgs.runs import log as run_log
from blitzgs.runs.log import LOG, RunLog


def records(folder):
    return [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def work_on(folder, monkeypatch, terminal):
    """Take three steps, log the third, measure two views; the run has 40 images."""
    monkeypatch.setenv("FORCE_COLOR", "1") if terminal else monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setattr(run_log, "_BAR_SECONDS", 0.0)
    log = RunLog(folder, 40, 0, tensorboard=False)
    for t in (1, 2, 3):
        log.advance(t)
    position = None if log._progress is None else log._progress.tasks[0].completed
    log.scalars(3, {"loss": 0.5})
    with log.work("views measured") as report:
        for done in (1, 2):
            report(done, 2)
        bars = (
            [] if log._progress is None else [(bar.description, bar.completed) for bar in log._progress.tasks]
        )
    log.close()
    return position, bars


def test_a_terminal_shows_every_step_and_the_evaluation(tmp_path, monkeypatch, capsys):
    position, bars = work_on(tmp_path, monkeypatch, terminal=True)
    assert position == 3 and bars == [("loss 0.5000", 3), ("views measured", 2)]
    assert [record["t"] for record in records(tmp_path)] == [3]


def test_the_bar_moves_now_and_then_and_to_its_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(run_log, "_BAR_SECONDS", 1e9)
    log = RunLog(tmp_path, 40, 0, tensorboard=False)
    log._moved = time.monotonic()
    positions = []
    for t in (39, 40):
        log.advance(t)
        positions.append(log._progress.tasks[0].completed)
    log.close()
    assert positions == [0, 40]


def test_the_remaining_time_follows_a_change_of_speed(tmp_path, monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    log = RunLog(tmp_path, 4000, 0, tensorboard=False)
    for t in range(10, 2010, 10):
        now += 1.0 if t <= 1000 else 4.0
        log.scalars(t, {"loss": 0.5})
    log.close()
    lines = capsys.readouterr().out.splitlines()
    assert lines[99].endswith("ETA 0:05:00") and lines[-1].endswith("ETA 0:13:20")


def test_elsewhere_long_work_prints_a_line_now_and_then(tmp_path, monkeypatch, capsys):
    work_on(tmp_path, monkeypatch, terminal=False)
    assert "views measured" not in capsys.readouterr().out
    monkeypatch.setattr(run_log, "_LINE_SECONDS", 0.0)
    work_on(tmp_path, monkeypatch, terminal=False)
    assert "1 of 2 views measured" in capsys.readouterr().out
    assert [record["t"] for record in records(tmp_path)] == [3, 3]


def test_other_ranks_show_nothing(monkeypatch, capsys):
    monkeypatch.setattr(run_log, "_LINE_SECONDS", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")
    log = RunLog(None, 40, 0, tensorboard=False)
    log.advance(1)
    with log.work("views measured") as report:
        report(1, 2)
    log.close()
    assert not capsys.readouterr().out


def test_what_is_shown_is_a_running_mean_and_the_held_out_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    log = RunLog(tmp_path, 40, 0, tensorboard=False)
    log.scalars(1, {"loss": 0.5, "psnr": 20.0})
    log.scalars(2, {"loss": 0.3, "psnr": 30.0})
    log.event(2, "glance", {"psnr": 22.5, "views": 2})
    for t in range(3, 30):
        log.scalars(t, {"loss": 0.1, "psnr": 24.0})
    log.event(30, "evaluation", {"psnr": 23.0, "split": "train"})
    log.event(30, "note", {}, "bad \x1b[2J name")
    log.close()
    lines = capsys.readouterr().out.splitlines()
    assert "loss 0.5000  train 20.00 dB" in lines[0] and "held-out" not in lines[1]
    assert "loss 0.4000  train 25.00 dB" in lines[1]
    assert "loss 0.1000  train 24.00 dB  held-out 22.50 dB" in lines[-2]
    assert "bad \\x1b[2J name" in lines[-1]
    assert [record["psnr"] for record in records(tmp_path)[:2]] == [
        20.0,
        30.0,
    ]  # the file has each view's own
