# SPDX-License-Identifier: Apache-2.0
"""The command line from a capture on disk to exported Gaussians, in-process and as torchrun starts it."""

import json
import math
import shlex
import shutil
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import read_ply
from blitzgs.runs import trained_model
from tests.training.tiny import HEIGHT, OVERRIDES, WIDTH, as_flags, events_of

ROOT = Path(__file__).parents[2]


def test_the_log_itemises_the_set_up(trained):
    (event,) = events_of(trained[1], "setup")
    names = ("imports", "device", "capture", "files", "checks", "gaussians", "table", "first step")
    assert tuple(event)[-len(names) :] == names
    assert all(event[name] >= 0 for name in names) and event["capture"] > 0


@pytest.mark.parametrize("strategy", ["density", "relocation"])
@pytest.mark.parametrize("most", [420, 10])
def test_the_log_names_the_limit_of_the_population(trained, tmp_path, capsys, strategy, most):
    limit = f"population.strategy={strategy}", f"population.max_gaussians={most}"
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.iterations=22", "population.growth=0.5", *limit)
    assert main(["train", "--data", str(trained[0]), "--out", str(tmp_path / "r"), *flags]) == 0
    event = events_of(tmp_path / "r", "densify")[0]
    held_back, shown = event["held_back"], " ".join(capsys.readouterr().out.split())
    assert held_back > 0 and event["gaussians"] <= most
    assert f"population.max_gaussians limits the model to {most} Gaussians; this event would" in shown
    assert ("thinned from 400 to population.max_gaussians" in shown) == (most == 10)


