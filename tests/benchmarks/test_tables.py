# SPDX-License-Identifier: Apache-2.0
"""The tables of the paper and of the city as commands: their arms, their runs, and their rows."""

import csv
import json
from pathlib import Path

import bm_city
import bm_popping
import city_report
import city_run
import pytest
import report
import tables
import yaml
from quality_plan import runs_of

from blitzgs.config.files import load_config
from tests.training.tiny import OVERRIDES, write_tiny_capture

ROOT = Path(__file__).resolve().parents[2]

PLANS = yaml.safe_load(tables.PAPER.read_text())
FLAGS = " ".join(f"--{text}" for text in OVERRIDES)


def finished(recipe, seed, psnr, capture="town", **more):
    ends = {"psnr": psnr, "ssim": 0.9, "psnr_corrected": psnr}
    return {
        "name": f"{capture}.{recipe}.s{seed}", "status": "done", "capture": capture, "recipe": recipe,
        "seed": seed, "settings": "0", "images": 100, "seconds": 10.0 + seed, "images_per_second": 9.0,
        "gaussians": 1_000_000, "peak_gaussians": 2_500_000, "peak_memory_bytes": 5_000_000_000,
        "evaluations": [{"images": 100, "seconds": 10.0, "gaussians": 1_000_000, "test": ends}],
    } | more  # fmt: skip


@pytest.mark.parametrize("config", ["configs/density.yaml", "configs/paper.yaml"])
@pytest.mark.parametrize("table", tables.TRAINED)
def test_every_arm_has_a_distinct_configuration(capture, monkeypatch, table, config):
    monkeypatch.chdir(ROOT)
    plan = PLANS[table]
    recipes = tables.recipes_of(plan, config, Path("gates/some.json"))
    ours = {name: text for name, text in recipes.items() if not text.startswith("gsplat-")}
    specs = runs_of({"x": str(capture)}, ours, [0], [], None, "cpu")
    assert len({spec.settings for spec in specs}) == len(ours) == len(plan["arms"])
    full = tables.recipes_of(PLANS["ablation"], config, Path("gates/some.json"))["full"]
    chosen = runs_of({"x": str(capture)}, {"full": full}, [0], [], None, "cpu")[0].config()
    assert chosen.population.importance and chosen.view.lod and chosen.view.cull
    assert chosen.population.gate == str(ROOT / "gates/some.json")


def test_arms_without_a_gate_file_and_onsets(monkeypatch):
    monkeypatch.chdir(ROOT)
    recipes = tables.recipes_of(PLANS["ablation"], "configs/paper.yaml", None)
    assert "no_gate" not in recipes and {"full", "all_off", "no_phi", "partition_4x5"} <= set(recipes)
    assert list(tables.recipes_of(PLANS["rho"], "configs/paper.yaml", None)) == ["rate_0"]
    chosen = tables.recipes_of(
        PLANS["ablation"], "defaults", Path("g"), "--view.lod=false", ["no_gate", "full"]
    )
    assert list(chosen) == ["full", "no_gate"] and "--view.lod=false" in chosen["full"]
    with pytest.raises(ValueError, match="there is no fulll in this table; it has full, no_lod"):
        tables.recipes_of(PLANS["ablation"], "defaults", None, arms=["fulll"])
    onsets = tables.recipes_of(PLANS["onset"], "configs/paper.yaml", Path("g.json"))
    assert [text.rpartition("=")[2] for text in onsets.values()] == ["16000", "20000", "24000", "28000"]


def test_a_trajectory_is_trained_once_and_tabulated(tmp_path, capture, capsys):
    out = tmp_path / "out"
    flags = ["trajectory", "--out", str(out), "--scenes", f"tiny={capture}", "--config", "defaults"]
    flags += ["--flags", FLAGS, "--gpus", "0", "--per-gpu", "2", "--seeds", "1"]
    assert tables.main([*flags, "--dry-run"]) == 0 and not out.exists()
    assert "to run: tiny.full.s1" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        tables.main([*flags, "--arms", "fuller"])
    assert "there is no fuller in this table" in capsys.readouterr().err
    # Refused calls leave no results.
    assert tables.main(flags) == 0
    assert "| final | 0.0" in capsys.readouterr().out
    rows = {row["stage"]: row for row in csv.DictReader((out / "trajectory.csv").open())}
    assert float(rows["peak"]["tiny"]) >= float(rows["final"]["tiny"]) > 0
    assert rows["before_pass_1"]["paper Rubble"] == "5.22"
    with pytest.raises(SystemExit):
        tables.main(flags)
    assert "--resume carries on" in capsys.readouterr().err
    written = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*")}
    assert [json.loads(path.read_text())["per_gpu"] for path in written] == [2]
    assert tables.main([*flags, "--resume"]) == 0 and len(written) == 1
    assert written == {path: path.stat().st_mtime_ns for path in (out / "runs").glob("*")}


