# SPDX-License-Identifier: Apache-2.0
"""Finished runs are read, rendered and exported without trainer, capture or photographs."""

import dataclasses
import json
import math
import random
import shutil
import subprocess
import sys
import warnings

import numpy as np
import psutil
import pytest
import torch

import blitzgs
from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import read_ply
from blitzgs.runs import checkpoint, trained_model
from blitzgs.runs.export import without_antialiasing
from tests.helpers import export_ply, refused, save_checkpoint
from tests.training.tiny import OVERRIDES, as_flags, train


@pytest.fixture
def copy(trained, tmp_path):
    """A copy of the run that a test may change."""
    shutil.copytree(trained[0], tmp_path / "data")
    shutil.copytree(trained[1], tmp_path / "run")
    return tmp_path / "data", tmp_path / "run"


def test_a_run_is_read_without_the_trainer(trained):
    program = (
        "import sys, blitzgs; run = blitzgs.open_run(sys.argv[1]); model = run.model();"
        "image = model.render(run.cameras().cameras[0]); print(tuple(image.shape));"
        "print([name for name in sys.modules if 'trainer' in name or 'scene.images' in name])"
    )
    done = subprocess.run([sys.executable, "-c", program, trained[1]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["(32, 48, 3)", "[]"]


def test_a_model_asks_for_a_device_that_exists(trained, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    refused(ValueError, "device cuda: .*; install one with CUDA", blitzgs.open_run(trained[1]).model, "cuda")
    assert blitzgs.open_run(trained[1]).model(torch.device("cpu")).means.device.type == "cpu"


def test_what_a_run_folder_holds(trained, tmp_path):
    folder = blitzgs.open_run(trained[1])
    summary = folder.summary()
    assert folder.config().schedule.scale == 0.4
    assert folder.metrics()["000040"]["psnr"] == summary["psnr"]
    assert [r["t"] for r in folder.log() if "loss" in r] == [20, 40]
    model, stored = folder.model(), folder.cameras()
    assert len(model) == summary["gaussians"] and model.images_seen == 40
    assert len(stored.train) == 7 and [stored.cameras[i].name for i in stored.test] == ["00.png"]
    assert main(["render", str(trained[1]), "--raw", "--split", "all", "--out", str(tmp_path)]) == 0
    for camera in stored.cameras:
        expected = np.load(tmp_path / camera.name.replace(".png", ".npy"))
        torch.testing.assert_close(model.render(camera), torch.from_numpy(expected), rtol=0, atol=1e-5)
    # The same view from its pose in the capture's own world.
    moved = np.array(stored.cameras[3].world_to_camera)
    moved[:3, 3] -= moved[:3, :3] @ np.array(model.space.offset)
    again = model.camera(stored.cameras[3].K, moved, 48, 32)
    torch.testing.assert_close(model.render(again), model.render(stored.cameras[3]), rtol=0, atol=1e-4)
    refused(FileNotFoundError, "is not a run", blitzgs.open_run, tmp_path)


def test_a_model_renders_depth_and_alpha_too(trained):
    folder = blitzgs.open_run(trained[1])
    model, camera = folder.model(), folder.cameras().cameras[0]
    both = model.render(camera, "RGB+ED", alpha=True)
    assert both.shape == (32, 48, 5)
    torch.testing.assert_close(both[..., :3], model.render(camera))
    torch.testing.assert_close(both[..., 3:4], model.render(camera, render_mode="ED"))
    # Depths are lengths in the capture: they do not depend on the unit of the training.
    plain = dataclasses.replace(model, lod=None)
    other = dataclasses.replace(
        plain,
        means=model.means / 2,
        scales=model.scales - math.log(2),
        space=dataclasses.replace(model.space, unit=2 * model.space.unit),
    )
    torch.testing.assert_close(other.render(camera, "RGB+ED", True), plain.render(camera, "RGB+ED", True))
    covered = both[..., 4] > 0.9
    assert covered.any() and both[..., 3][covered].median() > 0
    refused(ValueError, "render_mode must be one of .*, got 'depth'", model.render, camera, "depth")


def test_a_run_and_its_model_print_in_a_line(trained, copy):
    model = blitzgs.open_run(trained[1]).model()
    assert repr(model) == f"Model({len(model):,} Gaussians of SH degree 3 on cpu, 40 images seen)"
    folder = blitzgs.open_run(copy[1])
    assert repr(folder) == f"RunFolder({str(copy[1])!r}, finished)"
    (copy[1] / "summary.json").unlink()
    assert repr(folder).endswith(", not finished)")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"K": np.eye(2)}, ValueError, r"K must be a finite matrix \(3, 3\)"),
        ({"K": np.full((3, 3), np.nan)}, ValueError, "K must be a finite matrix"),
        ({"K": "x"}, TypeError, "K must be a matrix of numbers, got str"),
        ({"world_to_camera": np.eye(4)[:3]}, ValueError, r"world_to_camera must be a finite matrix \(4, 4\)"),
        ({"world_to_camera": 2 * np.eye(4)}, ValueError, r"\[:3, :3\] must be a rotation"),
        ({"world_to_camera": np.diag([1.0, 1, -1, 1])}, ValueError, r"\[:3, :3\] must be a rotation"),
        ({"width": 0}, ValueError, "width must be an integer from 1 to 1,048,576, got 0"),
        ({"height": 32.5}, ValueError, "height must be an integer from 1 to 1,048,576, got 32.5"),
        ({"width": "64"}, TypeError, r"width must be an integer, got '64' \(str\)"),
        ({"width": True}, TypeError, "width must be an integer, got True"),
    ],
)
def test_a_camera_that_cannot_be_rendered_is_refused(trained, change, error, message):
    model = blitzgs.open_run(trained[1]).model()
    fields = {"K": np.eye(3), "world_to_camera": np.eye(4), "width": 48, "height": 32}
    assert model.camera(**fields).width == 48
    refused(error, message, model.camera, **fields | change)


