# SPDX-License-Identifier: Apache-2.0
"""Runs keep their model when they are interrupted or disturbed, and resume from a valid checkpoint."""

import errno
import itertools
import json
import os
import shutil
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from blitzgs.capture.images import PhotographError
from blitzgs.distributed.group import Ranks
from blitzgs.runs import checkpoint, trained_model
from blitzgs.runs.folder import open_run
from blitzgs.runs.guard import NonFiniteError
from blitzgs.spawn.lineage import read_lineage
from blitzgs.training.agreement import MAX_STEPS, REPEAT_SECONDS, Agreement, SaveClock, StopRequest
from blitzgs.training.events import save
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused, save_checkpoint
from tests.training.tiny import assert_same_table, at_step, read_log, steps_of
from tests.training.tiny import make_trainer as trainer

SHORT = "schedule.iterations=20"


def checkpoints(folder):
    return sorted(path.name for path in (folder / "checkpoints").glob("checkpoint_*"))


# Non-finite values never become the newest checkpoint.


@pytest.mark.parametrize("column", ["means", "exp_avg_sq.sh", "grad_sum"])
def test_what_is_not_finite_is_not_saved(tmp_path, monkeypatch, column):
    def spoil(self):
        self.state.table[column][7] = float("nan")

    # The checkpoint at 39 images follows step 40; nothing reads the table in between.
    at_step(monkeypatch, 40, spoil)
    running = trainer(tmp_path, "schedule.checkpoint_every=13", "log.every=1000")
    message = rf"step 40: rank 0: column '{column}' is not finite in 1 Gaussians \(ids \d+\).*earlier ones"
    refused(NonFiniteError, message, running.train)
    assert checkpoints(tmp_path) == ["checkpoint_000000", "checkpoint_000001"]
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 27


def test_a_checkpoint_with_nan_is_not_resumed_from(tmp_path):
    running = trainer(tmp_path, "schedule.iterations=30", "schedule.checkpoint_every=15")
    running.train()
    table = running.state.table
    table["sh"][3] = float("nan")
    newest = checkpoint.load(max((tmp_path / "checkpoints").iterdir()), Ranks(), "cpu")
    save_checkpoint(tmp_path / "checkpoints", table.columns, newest.state, Ranks())
    with pytest.warns(UserWarning, match="is refused: column 'sh' is not finite.*; using checkpoint_000001"):
        found = trained_model.restore(tmp_path, Ranks())
    assert found.source == "checkpoint_000001 (the newest sound one; 1 newer refused)"


# Checkpoints by the clock, and all signals.


@pytest.mark.parametrize("room", [0, 1 << 40])
def test_training_goes_on_while_a_checkpoint_is_written(tmp_path, monkeypatch, room):
    """The checkpoint has the model of the step at which it began; without room for a copy, training waits."""
    saved, may_write, then = {}, threading.Event(), []
    save, write = trained_model.save, checkpoint.write_shard

    def noted(folder, model, *others):
        saved.setdefault("columns", {name: model.table[name].clone() for name in model.table})
        return save(folder, model, *others)

    def write_late(*arguments):
        then.append(may_write.wait(60 if room else 0))
        return write(*arguments)

    def go_on(self):
        assert checkpoints(tmp_path) == ([] if room else ["checkpoint_000000"])
        may_write.set()

    monkeypatch.setattr(trained_model, "available_bytes", lambda: room)
    monkeypatch.setattr(trained_model, "save", noted)
    monkeypatch.setattr(checkpoint, "write_shard", write_late)
    at_step(monkeypatch, 33, lambda self: self.state.save_clock.restart(0))
    at_step(monkeypatch, 36, go_on)
    trainer(tmp_path, "schedule.iterations=40").train()
    loaded = checkpoint.load(tmp_path / "checkpoints" / "checkpoint_000000", Ranks(), "cpu")
    assert loaded.state["progress"]["step"] == 33 and then == [room > 0, True]
    assert loaded.columns.keys() == saved["columns"].keys()
    assert all(torch.equal(column, saved["columns"][name]) for name, column in loaded.columns.items())


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_every_signal_saves(tmp_path, monkeypatch, number):
    at_step(monkeypatch, 17, lambda self: os.kill(os.getpid(), number))
    running = trainer(tmp_path)
    assert running.train() is None
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 17
    assert signal.Signals(number).name in read_log(tmp_path)[-1]["reason"]


