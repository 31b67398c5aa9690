# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of another run are refused, whatever command reads them."""

import json
import shutil

import pytest

from blitzgs.cli import main
from blitzgs.runs.identity import known_id
from tests.training.tiny import OVERRIDES, as_flags


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
