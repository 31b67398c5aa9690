# SPDX-License-Identifier: Apache-2.0
"""`blitzgs train` with photographs alone finds their poses first; `blitzgs sfm` with the program colmap."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from blitzgs.cli import main
from blitzgs.cli import sfm as command
from blitzgs.config.files import load_config
from tests.sfm.scene import aligned, write_photographs
from tests.sfm.test_reconstruct import poses_of
from tests.training.tiny import OVERRIDES, as_flags

ROOT = Path(__file__).resolve().parents[2]
FLAGS = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.05", "log.pictures=0")


def config_of(folder):
    return load_config(None, [f"data.path={folder}"])


def test_photographs_alone_are_recognised(tmp_path, capsys):
    write_photographs(tmp_path / "data/images", 3)
    data = ["train", "--data", str(tmp_path / "data")]
    assert main([*data, "--check"]) == 0
    assert "3 photographs without poses: a training finds them first, in about" in capsys.readouterr().out
    assert main([*data, "--out", str(tmp_path / "run"), "--no-sfm", "--device=cpu"]) == 1
    assert "it has images but not their cameras: blitzgs sfm" in capsys.readouterr().err
    assert not (tmp_path / "run").exists() and not (tmp_path / "run_capture").exists()
    (tmp_path / "data/transforms.json").write_text("{}")
    assert command.with_poses(config_of(tmp_path / "data"), tmp_path / "x") == config_of(tmp_path / "data")


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
database = flags["--database_path"]
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
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "capture")]) == 0
    away, angles = aligned(*poses_of(tmp_path / "capture", placed))
    assert len(away) == 8 and away.max() < 0.03 and angles.max() < 0.3
    calls = (tmp_path / "calls").read_text().split("\n")
    assert [call.split(" ")[0] for call in calls[:3]] == ["feature_extractor", "exhaustive_matcher", "mapper"]
    assert "--FeatureExtraction.use_gpu" in calls[0] and "--FeatureMatching.use_gpu" not in calls[0]
