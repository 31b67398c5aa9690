# SPDX-License-Identifier: Apache-2.0
"""The spatial-partition baseline: its grid, its camera rule, and a training through the quality benchmark."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_quality  # noqa: E402
import quality_report  # noqa: E402
from opponents.spatial_partition import HALO, LEAST_SEEN, Grid, coverage, divide, makespan  # noqa: E402

from tests.training.tiny import OVERRIDES, write_tiny_capture  # noqa: E402

FLAGS = " ".join(f"--{text}" for text in OVERRIDES)


def nadir(x, y, height=1.0):
    """A camera over (x, y) that looks straight down and sees a square of 1 x 1."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -pose[:3, :3] @ [x, y, height]
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    return SimpleNamespace(world_to_camera=pose, K=K, width=100, height=100)


@pytest.fixture
def flight():
    """Cameras every half unit over 8 x 4, and points every quarter, none of them at a picture's edge."""
    xs, ys = np.meshgrid(np.arange(0, 8.01, 0.5), np.arange(0, 4.01, 0.5), indexing="ij")
    cameras = [nadir(x, y) for x, y in zip(xs.ravel(), ys.ravel(), strict=True)]
    px, py = np.meshgrid(np.arange(-1, 9.01, 0.25), np.arange(-1, 5.01, 0.25), indexing="ij")
    points = np.stack([px.ravel() + 0.1, py.ravel() + 0.1, 0 * px.ravel()], 1)
    return SimpleNamespace(
        root="flight", cameras=cameras, points=points, train=list(range(1, len(cameras))), test=[0]
    )


def test_every_point_has_one_cell_and_halos_overlap(flight):
    grid = Grid(flight, 4, 2)
    places = grid.coordinates(flight.points)
    own = np.stack([grid.inside(places, cell) for cell in range(grid.cells)])
    assert grid.cells == 8 and (own.sum(axis=0) == 1).all()
    grown = np.stack([grid.inside(places, cell, HALO) for cell in range(grid.cells)])
    assert (grown | own == grown).all() and set(grown.sum(axis=0)) == {1, 2, 4}
    # 96 % of the 10 x 6 units of ground are divided; the outermost cells have the rest, too.
    inner = next(cell for cell in range(8) if not own[cell][[0, 24, -25, -1]].any())
    assert np.ptp(flight.points[own[inner]], axis=0)[:2] == pytest.approx([2.4, 3.0], abs=0.3)
    assert np.ptp(flight.points[grown[inner]], axis=0)[0] == pytest.approx(1.4 * 2.4, abs=0.3)


def test_cameras_are_given_to_the_blocks_that_they_see_or_stand_in(flight):
    grid = Grid(flight, 4, 2)
    blocks = divide(flight, grid)
    places = grid.coordinates(flight.points)
    for block in blocks:
        within = grid.inside(places, block.cell, HALO)
        assert np.array_equal(block.points, within)
        for index in flight.train:
            pose = flight.cameras[index].world_to_camera
            centre = -pose[:3, :3].T @ pose[:3, 3]
            seen = (np.abs(flight.points - centre)[:, :2] < 0.5).all(axis=1)  # 1 x 1 from a height of 1
            stands = grid.inside(grid.coordinates(centre[None]), block.cell, HALO)[0]
            wanted = stands or (seen & within).sum() >= LEAST_SEEN * seen.sum()
            assert (index in block.cameras) == wanted
    found = coverage(flight, blocks)
    assert found["cameras"] == found["covered"] == len(flight.train)
    assert found["assignments"] == sum(len(block.cameras) for block in blocks) > found["cameras"]
    assert 0 < found["in_several"] < found["cameras"]
    assert all(0 not in block.cameras for block in blocks)  # it is held out


def test_cameras_in_a_line_have_no_grid(flight):
    flight.cameras = [nadir(x, 0.0) for x in range(5)]
    flight.train = list(range(5))
    with pytest.raises(ValueError, match="span no plane"):
        Grid(flight, 2, 2)


def test_blocks_are_shared_among_gpus():
    assert makespan([4.0, 3.0, 3.0, 2.0], 1) == 12.0
    assert makespan([2.0, 3.0, 4.0, 3.0], 2) == 6.0
    assert makespan([5.0], 4) == 5.0


def test_a_partition_is_trained_merged_and_measured_beside_the_whole(tmp_path):
    capture, out = tmp_path / "capture", tmp_path / "out"
    write_tiny_capture(capture)
    flags = ["--out", str(out), "--gpus", "0", "--capture", f"tiny={capture}"]
    flags += ["--recipe", f"whole=defaults {FLAGS}", "--recipe", f"grid=partition-2x1:defaults {FLAGS}"]
    assert bm_quality.main(flags) == 0
    runs = {run["recipe"]: run for run in quality_report.read_runs(out / "runs")}
    grid, whole = runs["grid"], runs["whole"]
    assert grid["settings"] != whole["settings"] and whole["population"]["final"] == whole["gaussians"]
    assert [block["cell"] for block in grid["blocks"]] == [0, 1]
    assert grid["gaussians"] == sum(block["kept"] for block in grid["blocks"]) > 0
    assert all(0 < block["kept"] < block["gaussians"] for block in grid["blocks"])
    assert grid["coverage"]["cameras"] == 7 and grid["coverage"]["assignments"] >= 7
    assert grid["images"] == sum(block["images"] for block in grid["blocks"])
    assert grid["seconds"] >= sum(block["seconds"] for block in grid["blocks"])
    # Each half was trained as long as the whole: the merged model shows the scene.
    psnr = {name: run["evaluations"][-1]["test"]["psnr"] for name, run in runs.items()}
    assert psnr["grid"] > psnr["whole"] - 6 > 10


def test_a_wrong_grid_is_named(tmp_path, capsys):
    for source in ("partition-4:defaults", "partition-0x3:defaults"):
        with pytest.raises(SystemExit):
            bm_quality.main(["--out", str(tmp_path), "--capture", f"x={tmp_path}", "--recipe", f"a={source}"])
        assert "write partition-COLUMNSxROWS:SOURCE" in capsys.readouterr().err
