# SPDX-License-Identifier: Apache-2.0
"""The quality benchmark: its runs, its tables, its stress grid, and the opponents it trains."""

import contextlib
import io
import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import bm_quality
import numpy as np
import pytest
import quality_plan
import quality_report
import quality_run
import torch
from opponents.gsplat_training import GsplatOptions, GsplatTrainer
from opponents.spatial_partition import HALO, LEAST_SEEN, Grid, coverage, divide, makespan
from quality_plan import SAFE, RunSpec, runs_of

from blitzgs.distributed.group import Ranks
from tests.helpers import refused
from tests.training.tiny import OVERRIDES, tiny_scene

FLAGS = " ".join(f"--{text}" for text in OVERRIDES)


def spec_of(capture, source, device="cpu", **changes) -> RunSpec:
    (spec,) = runs_of({"tiny": str(capture)}, {"recipe": source}, [3], [40], None, device)
    return replace(spec, **changes)


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    """Flags of a finished run, its folder, which also has a broken one, and what was printed."""
    out = tmp_path_factory.mktemp("quality") / "out"
    flags = ["--out", str(out), "--gpus", "0", "--per-gpu", "2", "--evaluate-at", "40", "--seeds", "3"]
    flags += ["--capture", f"tiny={capture}", "--recipe", f"ours=defaults {FLAGS}"]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        missing = out.parent / "missing.txt"
        assert bm_quality.main([*flags, "--recipe", f"broken=defaults --data.split={missing}"]) == 1
    return flags, out, printed.getvalue()


def test_runs_are_done_once_and_a_failure_stops_no_other(trained, tmp_path, capsys):
    flags, out, printed = trained
    assert "missing.txt" in printed and "| ours | 100 | 1 |" in printed
    done, broken = sorted(quality_report.read_runs(out / "runs"), key=lambda run: run["status"])
    assert done["status"] == "done" and [e["images"] for e in done["evaluations"]] == [40, 100]
    first, last = done["evaluations"]
    assert "train" not in first and last["train"]["psnr"] > 20 and last["test"]["ssim"] > 0.5
    assert 0 < first["seconds"] < last["seconds"] == done["seconds"]
    assert done["peak_gaussians"] >= done["gaussians"] > 0 and done["peak_memory_bytes"] > 0
    assert list(done["views"].values()) == [pytest.approx(last["test"]["psnr"])]
    row = quality_plan.stress_markdown([done | {"recipe": "base+schedule=50+B=4"}]).splitlines()[-1]
    assert row.endswith(f"| {last['test']['psnr']:.2f} | 0.00 | {done['largest_fall']:.2f} |")
    assert broken["status"] == "failed" and "missing.txt" in broken["error"]

    # A second call repeats no finished run. A budget of no time starts no run.
    written = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("tiny.ours*")}
    assert bm_quality.main([*flags, "--only", "^ours$"]) == 0
    assert bm_quality.main([*flags, "--seeds", "3", "4", "--minutes", "0"]) == 0
    assert "1 runs left" in capsys.readouterr().out
    assert written == {path: path.stat().st_mtime_ns for path in (out / "runs").glob("tiny.ours*")}

    # Another folder collects the file; a failed run does not replace a finished one.
    elsewhere = tmp_path / "elsewhere"
    failed = tmp_path / "failed.json"
    failed.write_text(json.dumps(done | {"status": "failed", "error": "no"}))
    assert (
        bm_quality.main(["--out", str(elsewhere), "--collect", str(out / "quality.json"), str(failed)]) == 0
    )
    assert quality_report.is_done(elsewhere, done["name"])
    assert done in json.loads((elsewhere / "quality.json").read_text())["runs"]