@pytest.mark.parametrize("repeated", [False, True], ids=["terminal", "torchrun"])
def test_nohup_is_respected_and_a_second_signal_does_not_interrupt_the_save(monkeypatch, repeated):
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    if repeated:
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.number == 0
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.number == signal.SIGTERM
            os.kill(os.getpid(), signal.SIGINT)
            if repeated:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(REPEAT_SECONDS)
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGHUP, before)


def _agreements(ranks, seconds, most, late):
    stop, clock = StopRequest(), SaveClock(0)
    pytest.MonkeyPatch().setattr("blitzgs.training.agreement.MAX_SECONDS", most)
    agreement = Agreement(ranks, stop, clock)
    agreement._reads_late = late
    decisions = []
    for step in range(1, 60):
        time.sleep(seconds)
        if step == 20 and ranks.rank == 1:
            stop.number = signal.SIGTERM
        if step == 3 and ranks.rank == 0:
            clock.restart(0)
        decision = agreement.after(step)
        if decision.save:
            clock.restart()
        decisions.append((decision.signal, decision.save))
        if decision.signal:
            break
    return decisions


@pytest.mark.parametrize(
    ("seconds", "most", "late", "stop_at", "save_at"),
    [
        (0.001, 4.0, False, 32, 16),
        (0.1, 0.25, False, 20, 4),
        (0.001, 4.0, True, 33, 4),
        (0.1, 0.25, True, 22, 4),
    ],
)
def test_ranks_agree_after_the_same_step_and_slow_steps_do_not_wait(seconds, most, late, stop_at, save_at):
    first, second = run_ranks(_agreements, 2, seconds, most, late)
    assert first == second
    assert [step for step, (_, saves) in enumerate(first, 1) if saves] == [save_at]
    assert len(first) == stop_at and first[-1][0] == "SIGTERM"


class TwoRanks(Ranks):
    """Ranks of which the other one requests nothing."""

    def all_reduce(self, tensor, op="sum"):
        return tensor


@pytest.mark.parametrize("late", [False, True])
def test_a_lost_photograph_ends_the_run_in_time(monkeypatch, late):
    """The first steps are slow, so that the ranks agree after steps of any remainder."""
    for slow, at in itertools.product(range(2, 20), range(20, 60)):
        now = [0.0]
        monkeypatch.setattr(time, "monotonic", lambda now=now: now[0])
        agreement = Agreement(TwoRanks(world_size=2), StopRequest(), SaveClock(0))
        agreement._reads_late = late
        for step in range(1, 100):
            now[0] += 1.0 if step < slow else 0.001
            if agreement.after(step, lost=step >= at).lost:
                break
        assert at <= step < at + MAX_STEPS + late


# Photographs, disks and terminals that disappear.


def test_a_photograph_that_vanishes_costs_nothing(tmp_path, monkeypatch):
    whole = trainer(tmp_path / "whole")
    whole.train()
    at_step(monkeypatch, 40, lambda self: self.state.images.lose())
    running = trainer(tmp_path / "cut")
    refused(PhotographError, r"/photos/0\d.png .*put the photograph back.*--resume", running.train)
    saved = trained_model.restore(tmp_path / "cut", Ranks()).progress.step
    assert 40 <= saved <= 44  # some batches were loaded ahead
    monkeypatch.undo()
    resumed = trainer(tmp_path / "cut", resume=True)
    resumed.train()
    assert_same_table(resumed.state.table, whole.state.table)


def test_a_held_out_photograph_that_vanishes_costs_nothing(tmp_path):
    running = trainer(tmp_path, "schedule.evaluate_every=30")
    running.state.images.lose(*running.state.capture.test, error=ValueError)
    refused(PhotographError, r"/photos/03.png.*put the photograph back.*--resume", running.train)
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 31
    assert trainer(tmp_path, "schedule.evaluate_every=30", resume=True).train() is not None


