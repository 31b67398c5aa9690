# SPDX-License-Identifier: Apache-2.0
"""The folder of a run is checked before training begins, and another run's checkpoints are refused."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.runs.folder_checks import FolderError, check_room, check_writable, locked
from blitzgs.runs.identity import known_id
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import RankError, run_ranks
from tests.training.tiny import OVERRIDES, as_flags, tiny_config, tiny_scene, write_tiny_capture

ROOT = Path(__file__).parents[2]


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(FolderError, match=r"file/run cannot be written: rank 0 \(.*Not a directory"):
        check_writable(tmp_path / "file" / "run", Ranks())
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
    with pytest.raises(FolderError, match=r"a checkpoint takes .* GB and 0.00 GB are free"):
        Trainer(tiny_config(), *tiny_scene(), tmp_path / "run", Ranks())
    monkeypatch.undo()
    table = Trainer(tiny_config(), *tiny_scene(), tmp_path / "run", Ranks()).state.table
    with pytest.warns(UserWarning, match="two checkpoints of 9,000,000,000,000 Gaussians take"):
        check_room(tmp_path, table, Ranks(), 9_000_000_000_000)
    assert not list(tmp_path.rglob(".probe*"))


@pytest.mark.parametrize(
    "name", ["config.yaml", "cameras.json", "log.jsonl", "summary.json", "trajectory.svg", "lineage"]
)
@pytest.mark.parametrize("resume", [True, False])
def test_files_of_other_programs_are_not_replaced(tmp_path, name, resume):
    (tmp_path / name).write_text("precious")
    with pytest.raises(FileExistsError, match=f"has {name}, which a run would replace"):
        Trainer(tiny_config(), *tiny_scene(), tmp_path, Ranks(), resume=resume)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "precious")]


def test_a_file_in_the_place_of_the_checkpoints_is_found_at_once(tmp_path):
    (tmp_path / "checkpoints").write_text("")
    with pytest.raises(FolderError, match="checkpoints cannot be written: rank 0 .*a file is where a folder"):
        Trainer(tiny_config(), *tiny_scene(), tmp_path, Ranks())


def _check(ranks, folders):
    check_writable(Path(folders[ranks.rank]), ranks)


def test_folders_are_checked_on_every_rank(tmp_path):
    with pytest.raises(RankError) as failure:
        run_ranks(_check, 2, [str(tmp_path / "a"), "/proc/nothing"])
    for message in failure.value.messages.values():
        assert "cannot be written: rank 1 (" in message
    with pytest.raises(RankError) as failure:
        run_ranks(_check, 2, [str(tmp_path / "a"), str(tmp_path / "b")])
    for message in failure.value.messages.values():
        assert "ranks 1 do not see what rank 0 writes" in message


def test_a_capture_that_cannot_be_read_leaves_no_folder(tmp_path):
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.iterations=2")
    command = ["train", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), *flags]
    assert main(command) == 1 and not (tmp_path / "run").exists()
    write_tiny_capture(tmp_path / "data")
    assert main(command) == 0


def test_one_run_at_a_time(tmp_path, monkeypatch, capsys):
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
        assert main(command) == 1
        assert f"in use by another run (process {holder.pid} on " in capsys.readouterr().err
        assert not (out / "log.jsonl").exists() and not (out / "config.yaml").exists()
    finally:
        holder.kill()
        holder.wait()
    assert main(command) == 0  # a lock does not outlive its process
    with locked(out, Ranks()):
        pass


@pytest.fixture(scope="module")
def other(trained, tmp_path_factory):
    """Another run of the same capture."""
    folder = tmp_path_factory.mktemp("other") / "run"
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.4", "log.pictures=0")
    assert main(["train", "--data", str(trained[0]), "--out", str(folder), *flags]) == 0
    return folder


@pytest.mark.parametrize("known_by", ["cameras", "log"])
@pytest.mark.parametrize("command", ["eval", "render", "export", "resume", "extend"])
def test_a_checkpoint_of_another_run_is_refused(trained, other, tmp_path, capsys, command, known_by):
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
    capsys.readouterr()
    assert main(arguments) == 1
    shown = " ".join(capsys.readouterr().err.split())
    assert f"was written by another run ({known_id(other)}) than the one in {run} ({known_id(run)})" in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["", "[]", "{", '{"run": 5}', '{"run": ""}', "\udcff"])
def test_a_damaged_file_names_no_run(tmp_path, content):
    for name in ("cameras.json", "log.jsonl"):
        (tmp_path / name).write_text(content, errors="surrogateescape")
    assert known_id(tmp_path) == ""
    assert known_id(tmp_path / "nothing") == ""