def test_bad_plans_name_what_is_wrong(tmp_path, capture, capsys):
    def message(*flags):
        with pytest.raises(SystemExit):
            bm_quality.main(["--out", str(tmp_path), *flags])
        return capsys.readouterr().err

    where = ["--capture", f"tiny={capture}", "--recipe"]
    assert "there is no opponent gsplat-best" in message(*where, "a=gsplat-best")
    assert "unknown option iterations" in message(*where, "a=gsplat-mcmc --iterations=3")
    assert "cap_max must be int, got 'many'" in message(*where, "a=gsplat-mcmc --cap_max=many")
    assert "schedule.nothing" in message(*where, "a=defaults --schedule.nothing=1")
    assert "'a/b=defaults': write NAME=" in message(*where, "a/b=defaults")
    assert "is not a folder" in message("--capture", f"x={tmp_path}/none", "--recipe", "a=defaults")
    assert "nothing to train" in message()
    for source in ("partition-4:defaults", "partition-0x3:defaults"):
        assert "write partition-COLUMNSxROWS:SOURCE" in message(*where, f"a={source}")


def test_settings_tell_recipes_apart_but_not_seeds_or_places(capture):
    one = spec_of(capture, "defaults")
    assert one.settings == replace(one, seed=4, data=["data.path=elsewhere"]).settings
    assert one.settings != spec_of(capture, "defaults --loss.ssim=0.3").settings
    assert one.settings != spec_of(f"{capture} --data.downscale=2", "defaults").settings
    mcmc = spec_of(capture, "gsplat-mcmc")
    assert mcmc.settings != spec_of(capture, "gsplat-mcmc --cap_max=5").settings
    assert mcmc.options() == GsplatOptions.of("mcmc", {"cap_max": 1_000_000})


@pytest.mark.parametrize("strategy", ["default", "default-reset", "mcmc"])
def test_gsplats_strategies_train(capture, strategy, device):
    pytest.importorskip("gsplat")
    # Times of 30,000 steps in 120: density from 2 on, every step; resets, where there are any, each 12.
    source = f"gsplat-{strategy} --steps_scaler=0.004 "
    source += "--cap_max=450" if strategy == "mcmc" else "--grow_grad2d=0.002"
    result = quality_run.train_opponent(spec_of(capture, source, device), Ranks(device=torch.device(device)))
    # Training views are measured after 7,000 and 15,000 of 30,000 steps and at the end.
    assert [e["images"] for e in result["evaluations"]] == [28, 40, 60, 120]
    quoted = [e["images"] for e in result["evaluations"] if "train" in e]
    assert quoted == [28, 60, 120] and result["images"] == 120
    start, end = result["evaluations"][0]["test"], result["evaluations"][-1]
    assert end["train"]["psnr"] > start["psnr"] and end["train"]["psnr"] > 18
    assert result["peak_gaussians"] >= result["gaussians"] != 400
    assert strategy != "mcmc" or result["gaussians"] == 450
    assert "gsplat.cuda._backend" not in sys.modules  # which would compile gsplat's extension


@pytest.mark.parametrize("reset", [False, True])
def test_resets_are_where_gsplat_announces_them(reset):
    pytest.importorskip("gsplat")
    scene, images = tiny_scene()
    options = GsplatOptions.of("default", {"steps_scaler": 0.004, "reset": reset})
    trainer = GsplatTrainer("default", options, scene, images, torch.device("cpu"), seed=0)
    trainer.train_to(12)
    highest = trainer.params["opacities"].sigmoid().max().item()
    assert highest > 0.1
    trainer.train_to(13)
    after = trainer.params["opacities"].sigmoid().max().item()
    assert (after == pytest.approx(0.01, rel=1e-4)) == reset


def test_the_scene_is_in_gsplats_unit():
    """Eight cameras at distance 3 from an axis through the origin, all looking at the origin."""
    scene, images = tiny_scene()
    scene.offset = torch.zeros(3).numpy()
    from opponents.gsplat_training import space_of

    space = space_of(scene)
    assert space.unit == pytest.approx(math.hypot(3, 2.5))
    assert space.extent == pytest.approx(1.1 * 3 / math.hypot(3, 2.5))