def test_arms_have_median_and_worst_beside_the_paper(tmp_path, capsys):
    source = tmp_path / "quality.json"
    runs = [finished("full", seed, 27.0 + seed) for seed in range(3)] + [finished("all_off", 0, 27.1)]
    block = {"cameras": 40, "seconds": 4.0, "gaussians": 500_000, "kept": 250_000}
    cover = {"cameras": 100, "covered": 99, "in_several": 80, "assignments": 160}
    parts = {"blocks": [block] * 4, "coverage": cover, "split_seconds": 0.5, "merge_seconds": 0.5}
    runs.append(finished("partition_4x5", 0, 25.0, **parts))
    source.write_text(json.dumps({"runs": runs}))
    out = tmp_path / "out"
    assert tables.main(["ablation", "--out", str(out), "--collect", str(source)]) == 0
    text = capsys.readouterr().out
    assert "| town | full | 1 | 3 | 28.00 (27.00) |" in text and "8.66 -> 4.65" in text
    rows = list(csv.DictReader((out / "ablation.csv").open()))
    assert [row["arm"] for row in rows] == ["full", "all off", "partition 4 x 5"]
    assert (rows[0]["PSNR"], rows[0]["worst PSNR"], rows[0]["paper PSNR"]) == ("28.0", "27.0", "23.46")
    assert rows[0]["worst seconds"] == "12.0" and rows[1]["paper time"] == "71m46s"
    # 4 blocks of 4 s on 4 GPUs take as long as one, besides the split and the merge.
    assert "| 99 of 100 | 1.6 | 80.0% | 40 to 40 | 2 | 1 | 50.0% | 17 | 5 |" in text
    with pytest.raises(SystemExit):
        tables.main(["rho", "--out", str(out)])
    assert "has no finished results for rho" in capsys.readouterr().err


def test_cost_and_oracle_are_read_from_finished_results(tmp_path):
    stages = ("project", "exchange", "sort", "raster", "loss", "raster back", "exchange back", "optimiser")
    ms = dict.fromkeys(stages, 1.0) | {"other": 0.5, "alone": 8.5, "step": 8.0}
    report = {"ranks": 2, "gaussians": 3_000_000, "ms": ms}
    (tmp_path / "cost.town.json").write_text(json.dumps({"results": [report]}))
    assert tables.main(["cost", "--out", str(tmp_path)]) == 0
    (row,) = csv.DictReader((tmp_path / "cost.csv").open())
    named = ("preprocess", "communicate", "render", "loss", "backward", "other", "total", "paper total")
    assert [float(row[name]) for name in named] == [2, 2, 1, 1, 1, 1.5, 8.5, 119.7]

    arms = [
        {"arm": "reference", "psnr": 27.0, "ssim": 0.9, "peak": 2_000_000, "final": 10, "seconds": 5.0},
        {"arm": "gate", "psnr": 27.1, "ssim": 0.9, "peak": 1_500_000, "final": 10, "seconds": 4.0},
    ]
    (tmp_path / "oracle.town").mkdir()
    (tmp_path / "oracle.town" / "replay.json").write_text(json.dumps(arms))
    assert tables.main(["oracle", "--out", str(tmp_path)]) == 0
    rows = list(csv.DictReader((tmp_path / "oracle.csv").open()))
    assert (rows[1]["change"], rows[1]["peak change"], rows[1]["paper peak change"]) == (
        "0.1", "-25.0%", "-16.6 %",
    )  # fmt: skip


def test_popping_is_measured_once(tmp_path, monkeypatch):
    figures = {"mean_change": 1.0, "largest_change": 2.0}
    jumps = figures | {"mean": 0.1, "largest": 0.2, "pixel": 3.0, "kept": 0.5}
    calls = []

    def popping(run, out, device):
        calls.append((run, device))
        return {"frames": 3, "levels": 2, "full": figures, "gated": jumps, "smooth": jumps}

    monkeypatch.setattr(bm_popping, "popping", popping)
    flags = ["popping", "--out", str(tmp_path), "--runs", "town=RUNS/town", "--gpus", "0"]
    assert tables.main([*flags, "--dry-run"]) == 0 and not calls
    assert tables.main(flags) == tables.main([*flags, "--resume"]) == 0
    assert calls == [(Path("RUNS/town"), "cpu")]
    rows = list(csv.DictReader((tmp_path / "popping.csv").open()))
    assert [(row["levels"], row["largest"]) for row in rows] == [
        ("full", ""), ("gated", "0.2"), ("smooth", "0.2"),
    ]  # fmt: skip


# 26 steps of 4 images.
TINY = ["--gpus", "0", "--held-out", "2", "--scale", "0.004", "--log.every=8"]


@pytest.fixture
def city(tmp_path, monkeypatch):
    monkeypatch.setenv("BLITZGS_COMMIT", "abc")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folder = tmp_path / "a city"
    write_tiny_capture(folder)
    manifest = {"extent": 20.0, "views": 8, "width": 48, "height": 32}
    (folder / "city.json").write_text(json.dumps(manifest))
    return folder


def call(city, *flags):
    out = city.parent / "out"
    flags = [*TINY, *flags, "--json", str(city.parent / "city.json")]
    status = bm_city.main([str(city), "--out", str(out), *flags])
    return status, json.loads((city.parent / "city.json").read_text())