def test_a_model_renders_the_cameras_of_its_run_by_index(trained):
    run = blitzgs.open_run(trained[1])
    model, cameras = run.model(), run.cameras()
    assert repr(cameras) == "RunCameras(8 cameras: 7 train, 1 test)"
    for index in (cameras.test[0], np.int64(0), 7):
        assert torch.equal(model.render(index), model.render(cameras.cameras[index]))
    refused(IndexError, "camera 8: the run has the cameras 0 to 7", model.render, 8)
    for wrong in ("a", None, True, 1.5):
        refused(TypeError, "camera must be a camera, such as run.cameras", model.render, wrong)
    refused(TypeError, r"got 0 \(int\)", dataclasses.replace(model, run=None).render, 0)


def test_too_large_an_image_is_said_to_lack_memory(trained):
    run = blitzgs.open_run(trained[1])
    # The colours alone take three times the memory; more would only take longer.
    height = min(60_000, psutil.virtual_memory().total // 4_000_000)
    camera = dataclasses.replace(run.cameras().cameras[0], width=1_000_000, height=height)
    match = (
        f"not enough memory to render 1 view of 1,000,000 x {height:,} pixels with .* Gaussians: the pixels"
    )
    refused(MemoryError, match, run.model().render, camera)


@pytest.mark.parametrize("command", ["eval", "render"])
def test_a_run_is_shown_with_another_pool_than_it_was_trained_with(copy, tmp_path, capsys, failure, command):
    data, folder = copy
    config = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(config.replace("resident_gb: 0.0", "resident_gb: 1.0e-06"))
    arguments = [command, str(folder), "--out", str(tmp_path / "out")]
    arguments += ["--data", str(data)] if command == "eval" else []
    assert "--resident-gb" in failure(*arguments)
    for gigabytes in ("0", "1"):
        assert main([*arguments, "--resident-gb", gigabytes]) == 0
    for wrong in ("nan", "all"):
        with pytest.raises(SystemExit):
            main([*arguments, "--resident-gb", wrong])
        assert f"--resident-gb: must be in [0, 1,000,000], got {wrong}" in capsys.readouterr().err


def test_a_lost_photograph_costs_its_view_alone(copy, capsys, failure):
    data, folder = copy
    whole = json.loads((folder / "evaluation" / "000040" / "metrics.json").read_text())
    for name in ("01.png", "05.png"):  # photographs of training views are lost; split and world do not change
        (data / "images" / name).unlink()
    flags = ["--data", str(data)]
    assert "05.png" in (message := failure("eval", folder, *flags)) and "(--allow-missing)" in message
    assert main(["eval", str(folder), *flags, "--allow-missing", "--split", "train"]) == 0
    capsys.readouterr()
    assert main(["eval", str(folder), *flags, "--allow-missing"]) == 0
    assert json.loads(capsys.readouterr().out)["psnr"] == whole["psnr"]
    resume = ["train", "--out", str(folder), "--resume", *flags]
    assert "--data.allow_missing=true" in failure(*resume)
    assert main([*resume, "--data.allow_missing=true"]) == 0


def test_a_damaged_camera_file_says_what_to_do(copy, tmp_path, failure):
    _, folder = copy
    content = json.loads((folder / "cameras.json").read_text())
    damages = ["", "{", '{"version": 2}', '{"version": 1, "cameras": [{}]}', "[]", "[" * 100_000]
    for field, value in (
        ("width", 0),
        ("width", (1 << 20) + 1),
        ("height", math.inf),
        ("K", np.zeros((3, 3)).tolist()),
        ("world_to_camera", np.zeros((4, 4)).tolist()),
    ):
        damages.append(json.dumps(content | {"cameras": [content["cameras"][0] | {field: value}]}))
    damages.append(json.dumps(content | {"test": [math.inf]}))
    for damage in damages:
        (folder / "cameras.json").write_text(damage)
        message = failure("render", folder, "--out", tmp_path / "out")
        assert "cameras.json is damaged" in message and "--data" in message
    assert main(["export", str(folder), "--ply", str(tmp_path / "a.ply")]) == 0
    assert not any(" up " in line for line in read_ply(tmp_path / "a.ply").comments)


# The configuration in the checkpoint is used.


@pytest.mark.parametrize("content", ["", "model: {sh_degree: 0}\n", "loss: [", None])
def test_eval_uses_the_configuration_of_the_checkpoint(copy, tmp_path, capsys, content):
    data, folder = copy
    expected = json.loads((folder / "summary.json").read_text())["psnr"]
    if content is None:
        (folder / "config.yaml").unlink()
    else:
        (folder / "config.yaml").write_text(content)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert main(["eval", str(folder), "--data", str(data), "--out", str(tmp_path / "out")]) == 0
    assert json.loads(capsys.readouterr().out)["psnr"] == expected
    assert any("the configuration in the checkpoint is used" in str(w.message) for w in caught)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--resume", "--loss.ssim=0.3"], "loss.ssim: the checkpoint was trained with 0.2, now 0.3"),
        (["--extend=1.5", "--loss.ssim=0.3"], "loss.ssim: the checkpoint was trained with 0.2, now 0.3"),
        (["--resume", "--population.gate=no.json"], "no.json: no such gate; `blitzgs gate fit` makes one"),
        (["--check", "--config=defaults", "--population.gate=no.json"], "no.json: no such gate"),
        # What the capture decides is compared when it is known.
        (["--resume", "--model.near=0", "--schedule.images_per_view=9", "--loss.opacity_total=1"], "nowhere"),
    ],
)
def test_a_run_is_refused_before_its_capture_is_read(trained, tmp_path, failure, flags, message):
    assert message in failure("train", "--out", trained[1], "--data", tmp_path / "nowhere", *flags)