def test_several_ranks_train_one_run_to_the_same_model(trained):
    flags, out, _ = trained
    assert bm_quality.main([*flags, "--per-gpu", "1", "--ranks", "2"]) == 0
    runs = [run for run in quality_report.read_runs(out / "runs") if run["recipe"] == "ours"]
    one, two = sorted(runs, key=lambda run: len(run["name"]))
    assert two["name"] == one["name"] + ".r2" and (one["ranks"], two["ranks"]) == (1, 2)
    assert two["gaussians"] == pytest.approx(one["gaussians"], abs=3)  # rounding may decide on some
    assert len(two["population"]["peak_memory_bytes"]) == 2
    assert two["population"]["peak_memory_bytes"][0] == two["peak_memory_bytes"]  # without evaluations
    psnr = [run["evaluations"][-1]["test"]["psnr"] for run in (one, two)]
    assert psnr[1] == pytest.approx(psnr[0], abs=0.05)


def test_a_capture_without_a_view_to_measure_is_named():
    refused(ValueError, "nothing .* all pixels of the views are masked", quality_run.means_of, {"views": {}})


def test_every_recipe_of_the_grid_can_be_configured(tmp_path):
    aerial = Path(__file__).resolve().parents[2] / "configs" / "aerial.yaml"
    grid = quality_plan.stress_recipes(str(aerial))
    assert len(grid) == 9 * 4 * 3 and all(set(name) <= SAFE for name in grid)
    some = dict(list(grid.items())[::17])
    specs = runs_of({"x": str(tmp_path)}, some, [0], [], None, "cpu")
    assert len(specs) == len(some)
    doubled = grid["position=200+schedule=25+B=1"]
    assert "--optimiser.position=0.00032" in doubled and "--schedule.scale=0.25" in doubled


def test_the_table_compares_the_worst_seed_with_its_column():
    def run(change, psnr, fall, seed):
        recipe = f"{change}+schedule=50+B=4"
        evaluations = [{"test": {"psnr": psnr}}]
        return {
            "capture": "park", "recipe": recipe, "seed": seed, "status": "done",
            "evaluations": evaluations, "largest_fall": fall,
        }  # fmt: skip

    runs = [run("base", 30.0, 0.1, 0), run("base", 29.5, 0.4, 1), run("position=200", 27.0, 3.5, 0)]
    text = quality_plan.stress_markdown([*runs, {"capture": "park", "recipe": "aerial", "status": "done"}])
    assert "| park | schedule=50+B=4 | base | 2 | 29.50 | 0.00 | 0.40 |" in text
    assert "| park | schedule=50+B=4 | position=200 | 1 | 27.00 | 2.50 | 3.50 |" in text


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
    refused(ValueError, "span no plane", Grid, flight, 2, 2)


def test_blocks_are_shared_among_gpus():
    assert makespan([4.0, 3.0, 3.0, 2.0], 1) == 12.0 and makespan([5.0], 4) == 5.0
    assert makespan([2.0, 3.0, 4.0, 3.0], 2) == 6.0


def test_a_partition_is_trained_merged_and_measured_beside_the_whole(trained, capture, tmp_path):
    spec = spec_of(capture, f"partition-2x1:defaults {FLAGS}")
    files = [tmp_path / "spec.json", tmp_path / "result.json"]
    files[0].write_text(json.dumps(asdict(spec)))
    assert quality_run.main(files) == 0
    grid = json.loads(files[1].read_text())
    runs = {run["recipe"]: run for run in quality_report.read_runs(trained[1] / "runs") if run["ranks"] == 1}
    whole = runs["ours"]
    assert grid["settings"] != whole["settings"] and whole["population"]["final"] == whole["gaussians"]
    assert [block["cell"] for block in grid["blocks"]] == [0, 1]
    assert grid["gaussians"] == sum(block["kept"] for block in grid["blocks"]) > 0
    assert all(0 < block["kept"] < block["gaussians"] for block in grid["blocks"])
    assert grid["coverage"]["cameras"] == 7 and grid["coverage"]["assignments"] >= 7
    assert grid["images"] == sum(block["images"] for block in grid["blocks"])
    assert grid["seconds"] >= sum(block["seconds"] for block in grid["blocks"])
    # Each half was trained as long as the whole: the merged model shows the scene.
    psnr = [run["evaluations"][-1]["test"]["psnr"] for run in (grid, whole)]
    assert psnr[0] > psnr[1] - 6 > 10
