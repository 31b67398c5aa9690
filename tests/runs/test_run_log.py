# SPDX-License-Identifier: Apache-2.0
"""What a run checks of its folder, what it shows while it works, and how it stops."""

import errno
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.runs import log as run_log
from blitzgs.runs.folder_checks import FolderError, check_room, check_writable, locked
from blitzgs.runs.guard import LossGuard, NonFiniteError
from blitzgs.runs.log import RunLog
from blitzgs.runs.trained_model import known_id
from blitzgs.util import progress
from tests.distributed.rank_harness import all_fail
from tests.helpers import refused
from tests.training.tiny import OVERRIDES, as_flags, make_trainer, read_log, write_tiny_capture


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
        shown = [] if log._progress is None else log._progress.tasks
        bars = [(bar.description, bar.completed) for bar in shown]
    log.close()
    return position, bars


def test_a_terminal_shows_every_step_and_the_evaluation(tmp_path, monkeypatch, capsys):
    position, bars = work_on(tmp_path, monkeypatch, terminal=True)
    assert position == 3 and bars == [("loss 0.5000", 3), ("views measured", 2)]
    assert [record["t"] for record in read_log(tmp_path)] == [3]


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
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    work_on(tmp_path, monkeypatch, terminal=False)
    assert "1 of 2 views measured" in capsys.readouterr().out
    assert [record["t"] for record in read_log(tmp_path)] == [3, 3]


def test_other_ranks_show_nothing(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
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
    assert [record["psnr"] for record in read_log(tmp_path)[:2]] == [20.0, 30.0]  # each view's own


class OnCuda:
    """Images that name CUDA as their device, so that the guard reads sums a step later, as on CUDA."""

    device = torch.device("cuda")

    def __init__(self, tensor):
        self._tensor = tensor

    def __getattr__(self, name):
        return getattr(self._tensor, name)


class Sums:
    def __init__(self, *values):
        self._values = values

    def read(self):
        return torch.tensor(self._values)


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    running = make_trainer(tmp_path_factory.mktemp("frame"), "schedule.batch_size=2")
    batch = running.loader.get(0, 1)
    rendered, *_ = running.state.stepper.forward(1, running.state.render_options, batch)
    running.close()
    return running.state.table, rendered


@pytest.mark.parametrize("name", ["means2d", "conics", "depths", "opacities", "colors"])
def test_the_guard_names_op_gaussian_and_view(frame, name):
    table, rendered = frame
    column = getattr(rendered.projected, name).clone()
    column[5] = float("inf")
    splats = rendered.projected._replace(**{name: column})
    wanted = int(table["id"][splats.gaussian_ids[5]]), ("a", "b")[splats.camera_ids[5]]
    with pytest.raises(NonFiniteError) as failure:
        LossGuard().check(
            9, ("a", "b"), Sums(0, 0, float("nan"), 0), table, rendered._replace(projected=splats)
        )
    assert str(failure.value) == (
        "step 9: the loss of view 'a' is not finite; it first appears in op project, output "
        f"{name}: Gaussian id {wanted[0]} in view '{wanted[1]}', and 0 more"
    )


def test_the_guard_names_the_pixel_and_says_what_it_has_looked_at(frame):
    table, rendered = frame
    images = rendered.renders.clone()
    images[1, 7, 11, 2] = float("nan")
    bad = Sums(0, float("nan"), 0, 0)
    for shown, text in (
        (rendered._replace(renders=images), r"op rasterize, output renders: view 'b', pixel \(11, 7\)"),
        (rendered, "projected Gaussians and images are finite: it comes from op photometric"),
    ):
        refused(NonFiniteError, text, LossGuard().check, 9, ("a", "b"), bad, table, shown)
    # A step later, the message does not name data that no longer exist.
    guard, late = LossGuard(), rendered._replace(renders=OnCuda(rendered.renders))
    guard.check(9, ("a", "b"), bad, table, late)
    with pytest.raises(NonFiniteError) as failure:
        guard.check(10, ("c", "d"), Sums(0, 0, 0, 0), table, late)
    text = str(failure.value)
    assert text.startswith("step 9: the loss of view 'b' is not finite; the data of step 9 no longer exist;")
    assert "in step 10 the parameters are finite" in text and "view 'c', 'd'" in text
    guard.check(9, ("a", "b"), bad, table, late)
    splats = rendered.projected._replace(depths=rendered.projected.depths * torch.inf)
    spoiled = late._replace(projected=splats)
    with pytest.raises(NonFiniteError, match="found in step 10: .* op project, output depths"):
        guard.check(10, ("c", "d"), Sums(0, 0, 0, 0), table, spoiled)


@pytest.mark.parametrize("bad", [(0, float("inf"), 0, 0), (float("inf"), 0, float("-inf"), 0)])
def test_infinite_sums_stop_the_run_but_not_large_ones(frame, bad):
    table, rendered = frame
    LossGuard().check(1, ("a", "b"), Sums(*[torch.finfo(torch.float32).max] * 4), table, rendered)
    with pytest.raises(NonFiniteError, match=f"the loss of view '{'ba'[bad[0] > 0]}' is not finite"):
        LossGuard().check(1, ("a", "b"), Sums(*bad), table, rendered)


ROOT = Path(__file__).parents[2]


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    no_folder = r"file/run cannot be written: rank 0 \(.*Not a directory"
    refused(FolderError, no_folder, check_writable, tmp_path / "file" / "run", Ranks())
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
    full = r"a checkpoint takes .* kB and 1.00 kB are free"
    refused(FolderError, full, make_trainer, tmp_path / "run")
    monkeypatch.undo()
    table = make_trainer(tmp_path / "run").state.table
    with pytest.warns(UserWarning, match="two checkpoints of 9,000,000,000,000 Gaussians take"):
        check_room(tmp_path, table, Ranks(), 9_000_000_000_000)
    assert not list(tmp_path.rglob(".probe*"))


@pytest.mark.parametrize(
    "name",
    ["config.yaml", "cameras.json", "log.jsonl", "summary.json", "trajectory.svg", "lineage", "checkpoints"],
)
@pytest.mark.parametrize("resume", [True, False])
def test_files_of_other_programs_are_not_replaced(tmp_path, name, resume):
    (tmp_path / name).write_text("precious")
    replaced = "Not a directory" if name == "checkpoints" else f"has {name}, which a run would replace"
    refused((FileExistsError, NotADirectoryError), replaced, make_trainer, tmp_path, resume=resume)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "precious")]