def fail_writes(
    monkeypatch, count, module=checkpoint, name="write_shard", also=lambda: None, error=errno.ENOSPC
):
    """Let the next `count` calls of a function that writes fail as on a full disk."""
    failures, real = iter(range(count)), getattr(module, name)

    def write(*args, **options):
        if next(failures, None) is not None:
            also()
            raise OSError(error, os.strerror(error))
        return real(*args, **options)

    monkeypatch.setattr(module, name, write)
    return failures


def test_a_full_disk_in_the_middle_is_survived(tmp_path, monkeypatch, capsys):
    fail_writes(monkeypatch, 1)
    monkeypatch.setattr(save, "RETRY_SECONDS", 0.0)
    summary = trainer(tmp_path, SHORT, "schedule.checkpoint_every=10").train()
    assert summary is not None
    shown = capsys.readouterr().out.replace("\n", " ")
    assert "was not saved" in shown and "Training goes on" in shown
    assert len(checkpoints(tmp_path)) >= 2  # the run tried again at the next step, and wrote the last one


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT])
def test_the_last_checkpoint_waits_for_room(tmp_path, monkeypatch, capsys, error):
    fail_writes(monkeypatch, 2, error=error)
    monkeypatch.setattr(save, "FIRST_WAIT_SECONDS", 0.01)
    assert trainer(tmp_path, SHORT).train() is not None
    shown = capsys.readouterr().out
    assert shown.count("The model is still in memory: free some space") == 2
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 20


def test_waiting_for_room_ends_when_asked(tmp_path, monkeypatch):
    fail_writes(monkeypatch, 9, also=lambda: os.kill(os.getpid(), signal.SIGTERM))
    monkeypatch.setattr(save, "FIRST_WAIT_SECONDS", 0.01)
    refused(checkpoint.CheckpointError, "the disk is full", trainer(tmp_path, SHORT).train)


@pytest.mark.parametrize(
    ("error", "elsewhere"),
    [(errno.ENOTDIR, True), (errno.EACCES, True), (errno.EIO, True), (errno.EFBIG, False)],
)
def test_another_error_than_lack_of_space_saves_elsewhere_at_once(tmp_path, monkeypatch, error, elsewhere):
    real = checkpoint.write_shard

    def write_shard(path, *args):
        if path.parent.parent.parent == tmp_path / "run" or not elsewhere:
            raise OSError(error, os.strerror(error))
        return real(path, *args)

    monkeypatch.setattr(checkpoint, "write_shard", write_shard)
    monkeypatch.setattr(save.time, "sleep", lambda seconds: pytest.fail("it waits"))
    running = trainer(tmp_path / "run", SHORT)
    with pytest.raises(checkpoint.CheckpointError) as failure:
        running.train()
    message = str(failure.value)
    assert os.strerror(error) in message and "free some space" not in message
    saved = tmp_path / "run" / f"rescued_{running.state.run_id}"
    assert (f"The model is saved in {saved}: continue with --resume --out" in message) == elsewhere
    assert ("it is lost" in message) != elsewhere
    if elsewhere:
        assert trained_model.restore(saved, Ranks()).progress.step == 20
        assert open_run(saved).cameras().test == [3] and len(open_run(saved).model()) > 0