def test_nothing_is_extended_before_the_capture_is_read(tmp_path, failure):
    flags = ("--config=defaults", "--extend=1.5", "--data", tmp_path / "nowhere")
    assert "there is no finished run to extend" in failure("train", "--out", tmp_path / "run", *flags)


@pytest.mark.parametrize(
    "state", [{}, {"progress": {"steps": 1}}, {"progress": [], "space": {"offset": 3}, "config": {}}]
)
def test_a_checkpoint_of_another_version_is_named(trained, tmp_path, failure, state):
    shutil.copy(trained[1] / "config.yaml", tmp_path)
    table = trained_model.restore(trained[1], Ranks()).table
    save_checkpoint(tmp_path / "checkpoints", {name: table[name] for name in table}, state, Ranks())
    assert "checkpoint_000000 belongs to another version of BlitzGS" in failure("eval", tmp_path)


@pytest.mark.parametrize(
    ("columns", "state", "reason"),
    [
        (lambda found: {"means": found["means"].double()}, {}, "column 'means' must be torch.float32"),
        (lambda found: {"sh": found["sh"].flatten(1)}, {}, "'exp_avg.sh' must be"),
        (None, {"progress": {"step": "x"}}, "progress.step: must be an integer, got 'x'"),
        (None, {"progress": {"ledger": [1]}}, "progress.ledger: must be a section, got [1]"),
        (None, {"space": {"unit": 0}}, "unit and extent must be positive, got 0.0"),
        (None, {"space": {"offset": [0, 0]}}, "space.offset: must be a list of 3 values"),
    ],
)
@pytest.mark.parametrize("command", [["eval"], ["export", "--ply"]])
def test_a_sound_checkpoint_of_another_content_is_named(
    trained, tmp_path, failure, columns, state, reason, command
):
    shutil.copy(trained[1] / "config.yaml", tmp_path)
    loaded = checkpoint.load(next((trained[1] / "checkpoints").iterdir()), Ranks(), "cpu")
    content = loaded.columns | (columns(loaded.columns) if columns else {})
    changed = {name: values | state.get(name, {}) for name, values in loaded.state.items() if name != "run"}
    save_checkpoint(tmp_path / "checkpoints", content, changed, Ranks())
    command, *flags = command
    text = failure(command, tmp_path, *flags, *([tmp_path / "m.ply"] if flags else []))
    assert "checkpoint_000000" in text and reason in text