def _check(ranks, folders):
    check_writable(Path(folders[ranks.rank]), ranks)


def test_folders_are_checked_on_every_rank(tmp_path):
    all_fail(r"cannot be written: rank 1 \(", _check, [str(tmp_path / "a"), "/proc/nothing"])
    all_fail("ranks 1 do not see what rank 0 writes", _check, [str(tmp_path / "a"), str(tmp_path / "b")])


def test_one_run_at_a_time(tmp_path, monkeypatch, failure):
    from blitzgs.runs import folder_checks

    monkeypatch.setattr(folder_checks, "LOCK_SECONDS", 0.1)
    write_tiny_capture(tmp_path / "data")
    out = tmp_path / "run"
    program = (
        "import sys, time; from pathlib import Path; from blitzgs.distributed.group import Ranks;"
        "from blitzgs.runs.folder_checks import locked\n"
        f"with locked(Path({str(out)!r}), Ranks()):\n  print('in', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert holder.stdout.readline() == "in\n"
        flags = as_flags("config=defaults", *OVERRIDES, "schedule.iterations=2")
        command = ["train", "--data", str(tmp_path / "data"), "--out", str(out), *flags]
        assert f"in use by another run (process {holder.pid} on " in failure(*command)
        assert not (out / "log.jsonl").exists() and not (out / "config.yaml").exists()
    finally:
        holder.kill()
        holder.wait()
    assert main(command) == 0  # a lock does not outlive its process
    with locked(out, Ranks()):
        pass


def test_a_full_disk_is_named_by_the_check_and_not_by_the_lock(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.pwrite", full)
    monkeypatch.setattr("os.fsync", full)
    with locked(tmp_path, Ranks()), pytest.raises(FolderError, match="cannot be written: .* No space left"):
        check_writable(tmp_path, Ranks())


@pytest.fixture(scope="module")
def other(trained, tmp_path_factory):
    """Another run of the same capture."""
    folder = tmp_path_factory.mktemp("other") / "run"
    flags = as_flags("config=defaults", *OVERRIDES, "population.grad_threshold=2e-4", "schedule.scale=0.4")
    assert main(["train", "--data", str(trained[0]), "--out", str(folder), *flags]) == 0
    return folder


@pytest.mark.parametrize(
    ("command", "known_by"),
    [
        *((command, "cameras") for command in ("eval", "render", "export", "resume", "extend")),
        ("eval", "log"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(trained, other, tmp_path, failure, command, known_by):
    run = tmp_path / "run"
    shutil.copytree(trained[1], run)
    if known_by == "log":  # as in runs of earlier versions
        cameras = json.loads((run / "cameras.json").read_text())
        del cameras["run"]
        (run / "cameras.json").write_text(json.dumps(cameras))
    arguments = {
        "eval": ["eval", str(run)],
        "render": ["render", str(run), "--out", str(tmp_path / "out")],
        "export": ["export", str(run), "--ply", str(tmp_path / "out.ply")],
        "resume": ["train", "--out", str(run), "--resume"],
        "extend": ["train", "--out", str(run), "--extend=1.5"],
    }[command]
    assert main(arguments) == 0  # its own checkpoint
    shutil.rmtree(run / "checkpoints")
    shutil.copytree(other / "checkpoints", run / "checkpoints")
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    another = f"was written by another run ({known_id(other)}) than the one in {run} ({known_id(run)})"
    assert another in failure(*arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["", "[]", "{", '{"run": 5}', '{"run": ""}', "\udcff"])
def test_a_damaged_file_names_no_run(tmp_path, content):
    for name in ("cameras.json", "log.jsonl"):
        (tmp_path / name).write_text(content, errors="surrogateescape")
    assert known_id(tmp_path) == ""
    assert known_id(tmp_path / "nothing") == ""
