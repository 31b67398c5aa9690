# SPDX-License-Identifier: Apache-2.0
"""What `train` prints of a capture before it trains, `--check`, and what it warns of or refuses."""

import json
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from blitzgs.capture import colmap
from blitzgs.cli import main
from blitzgs.training.understood import HopelessCaptureError, check_worlds
from tests.training.tiny import HEIGHT, OVERRIDES, WIDTH, as_flags, write_tiny_capture

FLAGS = as_flags("config=defaults", *OVERRIDES, "schedule.iterations=10")


@pytest.fixture
def data(tmp_path):
    write_tiny_capture(tmp_path / "data")
    return tmp_path / "data"


def check(data, capsys, *flags):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        status = main(["train", "--data", str(data), "--check", *FLAGS, *flags])
    printed = capsys.readouterr()
    lines = dict(line.split(":", 1) for line in printed.out.splitlines() if ":" in line)
    return status, {key: value.strip() for key, value in lines.items()}, printed.err, [
        str(w.message) for w in caught
    ]  # fmt: skip


def edit(data, change):
    folder = next((data / "sparse").glob("*")) if (data / "sparse" / "0").is_dir() else data / "sparse"
    model = colmap.read_model(folder)
    change(model)
    colmap.write_model(folder, model)


def test_check_prints_a_block_and_stops(data, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: pytest.fail("a GPU was touched"))
    before = {path for path in tmp_path.rglob("*")}
    status, lines, _, said = check(data, capsys)
    assert status == 0 and not said and before == {path for path in tmp_path.rglob("*")}
    names = ["capture", "photographs", "held out", "stray cameras", "sizes", "masks", "alpha", "points"]
    assert list(lines) == [*names, "exposure", "extent", "training"]
    assert lines["photographs"] == "8 used: 7 to train, 1 held out"
    assert lines["held out"].startswith("every 8th view by name: 00.png")
    assert lines["sizes"] == f"{WIDTH} x {HEIGHT} pixels" and lines["masks"] == lines["alpha"] == "none"
    assert lines["points"].startswith("400 of ") and "near plane" in lines["extent"]
    assert "Gaussians at most" in lines["training"] and "minutes" in lines["training"]


def test_train_prints_the_block_before_it_trains(data, capsys, tmp_path):
    assert main(["train", "--data", str(data), "--out", str(tmp_path / "run"), *FLAGS]) == 0
    shown = capsys.readouterr().out
    assert shown.index("photographs:") < shown.index("extent:") < shown.index("new run")


def test_what_was_left_out_is_in_the_block(data, capsys):
    cv2.imwrite(str(data / "images" / "x.png"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    (data / "images" / "02.png").unlink()

    def move(model):
        model.images.translations[5] += [400.0, 0, 0]

    edit(data, move)
    status, lines, _, _ = check(data, capsys, "--data.allow_missing=true")
    assert status == 0 and lines["photographs"].startswith(
        "6 used: 5 to train, 1 held out; 1 without a camera"
    )
    assert "1 not on disk" in lines["photographs"] and lines["stray cameras"].startswith(
        "1 left out: 05.png at"
    )
    status, lines, _, _ = check(data, capsys, "--data.allow_missing=true", "--data.stray_cameras=keep")
    assert lines["stray cameras"].startswith("1 kept: 05.png at")


def test_masks_and_their_share(data, capsys):
    half = np.full((HEIGHT, WIDTH), 255, np.uint8)
    half[:, : WIDTH // 2] = 0
    (data / "masks").mkdir()
    for i in range(4):
        cv2.imwrite(str(data / "masks" / f"{i:02}.png"), half)
    _, lines, _, _ = check(data, capsys)
    assert lines["masks"] == "4 of 8 photographs have one; mean share excluded 50.0% of 3 looked at"


@pytest.mark.parametrize(("value", "what"), [(0, "black"), (255, "saturated")])
def test_a_black_or_saturated_picture_is_predicted(data, capsys, value, what):
    edit(data, lambda model: model.points.colors.fill(value))
    _, _, _, said = check(data, capsys)
    assert [text for text in said if f"the points' colours are {what}" in text]
    for path in (data / "images").glob("*.png"):
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), value, np.uint8))
    _, _, _, said = check(data, capsys)
    assert [text for text in said if f"photographs that were looked at are {what}" in text]


def test_a_near_plane_beyond_the_points_is_predicted(data, capsys):
    _, _, _, said = check(data, capsys, "--model.near=3")
    assert any("views have all their points in front of the near plane" in text for text in said)


def test_points_of_another_world_stop_the_run(data, capsys, tmp_path):
    def move(model):
        model.points.positions += [1e5, 2e5, 3e5]

    edit(data, move)
    for flags in (["--check"], ["--out", str(tmp_path / "run")]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert main(["train", "--data", str(data), *flags, *FLAGS]) == 1
        shown = " ".join(capsys.readouterr().err.split())
        assert "8 of 8 views see none of the 400 points, so there is nothing to train" in shown
    assert not (tmp_path / "run").exists()


def test_views_that_see_no_random_point_ask_for_points():
    """As in a flight that looks straight down: parallel views do not meet anywhere."""
    about = SimpleNamespace(blind=3, random_points=True)
    with pytest.raises(
        HopelessCaptureError, match="site has no points, .* put the points of the reconstruct"
    ):
        check_worlds(SimpleNamespace(cameras=[None] * 3, about=about, root="site"))


def test_a_run_keeps_its_near_plane(data, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["train", "--data", str(data), "--out", str(out), *FLAGS]) == 0
    text = (out / "config.yaml").read_text()
    near = float(next(line for line in text.splitlines() if line.strip().startswith("near:")).split(":")[1])
    assert 0 < near <= 0.01
    cameras = json.loads((out / "cameras.json").read_text())
    assert len(cameras["cameras"]) == 8
