"""Checkpoints as sources of files: what is streamed is what a model in memory holds."""

import shutil

import torch

from blitzgs.cli import main
from blitzgs.formats import gaussians as blocks
from blitzgs.formats.models import FORMATS
from blitzgs.formats.ply import read_ply
from blitzgs.runs.export import export, export_ply
from blitzgs.runs.folder import open_run
from blitzgs.runs.source import open_source, source_of


def test_a_checkpoint_is_streamed_with_its_pending_steps(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 100)
    model, streamed = open_run(trained[1]).model(), open_source(trained[1])
    whole = source_of(model)
    assert len(streamed) == len(whole) == len(model) > 300 and streamed.comments == whole.comments
    sizes = [len(block) for block in streamed.blocks()]
    assert max(sizes) == 100 and sum(sizes) == len(model)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        found = torch.cat([getattr(block, name) for block in streamed.blocks()])
        expected = torch.cat([getattr(block, name) for block in whole.blocks()])
        assert torch.equal(found, expected), name
    export(streamed, streamed.space, FORMATS["ply"], tmp_path / "a.ply")
    export_ply(model, tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_damaged_checkpoint_is_passed_over(trained, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(trained[1], run)
    newest = max((run / "checkpoints").glob("checkpoint_*"))
    before = len(open_source(run))
    broken = run / "checkpoints" / "checkpoint_999999"
    shutil.copytree(newest, broken)
    (broken / "manifest.json").write_text("{}")
    assert len(open_source(run)) == before
    assert main(["export", str(broken), "--ply", str(tmp_path / "a.ply")]) == 1
    assert "damaged" in capsys.readouterr().err
    assert main(["export", str(newest), "--ply", str(tmp_path / "a.ply")]) == 0
    assert len(read_ply(tmp_path / "a.ply")) == before
