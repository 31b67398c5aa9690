"""Checkpoints as sources of files: what is streamed is what a model in memory holds."""

import shutil
import subprocess
import sys

import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats import gaussians as blocks
from blitzgs.formats.models import FORMATS
from blitzgs.formats.ply import read_ply
from blitzgs.runs import checkpoint
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
    with pytest.warns(UserWarning, match=f"checkpoint_999999 is damaged: .*; using {newest.name}"):
        assert len(open_source(run)) == before
    assert main(["export", str(broken), "--ply", str(tmp_path / "a.ply")]) == 1
    assert "damaged" in capsys.readouterr().err
    assert main(["export", str(newest), "--ply", str(tmp_path / "a.ply")]) == 0
    assert len(read_ply(tmp_path / "a.ply")) == before


_EXPORT = """
import sys
from pathlib import Path
from blitzgs.formats.models import FORMATS
from blitzgs.formats.selection import Selected, Selection
from blitzgs.runs import checkpoint
from blitzgs.runs.export import export
from blitzgs.runs.source import open_source
source = open_source(Path(sys.argv[1]))
chosen = Selected(source, Selection(min_opacity=1e-9, sh_degree=0))
export(chosen, source.space, FORMATS[sys.argv[2]], Path(sys.argv[3]))
# Not `ru_maxrss`, which begins with the peak of the process that started this one.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(len(source), 1024 * int(status["VmHWM"].split()[0]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ply", "glb"])
def test_fifty_million_gaussians_need_less_than_4_gb(trained, tmp_path, name):
    """The peak of two sizes; each Gaussian costs a few bytes beyond the blocks."""
    found = checkpoint.load(max((trained[1] / "checkpoints").glob("c*")), Ranks(), "cpu")
    peaks = {}
    for times in (250, 500):
        columns = {key: column.repeat(times, *[1] * (column.dim() - 1)) for key, column in found[0].items()}
        run = tmp_path / str(times)
        checkpoint.save(run / "checkpoints", columns, found[1], Ranks())
        del columns
        command = [sys.executable, "-c", _EXPORT, str(run), name, str(run / f"a.{name}")]
        count, peak = subprocess.run(command, capture_output=True, check=True, text=True).stdout.split()
        peaks[int(count)] = int(peak)
        shutil.rmtree(run)
    (few, low), (many, high) = sorted(peaks.items())
    assert few > 2 * blocks.BLOCK
    each = max(0.0, (high - low) / (many - few))
    print(f"{low / 1e6:.0f} MB for {few:,}, {high / 1e6:.0f} MB for {many:,}: {each:.1f} bytes each")
    assert high + each * (50e6 - many) < 4e9
