"""Models of files and for files, from the command line."""

import json
import os
import re

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")

import cv2
import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats.models import FORMATS, read_gaussians
from blitzgs.runs.files import open_model
from blitzgs.viewer.studio import open_model as open_viewed


@pytest.fixture(scope="module")
def whole(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "whole.ply"
    assert main(["export", str(trained[1]), "--ply", str(path)]) == 0
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_and_a_file_are_exported(trained, whole, tmp_path, name, capsys):
    pytest.importorskip("gsply")
    expected = read_gaussians(whole)
    for source in (trained[1], whole):
        path = tmp_path / source.name / f"model{FORMATS[name].suffix}"
        assert main(["export", str(source), f"--{name}", str(path)]) == 0
        assert re.search(rf"{path}: {len(expected):,} Gaussians, \d", capsys.readouterr().out)
        if name != "glb":
            found = read_gaussians(path)
            assert len(found) == len(expected)
            assert (found.means.mean(dim=0) - expected.means.mean(dim=0)).abs().max() < 0.05


def test_a_file_is_measured_as_its_run(trained, whole, tmp_path, capsys):
    assert main(["eval", str(trained[1]), "--out", str(tmp_path / "a"), "--pictures=0"]) == 0
    run = json.loads(capsys.readouterr().out)
    flags = ["--data", str(trained[0]), "--out", str(tmp_path / "b"), "--pictures=0"]
    assert main(["eval", str(whole), *flags]) == 0
    file = json.loads(capsys.readouterr().out)
    # The file's positions are rounded to float32 away from the origin.
    assert file["psnr"] == pytest.approx(run["psnr"], abs=0.02)
    assert main(["eval", str(whole)]) == 1
    assert "add --data CAPTURE" in capsys.readouterr().err


def test_a_training_begins_with_a_file(trained, whole, tmp_path, capsys):
    out = tmp_path / "run"
    flags = ["--config=defaults", "--schedule.iterations=4", "--log.tensorboard=false", "--log.pictures=0"]
    arguments = ["train", "--data", str(trained[0]), "--out", str(out), "--start", str(whole)]
    assert main([*arguments, *flags]) == 0
    capsys.readouterr()
    first = read_gaussians(whole)
    table = open_model(out, Ranks()).table
    assert len(table) == len(first)
    summary, before = (json.loads((r / "summary.json").read_text()) for r in (out, trained[1]))
    assert summary["psnr"] > before["psnr"] - 1.0
    assert main([*arguments[:-3], str(tmp_path / "b"), "--start", str(whole), *flags,
                 "--population.max_gaussians=3"]) == 1  # fmt: skip
    assert "population.max_gaussians is 3" in capsys.readouterr().err


def test_selections_of_a_run(trained, whole, tmp_path):
    expected = read_gaussians(whole)
    path = tmp_path / "a.ply"
    run = ["export", str(trained[1]), "--ply", str(path)]
    middle = expected.means.median(dim=0).values
    box = [*(middle - 100).tolist(), middle[0].item(), *(middle[1:] + 100).tolist()]
    assert main([*run, "--crop", *map(repr, box), "--sh-degree", "0"]) == 0
    found = read_gaussians(path)
    assert found.degree == 0 and len(found) == int((expected.means[:, 0] <= middle[0]).sum())
    assert main([*run, "--most", "50", "--min-opacity", "0.05"]) == 0
    found = read_gaussians(path)
    assert len(found) == 50 and found.opacities.sigmoid().min() >= 0.05
    region = tmp_path / "region.txt"
    x, y, _ = (middle + 1e-5).tolist()  # no Gaussian is on the border
    region.write_text(f"{x - 100} {y - 100}\n{x - 100} {y}\n{x + 100} {y}\n{x + 100} {y - 100}\n")
    assert main([*run, "--crop-polygon", str(region)]) == 0
    assert len(read_gaussians(path)) == int((expected.means[:, 1] <= y).sum())


def test_clean_shows_and_measures_what_goes(trained, whole, tmp_path, capsys):
    path = tmp_path / "a.ply"
    run = ["export", str(trained[1]), "--ply", str(path)]
    assert main([*run, "--clean", "3"]) == 0
    out = capsys.readouterr().out
    found = re.search(r"--clean: ([\d,]+) of ([\d,]+)", out).groups()
    gone, count = (int(text.replace(",", "")) for text in found)
    assert 0 < gone < count == len(read_gaussians(whole))
    assert len(read_gaussians(path)) == count - gone
    assert re.search(r"held-out PSNR: \d+\.\d+ dB before, \d+\.\d+ dB after", out)
    picture = cv2.imread(str(tmp_path / "a.ply.clean.jpg"))
    assert picture is not None and picture.shape[1] > 3 * 40 and np.ptp(picture) > 50


def test_wrong_flags_are_named(trained, whole, tmp_path, capsys):
    ply = ["--ply", str(tmp_path / "a.ply")]
    for model, flags, reason in (
        (trained[1], [*ply, "--crop", *"000100"], "--crop takes the least"),
        (trained[1], [*ply, "--min-opacity", "2"], "--min-opacity must be"),
        (trained[1], [*ply, "--most", "0"], "--most must be"),
        (trained[1], [*ply, "--clean", "0"], "--clean must be"),
        (trained[1], [*ply, "--crop-axes", "xz"], "is for --crop-polygon"),
        (trained[1], [*ply, "--levels", "0-1"], "no octree levels"),
        (trained[1], ["--spz", str(tmp_path / "a.ply")], "ends in .spz"),
        (whole, [*ply, "--clean"], "--clean needs the folder of a run"),
        (whole, [*ply, "--classic"], "--classic needs the folder of a run"),
    ):
        assert main(["export", str(model), *flags]) == 1, flags
        assert reason in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_files_of_all_formats_are_viewed(whole, tmp_path):
    pytest.importorskip("gaussforge")
    path = tmp_path / "a.splat"
    assert main(["export", str(whole), "--splat", str(path)]) == 0
    opened = open_viewed(path, Ranks())
    assert len(opened.table) == len(read_gaussians(whole)) and opened.exhibit.title == "a.splat"
    assert torch.isfinite(opened.table["means"]).all()