def test_eval_repeats_the_metrics_of_training(trained, tmp_path, capsys):
    summary = json.loads((trained[1] / "summary.json").read_text())
    assert main(["eval", str(trained[1]), "--out", str(tmp_path), "--pictures", "1", "--share-gpus"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {name: summary[name] for name in ("psnr", "ssim", "psnr_corrected")}
    assert f"{tmp_path}: metrics.json and pictures; " in printed.err
    assert [path.name for path in tmp_path.glob("*.jpg")] == ["00.jpg"]
    out = tmp_path / "all"
    assert main(["eval", str(trained[1]), "--split", "all", "--pictures=0", "--out", str(out)]) == 0
    views = json.loads((out / "metrics.json").read_text())["views"]
    assert sorted(views) == [f"{index:02}.png" for index in range(8)]


def test_render_writes_every_view(trained, tmp_path):
    assert main(["render", str(trained[1]), "--split", "test", "--raw", "--out", str(tmp_path / "raw")]) == 0
    assert main(["render", str(trained[1]), "--split", "all", "--out", str(tmp_path / "png")]) == 0
    raw = {path.stem: np.load(path) for path in (tmp_path / "raw").glob("*.npy")}
    assert len(raw) == 1 and len(list((tmp_path / "png").glob("*.png"))) == 8
    for name, image in raw.items():
        assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32
        png = cv2.imread(str(tmp_path / "png" / f"{name}.png"))[..., ::-1]
        assert np.abs(image.clip(0, 1) * 255 - png).max() <= 0.51


def test_export_restores_the_units_of_the_capture(trained, tmp_path, capsys):
    path = tmp_path / "model.ply"
    assert main(["export", str(trained[1]), "--ply", str(path), "--classic"]) == 0
    assert "--classic changes nothing: the model was trained without" in capsys.readouterr().err
    model, exported = trained_model.open_model(trained[1], Ranks()), read_ply(path)
    means = model.table["means"].double() * model.space.unit + torch.tensor(model.space.offset)
    torch.testing.assert_close(exported.means.double(), means, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(exported.scales, model.table["scales"] + math.log(model.space.unit))
    assert torch.equal(exported.quats, model.table["quats"])


def test_torchrun_entry(trained, tmp_path):
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.02")
    command = [sys.executable, "train.py", "--data", str(trained[0]), "--out", str(tmp_path / "r"), *flags]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, env=None)
    assert done.returncode == 0, done.stderr
    assert "psnr" in done.stdout and (tmp_path / "r" / "summary.json").exists()


@pytest.mark.parametrize(
    ("command", "status", "message"),
    [
        ("train --out x", 1, "data.path: no capture given; use --data DIR"),
        ("train --out x --resume", 1, "x holds no run to continue (it has no config.yaml): check"),
        ("train --data /nowhere --out x", 1, "/nowhere"),
        ("train --data d --out x --loss.ssim --resume", 2, "argument --loss.ssim: expected one argument"),
        ("train --data d --out x --loss.sim 1", 2, "--loss.sim 1; did you mean --loss.ssim?"),
        ("train --data d --out x --loss.sim=1", 1, "loss.sim: unknown field; did you mean 'ssim'"),
        ("train --data d --out x --loss.ssim -1e-3", 1, "loss.ssim: must be in [0, 1], got -0.001"),
        ("train --data d --out x 5", 2, "written --section.field=value"),
        ("train --data d --out x --minute=5", 2, "--minute=5; did you mean --minutes?"),
        ("eval x --pictures 1 --pictures=2", 2, "--pictures is given twice"),
        ("train --out x --extend=2 --minutes=3", 2, "--extend and --minutes exclude"),
        ("train --check --resume", 2, "required: --data, --out"),
        ("train --out x --log.every 1 --log.every=1", 2, "--log.every is given twice"),
        ("train --out x --extend=1", 2, "a number of images from 100 on, or a factor above 1, got 1"),
        ("train --out x --extend=100.5", 2, "a factor above 1, got 100.5"),
        ("train --help downscal", 2, "no such field of the configuration; did you mean downscale"),
        ("eval 'a\x1b[31m\x07b\nc'", 1, "a\\x1b[31m\\x07b\\nc is not a run"),
        ("eval a '--\x1b[2J'", 2, "unrecognized arguments: --\\x1b[2J"),
        ("train --data d", 2, "required: --out"),
        ("train", 2, "required: --data, --out"),
        (
            "train --config missing.yaml --out x",
            1,
            "no such file or recipe; recipes are aerial, aerial_cpu",
        ),
        ("eval /nowhere", 1, "/nowhere is not a run"),
        ("eval /nowhere --pictures=-3", 2, "--pictures: must be 0 or more, got -3"),
        ("gate fit x --gate-from=nan --out g.json", 2, "--gate-from: must be 0 or more, got nan"),
        ("export /nowhere --ply x.ply", 1, "/nowhere is not a run"),
        ("export x --ply x.ply --most 0", 2, "--most: must be a whole number from 1 on, got 0"),
        ("export x --ply x.ply --min-opacity=1", 2, "--min-opacity: must be from 0 to below 1, got 1"),
        ("train --data d --out x --device tpu", 1, "cuda or cuda:N, got 'tpu'"),
        ("train --data d --out ''", 2, "argument --out: the path is empty"),
        ("eval ''", 2, "argument MODEL: the path is empty"),
        ("eval .", 1, ". is not a run: it has no config.yaml and no checkpoints: name the --out of a"),
        ("eval '~/runs'", 1, "/home/me/runs is not a run"),
        ("train d --out x", 2, "unrecognized arguments: d; did you mean --data d?"),
        ("train --config=~/c.yaml --out x", 1, "/home/me/c.yaml: no such file or recipe"),
        ("synth .", 1, "the folder must be given by its name, got '.'"),
        ("synth city --processes=-2", 1, "processes must be at least 1, got -2"),
        ("train --data loop --out x", 1, "loop is not a folder"),
        ("eval /nowhere --fast", 2, "unrecognized arguments: --fast (blitzgs eval --help"),
        ("eval /nowhere --pictrues=3", 2, "--pictrues=3; did you mean --pictures?"),
        ("train --data d --out x --start m.ply", 1, "m.ply: there is no such file of Gaussians (--start)"),
        # Before the capture is read, which takes long.
        ("train --data d --out file/x", 1, "file is a file where a folder is needed"),
        ("train --data d --out old", 1, "old already holds a run: add --resume"),
    ],
)
def test_mistakes_get_a_message(command, status, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setenv("HOME", "/home/me")
    Path("loop").symlink_to("loop")
    Path("file").touch()
    Path("old/checkpoints/checkpoint_000000").mkdir(parents=True)
    try:
        result = main(shlex.split(command))
    except SystemExit as exit_:
        result = exit_.code
    assert result == status
    printed = capsys.readouterr().err
    assert message in printed and "Traceback" not in printed and "usage:" not in printed


@pytest.mark.parametrize("command", ["view x", "export x --ply m.ply", "sfm x y", "synth x"])
def test_commands_of_one_process_refuse_torchrun(command, monkeypatch, tmp_path, failure):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.chdir(tmp_path)
    assert "this is the work of one process: run it without torchrun" in failure(*command.split())
    assert not list(tmp_path.iterdir())


def test_a_python_without_our_packages_is_named(tmp_path):
    without = "import sys; sys.modules |= {'numpy': None, 'rich': None}; from blitzgs.cli import main"
    code = f"{without}; sys.exit(main(['train', '--data', 'd', '--out', 'x']))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith(f"blitzgs train: {sys.executable} has no numpy: use the Python of")


def test_another_capture_is_refused(trained, tmp_path, failure):
    shutil.copytree(trained[0], tmp_path / "other: one")
    for name in ("eval", "render"):
        flags = ["--out", tmp_path / name, "--data", tmp_path / "other: one"]
        assert main([str(argument) for argument in (name, trained[1], *flags)]) == 0
    poses = tmp_path / "other: one" / "sparse" / "0" / "images.bin"
    content = bytearray(poses.read_bytes())
    struct.pack_into("<d", content, 8 + 4 + 4 * 8, 9.0)  # the first camera's translation along x
    poses.write_bytes(content)
    for name in ("eval", "render"):
        message = failure(name, trained[1], *flags[2:], "--out", tmp_path / "no")
        assert "is not the capture of the run" in message and not (tmp_path / "no").exists()


def test_photographs_that_were_changed_meanwhile_are_named(trained, tmp_path):
    data, out = tmp_path / "data", tmp_path / "run"
    shutil.copytree(trained[0], data)
    shutil.copytree(trained[1], out)
    resume = ["train", "--resume", "--out", str(out), "--data", str(data)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(resume) == 0  # copies are the same photographs
    brighter = cv2.imread(str(data / "images" / "03.png")) // 2 + 120
    assert cv2.imwrite(str(data / "images" / "03.png"), brighter)
    for command in (resume, ["eval", str(out), "--data", str(data)]):
        with pytest.warns(UserWarning, match="1 of 8 photographs .* have changed .* began: 03.png; "):
            assert main(command) == 0


def test_mistakes_with_files_name_them(trained, tmp_path, failure):
    file = tmp_path / "binary"
    file.write_bytes(b"\xff\xfe")
    data = ["--data", trained[0], "--out", tmp_path / "x"]
    assert f"{file}: not valid YAML" in failure("train", "--config", file, *data)
    for out in (file, file / "inside"):
        assert f"{file} is a file where a folder is needed" in failure("render", trained[1], "--out", out)
    assert f"{file} is a file where a folder is needed" in failure("synth", file / "inside")
    limited = failure("train", "--resume", "--out", trained[1], "--minutes=3")
    assert "--minutes: the run in" in limited and "leave out --minutes" in limited and "--extend" in limited
    small = failure("train", *data, "--data.downscale=100")
    assert "downscale 100 leaves 1 x 1 pixels" in small
    among = failure("train", *data[:2], "--out", trained[0] / "images/run")
    assert "images/run is in " in among and "choose a folder outside it" in among


def test_figures_of_training_views_are_called_so(trained, tmp_path, capsys, failure):
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.02", "data.split=0")
    assert main(["train", "--data", str(trained[0]), "--out", str(tmp_path / "run"), *flags]) == 0
    shown, summary = capsys.readouterr().out, json.loads((tmp_path / "run" / "summary.json").read_text())
    assert "evaluation of TRAINING views (none is held out)" in shown and summary["split"] == "train"
    assert "no view is held out: the figures are those of the training views" in shown
    assert f"blitzgs render {tmp_path / 'run'} --split train --out PICTURES" in shown
    assert "no test views: choose another --split" in failure("eval", tmp_path / "run")


def test_photographs_are_never_overwritten(trained, failure):
    photos = trained[0] / "images"
    before = {path: path.read_bytes() for path in photos.iterdir()}
    for command in (("render", trained[1], "--split", "all"), ("eval", trained[1])):
        assert "would lie among the inputs" in failure(*command, "--out", photos)
    assert {path: path.read_bytes() for path in photos.iterdir()} == before