def test_a_lineage_that_cannot_be_written_waits_as_well(tmp_path, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    failures = fail_writes(monkeypatch, 2, parquet, "write_table")
    monkeypatch.setattr(save, "FIRST_WAIT_SECONDS", 0.01)
    flags = ("population.lineage=true", "schedule.iterations=50")
    running = trainer(tmp_path, *flags)
    assert running.train() is not None and not list(failures)
    births = read_lineage(tmp_path / "lineage")["births"]["id"]
    assert len(set(births.tolist())) == len(births) == running.state.lineage.ledger.births


def test_a_log_that_cannot_be_written_ends_nothing(tmp_path, monkeypatch):
    """While a disk is full, records are kept in memory; afterwards TensorBoard gets another writer."""

    class FullBoard:
        def __init__(self, folder, purge_step=None):
            assert not (tmp_path / "log.jsonl").is_dir(), "a writer is made while records wait"
            Path(folder).mkdir(exist_ok=True)

        def add_scalar(self, *args):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            raise OSError(errno.ENOSPC, "No space left on device")

    import torch.utils.tensorboard

    monkeypatch.setattr(torch.utils.tensorboard, "SummaryWriter", FullBoard)
    at_step(monkeypatch, 20, lambda self: (tmp_path / "log.jsonl").rename(tmp_path / "aside"))
    at_step(monkeypatch, 20, lambda self: (tmp_path / "log.jsonl").mkdir())
    at_step(monkeypatch, 50, lambda self: (tmp_path / "log.jsonl").rmdir())
    with pytest.warns(UserWarning) as caught:
        assert trainer(tmp_path, "log.tensorboard=true").train() is not None
    texts = [str(warning.message) for warning in caught]
    assert sum("TensorBoard" in text for text in texts) == 1
    assert sum("log file" in text for text in texts) == 1
    both = (tmp_path / "aside").read_text() + (tmp_path / "log.jsonl").read_text()
    times = [record["t"] for record in map(json.loads, both.splitlines()) if "loss" in record]
    assert times == [20, 40, 60, 80, 100]


def test_an_evaluation_that_cannot_be_written_ends_nothing(tmp_path):
    tmp_path.joinpath("evaluation").write_text("not a folder")
    with pytest.warns(UserWarning, match="the evaluation could not write a file and goes on"):
        assert trainer(tmp_path, SHORT).train()["psnr"] > 5


def test_a_log_of_another_run_or_with_damaged_records_ends_nothing(tmp_path, monkeypatch):
    """A run that was killed before its first checkpoint leaves its log to the next one in the folder."""
    trainer(tmp_path / "clean", "schedule.iterations=50").train()
    other = {"t": 20, "run": "another", "event": "densify", "gaussians": 123_456_789}

    def add_records(running):
        partial = {"t": 20, "run": running.state.run_id, "event": "densify"}
        damaged = ('{"t": 20, "run": "another", "ev', "[" * 100_000, "5")
        with open(running.state.folder / "log.jsonl", "a") as file:
            file.write("\n".join((json.dumps(other), json.dumps(partial), *damaged, "")))

    at_step(monkeypatch, 1, add_records)
    assert trainer(tmp_path / "second", "schedule.iterations=50").train() is not None
    pictures = [(tmp_path / name / "trajectory.svg").read_text() for name in ("clean", "second")]
    assert pictures[0] == pictures[1]


# Resuming says what it does, and the log holds every record once.


def test_a_resume_repeats_no_record_and_says_where_it_begins(tmp_path, monkeypatch):
    at_step(
        monkeypatch, 52, lambda self: self.state.save_clock.saving and self.state.save_clock.saving.wait()
    )
    at_step(monkeypatch, 52 + MAX_STEPS + 2, lambda self: (_ for _ in ()).throw(RuntimeError("killed")))
    refused(RuntimeError, "killed", trainer(tmp_path, "schedule.checkpoint_every=50", resume=True).train)
    assert [r["t"] for r in steps_of(tmp_path)] == [20, 40, 60]
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"t": 61, "lo')  # torn
    monkeypatch.undo()
    trainer(tmp_path, "schedule.checkpoint_every=50", resume=True).train()
    before = checkpoints(tmp_path)
    # The finished run once more: it is measured, and not saved, for which there is no space.
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    trainer(tmp_path, "schedule.checkpoint_every=50", resume=True).train()
    assert checkpoints(tmp_path) == before
    found = read_log(tmp_path)
    assert [r["t"] for r in found if "loss" in r] == [20, 40, 60, 80, 100]
    for event in ("population", "image_memory", "evaluation"):
        assert [r["t"] for r in found if r.get("event") == event] == [100]
    assert len({r["run"] for r in found}) == 1
    origins = [r["origin"] for r in found if r.get("event") == "start"]
    assert origins == [
        f"nothing to resume in {tmp_path}: starting anew",
        "resumed from checkpoint_000000 (the newest) after 51 steps",
        f"resumed from {before[-1]} (the newest) after 100 steps, its end (--extend trains it longer)",
    ]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["run"] == found[0]["run"]