@pytest.mark.slow
def test_arms_ranks_and_popping_become_tables(city, capsys):
    flags = ["--arms", "full", "all_off", "--ranks", "1", "2", "--batch-sizes", "4", "8", "--popping", "3"]
    status, file = call(city, *flags)
    assert status == 0 and file["commit"] == "abc" and file["city"]["images"] == 8
    runs = file["results"]
    assert [(run["recipe"], run["ranks"], run["batch_size"]) for run in runs] == [
        ("full", 1, 4), ("full", 1, 8), ("all_off", 1, 4), ("full", 2, 4), ("full", 2, 8),
    ]  # fmt: skip
    for run in runs:
        assert run["finished"] and run["images"] == 104 and run["views"] == {"train": 6, "test": 2}
        assert 5 < run["psnr"] < 60 and len(run["population"]["peak_memory_bytes"]) == run["ranks"]
        assert sum(phase["seconds"] for phase in run["phases"]) == pytest.approx(run["seconds"])
    assert [phase["on"] for phase in runs[0]["phases"]] == ["growth", "LOD + mask", "LOD"]
    assert {event["event"] for event in runs[0]["events"]} == set(city_run.EVENTS) - {"pass_1"}
    assert [phase["on"] for phase in runs[2]["phases"]] == ["growth", "–", "–"]
    assert ["popping" in run for run in runs] == [True, False, False, False, False]
    for name, rows_of in city_report.TABLES.items():
        assert rows_of(file), f"{name} is empty"
    page = report.render_page("<!-- table: city_ranks -->\n<!-- end: city_ranks -->\n", {"city_ranks": file})
    assert "\n| LOD gate and mask | 8 | 2 | " in page and "commit abc" in page
    # The same command trains nothing again.
    before = {path: path.stat().st_mtime_ns for path in (city.parent / "out" / "runs").iterdir()}
    assert call(city, *flags)[0] == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert "LOD gate and mask, 2 ranks" in capsys.readouterr().out


def test_a_run_is_evaluated_at_its_deadline(city, capsys):
    flags = ["--arms", "no_mask", "--seconds-per-run", "17", "--scale", "50", "--log.every=100"]
    status, file = call(city, *flags)
    (run,) = file["results"]
    assert status == 0 and not run["finished"] and run["status"] == "done"
    assert 0 < run["images"] < run["planned_images"] and run["psnr"] > 5
    assert f"(stopped at {run['images']:,} of 1,300,000 images)" in capsys.readouterr().out


def test_a_run_that_ends_early_leaves_what_is_known(city, capsys):
    status, file = call(city, "--arms", "full", "--popping", "3")
    (run,) = file["results"]
    assert status == 0 and run["finished"] and run["popping"]["frames"] == 3
    (path,) = (city.parent / "out" / "runs").iterdir()
    whole = json.loads(path.read_text())
    assert whole["source"] == "configs/city.yaml"  # wherever the repository is
    for missing in (["psnr", "ssim"], ["phases"], ["environment", "finished"]):
        for name in missing:
            del whole[name]
        path.write_text(json.dumps(whole | {"status": "running"}))
        assert bm_city.main([str(city), "--out", str(city.parent / "out"), "--collect"]) == 0
        assert "Not done: city.full" in capsys.readouterr().out


def test_wrong_arguments_are_refused(city, capsys):
    with pytest.raises(SystemExit):
        call(city, "--held-out", "8")
    assert "--held-out must be below the number of views, 8, got 8" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        bm_city.main([str(city), "--out", str(city.parent / "empty"), "--collect"])
    assert "empty" in capsys.readouterr().err
    (city / "city.json").unlink()
    with pytest.raises(SystemExit):
        call(city)
    assert "wait until blitzgs synth has ended" in capsys.readouterr().err


def test_phases_divide_the_time_between_records():
    config = load_config(None, ["schedule.iterations=1000", "schedule.densify_until=400", "schedule.t1=0",
                                "schedule.t2=400", "view.lod=true"])  # fmt: skip
    # 100 images/s for 400 images, then 200.
    seconds = {200: 2.0, 400: 4.0, 600: 5.0, 800: 6.0}
    records = [{"event": "start", "t": 0}]
    for t, at in seconds.items():
        speed = {"images_per_second": t / at}
        records.append({"loss": 1.0, "t": t, "active": t / 10, "visible": 10.0, "gaussians": 1000} | speed)
    phases = city_run.phases_of(config, records, 1000, 7.0)
    assert [(phase["from"], phase["to"], phase["on"]) for phase in phases] == [
        (0, 400, "growth"), (400, 700, "LOD"), (700, 1000, "LOD"),
    ]  # fmt: skip
    assert [phase["seconds"] for phase in phases] == pytest.approx([4.0, 1.5, 1.5])
    assert [phase["median_images_per_second"] for phase in phases] == pytest.approx([100, 200, 200])
    assert phases[0]["active"] == pytest.approx(0.03) and phases[0]["visible"] == pytest.approx(0.01)
