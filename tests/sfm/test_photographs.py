# SPDX-License-Identifier: Apache-2.0
"""Which photographs are taken, and a training of photographs that have no poses yet."""

import json
import os
import shutil
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.cli import main
from blitzgs.cli import sfm as command
from blitzgs.config.files import load_config
from blitzgs.sfm import engine
from blitzgs.sfm.photographs import Photographs
from blitzgs.util.errors import UserError
from tests.capture.helpers import Posed, opensfm, pix4d, realitycapture, warned, write_image
from tests.sfm.scene import aligned, poses_of, write_photographs
from tests.training.tiny import OVERRIDES, as_flags

pycolmap = pytest.importorskip("pycolmap")

ROOT = Path(__file__).resolve().parents[2]
FLAGS = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.05")


def config_of(folder):
    return load_config(None, [f"data.path={folder}"])


def test_photographs_in_other_formats_are_named(tmp_path):
    write_photographs(tmp_path, 3)
    (tmp_path / "view_0.DNG").write_bytes(b"")  # the raw data of a photograph
    Photographs.of(tmp_path)
    (tmp_path / "view_9.heic").write_bytes(b"")
    warned(r"only its 3 photographs are used; \.heic cannot be read: convert", Photographs.of, tmp_path)


def test_photographs_that_are_called_like_maps_are_named(tmp_path):
    write_photographs(tmp_path, 3)
    (tmp_path / "masks").mkdir()
    shutil.copy(tmp_path / "view_0.jpg", tmp_path / "masks" / "view_0.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Photographs.of(tmp_path)
    (tmp_path / "Alpha").mkdir()  # of a camera of Sony's
    shutil.copy(tmp_path / "view_0.jpg", tmp_path / "Alpha" / "DSC0001.JPG")
    message = r"1 images are called like maps of depth, alpha .* \(first: Alpha/DSC0001.JPG\)"
    assert len(warned(message, Photographs.of, tmp_path).names) == 3


@pytest.mark.parametrize("suffix", [".webp", ".avif", ".jp2", ".gif"])
def test_photographs_that_colmap_does_not_read_are_left_out(tmp_path, suffix):
    write_photographs(tmp_path, 3)
    shown = cv2.imread(str(tmp_path / "view_0.jpg"))
    write_image(tmp_path / f"view_7{suffix.upper()}", shown)
    assert pycolmap.Bitmap.read(tmp_path / f"view_7{suffix.upper()}", False) is None
    found = Photographs.of(tmp_path)
    assert len(found.names) == 3
    assert found.damage == {
        f"view_7{suffix.upper()}": f"COLMAP reads no {suffix.upper()} files: convert it to JPEG or PNG"
    }
    (tmp_path / "view_1.jpg").unlink()
    with pytest.raises(
        ValueError, match=f"3 photographs are needed, 2 can be used; COLMAP reads no {suffix.upper()}"
    ):
        Photographs.of(tmp_path)


def test_photographs_alone_are_recognised(tmp_path, capsys):
    write_photographs(tmp_path / "data/images", 3)
    data = ["train", "--data", str(tmp_path / "data")]
    assert main([*data, "--check"]) == 0
    assert "3 photographs without poses: a training finds them first, in about" in capsys.readouterr().out
    assert main([*data, "--out", str(tmp_path / "run"), "--no-sfm", "--device=cpu"]) == 1
    assert "it has images but not their cameras: blitzgs sfm" in capsys.readouterr().err
    assert not (tmp_path / "run").exists() and not (tmp_path / "run_capture").exists()
    (tmp_path / "data/config.yaml").touch()
    with pytest.raises(FileNotFoundError, match="data is a run and no capture"):
        command.understood_alone(config_of(tmp_path / "data"))
    (tmp_path / "data/transforms.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=f"has its cameras: --data={tmp_path / 'data'} "):
        command.with_poses(config_of(tmp_path / "data/images"), tmp_path / "x")
    assert command.with_poses(config_of(tmp_path / "data"), tmp_path / "x") == config_of(tmp_path / "data")


@pytest.mark.filterwarnings("ignore:.*no points", "ignore:.*of the project", "ignore:.*the largest is used")
def test_projects_of_other_programs_have_poses(tmp_path):
    posed = Posed(origin=np.array([500_000.0, 5_200_000.0, 400.0]))
    pix4d(posed, posed.write_images(tmp_path / "a") / "1_initial" / "params", posed.origin)
    opensfm(Posed(), posed.write_images(tmp_path / "b") / "reconstruction.json", (47.5, 8.25, 432.0))
    realitycapture(posed, posed.write_images(tmp_path / "c") / "registration.csv")
    for name in "abc":
        assert command.understood_alone(config_of(tmp_path / name)) is None
        assert len(load_capture(tmp_path / name).cameras) == 6


def test_other_ranks_wait_for_rank_0(tmp_path, monkeypatch):
    write_photographs(tmp_path / "photos", 3)
    monkeypatch.setenv("RANK", "1")
    results = []

    def wait():
        results.append(command.with_poses(config_of(tmp_path / "photos"), tmp_path / "capture"))

    thread = threading.Thread(target=wait)
    thread.start()
    thread.join(0.5)
    assert thread.is_alive() and not (tmp_path / "capture").exists()
    (tmp_path / "capture/sfm").mkdir(parents=True)
    (tmp_path / "capture/sfm/report.json").write_text("{}")
    thread.join(10)
    assert [config.data.path for config in results] == [str(tmp_path / "capture")]


def test_other_ranks_end_if_rank_0_fails(tmp_path, monkeypatch):
    write_photographs(tmp_path / "photos", 3)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setattr("blitzgs.distributed.watchdog.early_failure", lambda: "rank 0 failed: no pairs")
    with pytest.raises(UserError, match="there are no poses, because rank 0 failed: no pairs"):
        command.with_poses(config_of(tmp_path / "photos"), tmp_path / "capture")


@pytest.mark.slow
def test_torchrun_trains_on_photographs_alone(tmp_path):
    write_photographs(tmp_path / "photos")
    train = ["-m", "blitzgs", "train", "--data", str(tmp_path / "photos"), "--out", str(tmp_path / "run")]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", *train, *FLAGS]
    done = subprocess.run(
        [*torchrun, "--device=cpu"], cwd=ROOT, capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("has photographs without poses") == 1
    assert "8 of 8 have a pose" in done.stdout
    config = json.loads((tmp_path / "run_capture/sfm/report.json").read_text())
    assert len(config["photographs"]) == 8
    assert main(["eval", str(tmp_path / "run"), "--device=cpu"]) == 0
    resumed = ["train", "--data", str(tmp_path / "photos"), "--out", str(tmp_path / "run"), "--extend=1.5"]
    assert main([*resumed, "--device=cpu"]) == 0


# Takes the flags of the program colmap that `engine` uses, does the work with pycolmap, and notes the call.
PROGRAM = """#!{python}
import sys
import pycolmap
command, rest = sys.argv[1], sys.argv[2:]
if command == "help" or "-h" in rest:
    print("COLMAP 4.0 (Commit x without CUDA) --FeatureExtraction.use_gpu --FeatureMatching.use_gpu")
    sys.exit()
flags = dict(zip(rest[::2], rest[1::2], strict=True))
open({calls!r}, "a").write(command + " " + " ".join(rest[::2]) + chr(10))
database = flags.get("--database_path")
if command == "feature_extractor":
    pycolmap.Database.open(database).close()
    reader = pycolmap.ImageReaderOptions(camera_model=flags["--ImageReader.camera_model"])
    assert flags["--ImageReader.single_camera"] == "1"
    names = open(flags["--image_list_path"]).read().split()
    pycolmap.extract_features(
        database, flags["--image_path"], names, pycolmap.CameraMode.SINGLE, reader_options=reader
    )
elif command == "exhaustive_matcher":
    pycolmap.match_exhaustive(database)
elif command == "bundle_adjuster":
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True)
    assert flags["--BundleAdjustment.refine_principal_point"] == "1"
    model = pycolmap.Reconstruction(flags["--input_path"])
    pycolmap.bundle_adjustment(model, options)
    model.write(flags["--output_path"])
else:
    assert command == "mapper"
    options = pycolmap.IncrementalPipelineOptions(min_model_size=int(flags["--Mapper.min_model_size"]))
    pycolmap.incremental_mapping(database, flags["--image_path"], flags["--output_path"], options)
"""


@pytest.mark.slow
def test_the_program_colmap_takes_the_place_of_pycolmap(tmp_path, monkeypatch):
    placed = write_photographs(tmp_path / "photos")
    program = tmp_path / "bin/colmap"
    program.parent.mkdir()
    program.write_text(PROGRAM.format(python=sys.executable, calls=str(tmp_path / "calls")))
    program.chmod(0o755)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr(engine, "MANY", 8)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "capture")]) == 0
    away, angles = aligned(*poses_of(tmp_path / "capture", placed))
    assert len(away) == 8 and away.max() < 0.03 and angles.max() < 0.5
    calls = (tmp_path / "calls").read_text().split("\n")
    done = ["feature_extractor", "exhaustive_matcher", "mapper", "bundle_adjuster"]
    assert [call.split(" ")[0] for call in calls[:4]] == done
    assert "--FeatureExtraction.use_gpu" in calls[0] and "--FeatureMatching.use_gpu" not in calls[0]