def test_no_flipped_bit_of_a_manifest_passes(tmp_path):
    columns = {"means": torch.randn(5, 3), "id": torch.arange(5)}
    state = {"progress": {"step": 12, "seconds": 1.5}, "config": {"seed": 0, "scale": 1e-3, "ok": True}}
    path = save_checkpoint(tmp_path, columns, state, Ranks())
    manifest = path / "manifest.json"
    good = manifest.read_bytes()
    choice, passed = random.Random(5), 0
    for _ in range(600):
        data = bytearray(good)
        data[choice.randrange(len(data))] ^= 1 << choice.randrange(8)
        manifest.write_bytes(data)
        try:
            loaded = checkpoint.load(path, Ranks(), "cpu")
        except checkpoint.CheckpointError:
            continue
        passed += 1  # white space
        assert loaded.state == state and torch.equal(loaded.columns["means"], columns["means"])
    assert passed < 120


# Exports.


def test_georeferenced_models_are_exported_around_their_origin(trained, tmp_path, capsys, failure):
    model = blitzgs.open_run(trained[1]).model()
    far = dataclasses.replace(model, space=dataclasses.replace(model.space, offset=(5e5, 4.6e6, 120.0)))
    exported = export_ply(far, tmp_path / "far.ply")
    assert exported.offset == (5e5, 4.6e6, 120.0)
    found = read_ply(tmp_path / "far.ply")
    assert "comment offset 500000.0 4600000.0 120.0" in found.comments
    torch.testing.assert_close(found.means, model.means * model.space.unit)
    sidecar = json.loads((tmp_path / "far.ply.offset.json").read_text())
    assert sidecar["file"] == "far.ply" and sidecar["offset"] == [5e5, 4.6e6, 120.0]
    # On request, coordinates are written unchanged, and a warning states the loss of precision.
    rounded = export_ply(far, tmp_path / "rounded.ply", "capture")
    assert rounded.offset is None and rounded.rounding == 0.25
    error = (read_ply(tmp_path / "rounded.ply").means.double()[:, 1] - 4.6e6).float() - found.means[:, 1]
    assert 0.1 < error.abs().max() <= 0.25
    near = export_ply(model, tmp_path / "near.ply")
    assert near.offset is None and not (tmp_path / "near.ply.offset.json").exists()
    flags = ["--coordinates", "centred"]
    assert main(["export", str(trained[1]), "--ply", str(tmp_path / "c.ply"), *flags]) == 0
    assert "c.ply.offset.json says" in capsys.readouterr().out
    # An offset that no longer holds does not stay.
    assert main(["export", str(trained[1]), "--ply", str(tmp_path / "c.ply")]) == 0
    assert not (tmp_path / "c.ply.offset.json").exists()
    mine = tmp_path / "d.ply.offset.json"
    mine.write_text("mine")
    message = failure("export", trained[1], "--ply", tmp_path / "d.ply", *flags)
    assert "is not the offset of an exported model: choose another name" in message
    assert main(["export", str(trained[1]), "--ply", str(tmp_path / "d.ply")]) == 0
    assert mine.read_text() == "mine"


def test_antialiased_models_are_marked_and_can_be_baked(tmp_path, capsys):
    train(tmp_path / "aa", "model.antialiased=true", "schedule.scale=0.4")
    folder = blitzgs.open_run(tmp_path / "aa")
    model, stored = folder.model(), folder.cameras()
    assert main(["export", str(folder.path), "--ply", str(tmp_path / "aa.ply")]) == 0
    assert "comment SplatRenderMode: mip" in read_ply(tmp_path / "aa.ply").comments
    assert "--classic" in capsys.readouterr().err
    assert main(["export", str(folder.path), "--ply", str(tmp_path / "classic.ply"), "--classic"]) == 0
    out, errors = capsys.readouterr()
    assert "antialiasing is baked into the opacities" in out and "changes nothing" not in errors
    classic = read_ply(tmp_path / "classic.ply")
    assert not any("SplatRenderMode" in comment for comment in classic.comments)
    # A viewer without antialiasing shows the baked model far closer to what was trained.
    baked = without_antialiasing(model, [stored.cameras[i] for i in stored.train])
    torch.testing.assert_close(classic.opacities, baked.opacities)
    errors = {"marked": 0.0, "baked": 0.0}
    for camera in stored.cameras:
        wanted = model.render(camera)
        errors["marked"] += (model.splat([camera], antialiased=False)[0][0] - wanted).square().mean().item()
        errors["baked"] += (baked.render(camera) - wanted).square().mean().item()
    gain = 10 * math.log10(errors["marked"] / errors["baked"])
    assert gain > 3, errors


# Paths may have any characters.


@pytest.mark.parametrize("name", ["emoji 🏙 [/b] :x: [red]", "bytes \udcff\udcfe", "a: b # {c} 𝔸 \"'"])
def test_any_path_works(trained, tmp_path, capfd, name):
    data, out = tmp_path / f"data {name}", tmp_path / f"run {name}"
    shutil.copytree(trained[0], data)
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.02")
    assert main(["train", "--data", str(data), "--out", str(out), *flags]) == 0
    printed = capfd.readouterr().out
    assert "psnr" in printed
    assert (out / "report.html").exists()
    assert name.encode(errors="backslashreplace").decode() in printed
    for command in (
        ["eval", str(out)],
        ["render", str(out), "--out", str(tmp_path / f"r {name}")],
        ["export", str(out), "--ply", str(tmp_path / f"{name.replace('/', '')}.ply")],
        ["export", str(out), "--html", str(tmp_path / f"{name.replace('/', '')}.html")],
        ["train", "--out", str(out), "--resume"],
    ):
        assert main(command) == 0, capfd.readouterr().err
